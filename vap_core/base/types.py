"""The values of the method: frozen, and checked against their annotated types and shapes when they
are built.

Conventions in the whole package: images are RGB, height x width x 3, uint8. Boxes are `x0 y0 x1 y1`
in pixels, x to the right and y down, the far corner exclusive. Lengths are metres, angles radians,
times seconds. Cameras follow OpenCV: x right, y down, z into the scene. Rates are fractions;
percent is for print.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, dataclass_transform

import numpy as np
from beartype import beartype
from jaxtyping import Bool, Float32, Float64, Int64, UInt8, jaxtyped

Rgb = UInt8[np.ndarray, "_ _ 3"]
Mask = Bool[np.ndarray, "_ _"]
Views = Mapping[str, Rgb]
"""One image per camera, keyed by the camera's name."""


EVERY_STEP = (
    "AttendState", "Attended", "Camera", "Frame", "FrameFeatures", "FrameMemory", "Judge", "Light",
    "MaskCoverage", "Observation", "PolicyInput", "PromptContext", "Setpoint", "Touch", "Track",
    "TrackState", "Truth",
)  # fmt: skip
"""What a loop builds at every control step: checking it takes 4.7 % of an evaluation. Tests check
it all the same, and what parts of a user's own give is checked where it enters."""


@dataclass_transform(frozen_default=True, eq_default=False)
def value[T](cls: type[T]) -> type[T]:
    """Make `cls` a frozen dataclass whose fields are checked when it is built."""
    frozen = dataclass(frozen=True, slots=True, eq=False)(cls)
    if cls.__name__ in EVERY_STEP:
        return frozen
    return jaxtyped(typechecker=beartype)(frozen)


def kind_of(found: object) -> str:
    """What a part gave in place of an array: its type, and its numbers' type and shape."""
    about = f"{type(found).__name__} {getattr(found, 'dtype', '')} {getattr(found, 'shape', '')}"
    return about.strip()


@value
class Boxes:
    """Category-level proposals of one view (P 3.3); n may be 0: a result, not an error.

    `prior` is what a detector of one's own knows of each box besides its score; it is recorded, and
    no election counts it. `familiar` says whether the view is of the world that the stack's own
    models were trained on.

    `verified` counts the points of each box that lie as they do on a reference, the most of any;
    `proof` is what that says, in units of cosine. Both are None where no points were compared."""

    xyxy: Float32[np.ndarray, "n 4"]
    score: Float32[np.ndarray, " n"]
    phrase: str
    prior: Float32[np.ndarray, " n"] | None = None
    familiar: bool = True
    verified: Int64[np.ndarray, " n"] | None = None
    proof: Float32[np.ndarray, " n"] | None = None

    def __post_init__(self) -> None:
        sides = self.xyxy[:, 2:] - self.xyxy[:, :2]
        if not ((sides > 0) & (sides < np.inf)).all():
            raise ValueError(f"Boxes: far corner must exceed near corner, got {self.xyxy.tolist()}")
        if not ((self.score >= 0) & (self.score <= 1)).all():
            raise ValueError(f"Boxes: scores are in [0, 1], got {self.score.tolist()}")

    def __len__(self) -> int:
        return len(self.xyxy)

    def take(self, rows: Int64[np.ndarray, " m"]) -> "Boxes":
        """These boxes, in this order."""
        return replace(
            self,
            xyxy=self.xyxy[rows],
            score=self.score[rows],
            prior=None if self.prior is None else self.prior[rows],
            verified=None if self.verified is None else self.verified[rows],
            proof=None if self.proof is None else self.proof[rows],
        )

    @staticmethod
    def empty(phrase: str) -> "Boxes":
        return Boxes(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), phrase)


@value
class Description:
    """An object's appearance in words that can follow "my cup is"."""

    short: str
    long: str


@value
class PersonalObject:
    """One remembered object: K reference crops and their embeddings Z_o (P 3.3).

    Rows of `embeddings` are L2-normalised. `owner` is the person that it belongs to, "" where that
    does not matter; `known_as` are other words for that person, as in "my brother's". `note` is
    what its owner says about it: "for the morning coffee".
    """

    name: str
    category: str
    embeddings: Float32[np.ndarray, "k d"]
    crops: tuple[Rgb, ...]
    encoder: str
    description: Description | None = None
    owner: str = ""
    known_as: tuple[str, ...] = ()
    note: str = ""

    def __post_init__(self) -> None:
        if len(self.crops) != len(self.embeddings) or not self.crops:
            raise ValueError(
                f"PersonalObject {self.name!r}: {len(self.crops)} crops for {len(self.embeddings)} "
                "embeddings; one each, and at least one"
            )
        norm = np.linalg.norm(self.embeddings, axis=1)
        if not np.allclose(norm, 1.0, atol=1e-3):
            raise ValueError(
                f"PersonalObject {self.name!r}: embeddings must be L2-normalised, "
                f"got norms {norm.tolist()}"
            )

    def first(self, k: int | None) -> "PersonalObject":
        """The object with its first k references; with all where k is None or more."""
        if k is None or k >= len(self.crops):
            return self
        return self.take(slice(k))

    def take(self, references: slice) -> "PersonalObject":
        """The object with these references alone."""
        crops = self.crops[references]
        return replace(self, embeddings=self.embeddings[references], crops=crops)


@value
class Target:
    """One object that an instruction names, and where.

    `text[start:stop]` is "my cup" for owner "my" and category "cup". `object` is the name of the
    remembered object that a parser of implicit references found; None where category and owner
    decide. `again` are the other spans that name the same object.
    """

    start: int
    stop: int
    owner: str
    category: str
    object: str | None = None
    again: tuple["Target", ...] = ()


@value
class Instruction:
    """A parsed instruction: its text and its targets, left to right; all spans are disjoint.

    A parser may give several targets of one object; `instruction.unite` makes them one."""

    text: str
    targets: tuple[Target, ...]


@value
class Colour:
    """A nameable tint."""

    name: str
    rgb: tuple[int, int, int]


@value
class Ballot:
    """The result of one vote over n candidates and K references (P 3.3).

    `votes[i]` counts the references whose best candidate is i; `tied` marks the candidates that
    share the most votes, where more than one does. `winner` is the elected candidate, None exactly
    when there is none to elect. `margin` is (votes of the winner - most votes of any other) / K, in
    [0, 1] when votes decide; `cosine_margin` is the same difference of mean cosines, 2 when there
    is no other candidate. Where points were compared, their proof is added to the cosines first."""

    votes: Int64[np.ndarray, " n"]
    tied: Bool[np.ndarray, " n"]
    winner: int | None
    margin: float
    cosine_margin: float

    def __post_init__(self) -> None:
        if (self.winner is None) != (len(self.votes) == 0):
            raise ValueError(f"Ballot: winner {self.winner} of {len(self.votes)} candidates")


def likeness(similarity: Float32[np.ndarray, "n k"], boxes: Boxes) -> Float32[np.ndarray, " n"]:
    """Each candidate's mean cosine with the references; in unfamiliar views the greatest, and its
    proof added where points were compared.
    """
    if not len(similarity):
        return np.zeros(0, np.float32)
    if boxes.familiar:
        return similarity.mean(axis=1)
    greatest = similarity.max(axis=1)
    if boxes.proof is None:
        return greatest
    return greatest + boxes.proof


SAME = 1e-6
"""Cosines closer than this are equal, so that rounding never decides an election."""


def election_scores(
    similarity: Float32[np.ndarray, "n k"], boxes: Boxes
) -> Float32[np.ndarray, "n k"]:
    """What the vote compares: cosines, and what points proved where they were compared.

    That counts from the view's greatest, so no score is above its cosine.
    """
    return similarity + _evidence(boxes)[:, None]


def best_of_references(scores: Float32[np.ndarray, "n k"]) -> Int64[np.ndarray, " k"]:
    """The candidate that each reference votes for, given `election_scores` of at least one."""
    return (scores >= scores.max(axis=0) - SAME).argmax(axis=0)


def _evidence(boxes: Boxes) -> Float32[np.ndarray, " n"]:
    """Each box's proof, less the greatest."""
    evidence = np.zeros(len(boxes), np.float32) if boxes.proof is None else boxes.proof
    return evidence - evidence.max(initial=-np.inf)


@value
class Grounding:
    """Why a view's box was chosen, or none: everything that the vote saw at t = 0 (P 3.3).

    `similarity[i, k]` is cos(e_i, z_k). `winner` is the candidate that is tracked and tinted: the
    ballot's, unless cross-view association or the simulator chose otherwise; None where the object
    is not visible in this view. `rejected` is the candidate that was chosen, but whose `likeness`
    is below `threshold`: the object is not in view. Without a threshold nothing is rejected, as in
    the paper."""

    camera: str
    object: str
    candidates: Boxes
    similarity: Float32[np.ndarray, "n k"]
    ballot: Ballot
    winner: int | None
    masks: Bool[np.ndarray, "n h w"]
    threshold: float | None = None
    rejected: int | None = None

    @property
    def chosen(self) -> int | None:
        """The winner, or the candidate that would be it if it were like enough."""
        return self.winner if self.rejected is None else self.rejected

    @property
    def overruled(self) -> bool:
        """Whether another candidate than the elected one is chosen, or none."""
        return self.chosen != self.ballot.winner

    @property
    def likeness(self) -> Float32[np.ndarray, " n"]:
        """`likeness` of every candidate."""
        return likeness(self.similarity, self.candidates)

    @property
    def evidence(self) -> Float32[np.ndarray, " n"]:
        """What the vote adds to every candidate's cosines, at most 0."""
        return _evidence(self.candidates)

    @property
    def voted(self) -> Int64[np.ndarray, " k"]:
        """The candidate that each reference votes for; empty without candidates."""
        if not len(self.similarity):
            return np.zeros(0, np.int64)
        return best_of_references(election_scores(self.similarity, self.candidates))

    @property
    def mask(self) -> Mask | None:
        return None if self.winner is None else self.masks[self.winner]


@value
class Association:
    """Why every view got its candidate when all views were asked together for one target (SPEC
    section 9).

    Scores are natural logarithms. `chosen[camera]` is a candidate, or None: not visible there.
    `total` is the chosen combination's score, `terms` its parts by name, and `margin` its lead over
    the best combination that shares no candidate with it.
    `support[camera]` holds the best total of any combination with each candidate of that view, and
    last with none."""

    chosen: Mapping[str, int | None]
    total: float
    margin: float
    terms: Mapping[str, float]
    support: Mapping[str, Float64[np.ndarray, " _"]]


@value
class Event:
    """Something worth finding again in a recording, at one control step."""

    frame_index: int
    level: Literal["INFO", "WARN", "ERROR"]
    text: str


@value
class Track:
    """One target in one view at one step: its mask, None while it is not visible, and the tracker's
    confidence in [0, 1]."""

    mask: Mask | None
    score: float

    def __post_init__(self) -> None:
        if not 0 <= self.score <= 1 or isinstance(self.mask, np.ma.MaskedArray):
            raise ValueError(f"Track: score {self.score} outside [0, 1], or a masked array")


@value
class Attended:
    """What the method gives to the policy at one control step, and the evidence for it.

    `images` are the prompted views, `text` the rewritten instruction; `tracks[camera][j]` is target
    j in that view.
    `groundings[camera][j]` stays the same through an episode. `associations[j]` does too; there are
    none unless views are associated, and None stands where fewer than two views had candidates.
    `colours[j]` tints target j."""

    images: Views
    text: str
    colours: tuple[Colour, ...]
    tracks: Mapping[str, tuple[Track, ...]]
    groundings: Mapping[str, tuple[Grounding, ...]]
    events: tuple[Event, ...]
    associations: tuple[Association | None, ...] = ()


@value
class Camera:
    """A calibrated pinhole camera: `k` in pixels; `pose_world` maps camera (OpenCV axes) to world,
    4 x 4, where z = 0 is the table. Of one that is not `calibrated` both are made up."""

    name: str
    width: int
    height: int
    k: Float64[np.ndarray, "3 3"]
    pose_world: Float64[np.ndarray, "4 4"]
    calibrated: bool = True
