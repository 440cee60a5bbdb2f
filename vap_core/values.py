"""The values that walk through the house: frozen, and checked against their shapes when they are built.

Conventions, everywhere inside the house: images are RGB, height x width x 3, uint8. Boxes are `x0 y0 x1 y1` in pixels,
x to the right and y down, the far corner exclusive. Lengths are metres, angles radians, times seconds. A pose is
`x y z qw qx qy qz` in the world frame (z up). Cameras follow OpenCV: x right, y down, z into the scene.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, dataclass_transform

import numpy as np
from beartype import beartype
from jaxtyping import Bool, Float32, Float64, Int64, UInt8, jaxtyped

Rgb = UInt8[np.ndarray, "_ _ 3"]
Mask = Bool[np.ndarray, "_ _"]
Pose = Float64[np.ndarray, "7"]
Action = Float32[np.ndarray, " a"]
"""One control step. End-effector control, a = 7: `dx dy dz` (m) and the rotation vector `drx dry drz` (rad) in the robot base
frame, then `gripper` 0 closed .. 1 open. Joint control, a = n + 1: the change of every joint angle (rad), then `gripper`."""
EE_ACTION = ("dx", "dy", "dz", "drx", "dry", "drz", "gripper")
Chunk = Float32[np.ndarray, "t a"]
"""Actions to come, one row per control step."""

Views = Mapping[str, Rgb]
"""One image per camera, keyed by the camera's name."""


@dataclass_transform(frozen_default=True, eq_default=False)
def value[T](cls: type[T]) -> type[T]:
    """Make `cls` a frozen dataclass whose fields are checked against their annotated types and shapes when built."""
    return jaxtyped(typechecker=beartype)(dataclass(frozen=True, slots=True, eq=False)(cls))


@value
class Boxes:
    """Category-level proposals of one view (P 3.3): n may be 0, which is a result and not an error."""

    xyxy: Float32[np.ndarray, "n 4"]
    score: Float32[np.ndarray, " n"]
    phrase: str

    def __post_init__(self) -> None:
        if len(self.xyxy) and not (self.xyxy[:, 2:] > self.xyxy[:, :2]).all():
            raise ValueError(f"Boxes: far corner must exceed near corner, got {self.xyxy.tolist()}")

    def __len__(self) -> int:
        return len(self.xyxy)

    @staticmethod
    def empty(phrase: str) -> "Boxes":
        return Boxes(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), phrase)


@value
class Description:
    """What an object looks like, in words that can follow "my cup is": a few, and as many as tell it apart."""

    short: str
    long: str


@value
class PersonalObject:
    """One remembered object: K reference crops and their embeddings Z_o (P 3.3), rows L2-normalised."""

    name: str
    category: str
    embeddings: Float32[np.ndarray, "k d"]
    crops: tuple[Rgb, ...]
    encoder: str
    description: Description | None = None

    def __post_init__(self) -> None:
        if len(self.crops) != len(self.embeddings) or not self.crops:
            raise ValueError(
                f"PersonalObject {self.name!r}: {len(self.crops)} crops for {len(self.embeddings)} embeddings; one each, and at least one"
            )
        norm = np.linalg.norm(self.embeddings, axis=1)
        if not np.allclose(norm, 1.0, atol=1e-3):
            raise ValueError(f"PersonalObject {self.name!r}: embeddings must be L2-normalised, got norms {norm.tolist()}")


@value
class Target:
    """One personalised span of an instruction: `text[start:stop]` is e.g. "my cup", owner "my", category "cup"."""

    start: int
    stop: int
    owner: str
    category: str


@value
class Instruction:
    """A parsed instruction: its text and its personalised spans, left to right and disjoint."""

    text: str
    targets: tuple[Target, ...]


@value
class Colour:
    """A nameable tint."""

    name: str
    rgb: tuple[int, int, int]


@value
class Grounding:
    """Why a view's box won, or that none did: everything the vote saw at t = 0 (P 3.3).

    `similarity[i, k]` is cos(e_i, z_k); `votes[i]` counts references whose best candidate is i; `tied` marks the
    candidates that shared the most votes; `margin` is (votes of the winner - most votes of any other) / K, in [0, 1] when votes decide,
    and `cosine_margin` the same difference of mean cosines (winner - best other; 2 when there is no other candidate).
    `winner` is what the vote elected, None exactly when there is no candidate; unless cross-view association chose otherwise: then `overruled`
    is what the vote elected, and `winner` what was chosen for it, None where the object is not visible in this view.
    """

    camera: str
    object: str
    candidates: Boxes
    similarity: Float32[np.ndarray, "n k"]
    votes: Int64[np.ndarray, " n"]
    tied: Bool[np.ndarray, " n"]
    winner: int | None
    margin: float
    cosine_margin: float
    masks: Bool[np.ndarray, "n h w"]
    overruled: int | None = None

    def __post_init__(self) -> None:
        if (self.elected is None) != (len(self.candidates) == 0):
            raise ValueError(f"Grounding {self.camera}: elected {self.elected} of {len(self.candidates)} candidates")
        if self.overruled is not None and self.overruled == self.winner:
            raise ValueError(f"Grounding {self.camera}: candidate {self.winner} cannot overrule itself")

    @property
    def elected(self) -> int | None:
        """The vote's winner, to which votes, ties and margins refer."""
        return self.winner if self.overruled is None else self.overruled

    @property
    def mask(self) -> Mask | None:
        return None if self.winner is None else self.masks[self.winner]


@value
class Association:
    """Why every view got the candidate it did when all views were asked together for one target (SPEC section 9; module associate).

    Scores are natural logarithms. `chosen[camera]` is a candidate, or None: not visible there. `total` is the chosen combination's score,
    `terms` its parts by name, and `margin` its lead over the best combination that differs in any view. `support[camera]` has the best total
    of any combination with each candidate of that view, and last with none.
    """

    chosen: Mapping[str, int | None]
    total: float
    margin: float
    terms: Mapping[str, float]
    support: Mapping[str, Float64[np.ndarray, " _"]]


@value
class Event:
    """Something a researcher wants to find afterwards, at one control step."""

    frame_index: int
    level: Literal["INFO", "WARN", "ERROR"]
    text: str


@value
class Track:
    """One target in one view now: its mask, or None while it is not visible, and the tracker's confidence in [0, 1]."""

    mask: Mask | None
    score: float


@value
class Attended:
    """What the method hands to the policy at one control step, and the evidence for it.

    `images` are the prompted views, `text` the rewritten instruction; `tracks[camera][j]` is target j in that view.
    `groundings[camera][j]` is constant through an episode, and so is `associations[j]`, of which there are none unless views are associated;
    None where fewer than two views had candidates. `colours[j]` tints target j.
    """

    images: Views
    text: str
    colours: tuple[Colour, ...]
    tracks: Mapping[str, tuple[Track, ...]]
    groundings: Mapping[str, tuple[Grounding, ...]]
    events: tuple[Event, ...]
    associations: tuple[Association | None, ...] = ()


@value
class Camera:
    """A calibrated pinhole camera: `k` in pixels; `pose_world` maps camera (OpenCV axes) to world, 4 x 4."""

    name: str
    width: int
    height: int
    k: Float64[np.ndarray, "3 3"]
    pose_world: Float64[np.ndarray, "4 4"]


@value
class PolicyInput:
    """All that a policy may read: images, text and proprioception. Never simulator state.

    `state` is `x y z` (m) of the gripper in the robot base frame, its rotation vector `rx ry rz` (rad) counted from straight
    down, so that a turn about the vertical reads (0, 0, yaw), gripper opening 0..1, then the arm's joint angles (rad).
    """

    images: Views
    text: str
    state: Float32[np.ndarray, " s"]


ROBOT, REST = "robot", "rest"
"""Partners of a contact that are no object: the arm with its gripper, and the table, floor and walls."""


@value
class Truth:
    """Simulator ground truth after one control step; read by metrics, recordings and tests, never by a policy that is evaluated."""

    objects_world: Mapping[str, Pose]
    links_world: Mapping[str, Pose]
    touched: tuple[str, ...]
    """Objects that the robot touched during this control step, in the order of their first contact in it."""
    pressed_s: Mapping[str, float]
    """Longest unbroken contact of the gripper with an object, seconds, up to now and over step borders; objects it touched in this step."""
    contacts: Mapping[str, frozenset[str]]
    """At the end of the step: what every touching object touches (other objects, ROBOT, REST)."""
    masks: Mapping[str, Mapping[str, Mask]] = field(default_factory=dict)
    """`masks[camera][object]`: visible pixels; empty when masks were not asked for."""

    @property
    def held(self) -> frozenset[str]:
        """Objects that touch the robot and nothing else."""
        return frozenset(name for name, partners in self.contacts.items() if partners == {ROBOT})


@value
class Placement:
    """An object of an episode: `model` names it in the object registry; it starts at (x, y) metres, turned by yaw radians."""

    model: str
    x: float
    y: float
    yaw: float


Rule = Literal["picked", "near", "put", "selected"]
"""When an episode has succeeded (SPEC section 6); see suites.rules."""


@value
class EpisodeRow:
    """One row of an episode list: everything that decides how an episode starts, and when it has succeeded.

    `placements[0]` is the target; `goal` names the placed object that it goes to ("" when there is none). `split` is the track within
    the suite, `variant` the look of the room (suites.VARIANTS), `cameras` the views that the policy gets.
    """

    suite: str
    task: str
    episode: int
    seed: int
    instruction: str
    category: str
    placements: tuple[Placement, ...]
    max_steps: int
    rule: Rule = "picked"
    goal: str = ""
    split: str = ""
    variant: str = "base"
    cameras: tuple[str, ...] = ()

    @property
    def target(self) -> str:
        return self.placements[0].model

    @property
    def key(self) -> str:
        return f"{self.suite}.{self.task}.{self.episode:03d}"


@value
class Opening:
    """What is known before the first action: written once at the head of a recording."""

    row: EpisodeRow
    method: str
    policy: str
    hz: float
    cameras: tuple[Camera, ...]
    instruction: str
    rewritten: str
    groundings: Mapping[str, tuple[Grounding, ...]]
    target_sizes_m: Mapping[str, tuple[float, float, float]]
    """Full extents of every object's bounding box, by model name."""
    action_names: tuple[str, ...] = EE_ACTION
    associations: tuple[Association | None, ...] = ()
    """Those of `Attended`."""
    references: Mapping[str, tuple[Rgb, ...]] = field(default_factory=dict)
    """The remembered crops of every object that could be meant, by name."""


@value
class Shown:
    """What the prompt covered in one view at one control step, by the simulator: for diagnosis alone, no method reads it.

    `object` is what the mask lies on: an object's name, "" for none in particular, None where nothing is highlighted. `iou` is the mask's with the
    target's visible pixels, of which there are `pixels`. `proposal`, at t = 0, is the best box IoU of any candidate with the target; else nan.
    """

    camera: str
    object: str | None
    iou: float
    pixels: int
    proposal: float


@value
class Frame:
    """One control step: what was seen, what the policy was shown, what it did. `action` was decided from `images`; the terminal frame of an
    episode has none (None), because nothing is executed after it.

    `shown` has an entry per view at steps whose images were prompted. `attention`, at steps in which the policy was watched deciding, is the share
    of its attention that every image patch of a view got.
    """

    frame_index: int
    timestamp_s: float
    images: Views
    prompted: Views
    tracks: Mapping[str, tuple[Track, ...]]
    cameras: tuple[Camera, ...]
    state: Float32[np.ndarray, " s"]
    action: Action | None
    truth: Truth
    events: tuple[Event, ...]
    shown: tuple[Shown, ...] = ()
    attention: Mapping[str, Float32[np.ndarray, "_ _"]] = field(default_factory=dict)

    def light(self) -> "Frame":
        """The same step without its pictures, to keep in memory."""
        return replace(self, images={}, prompted={}, tracks={}, truth=replace(self.truth, masks={}), attention={})


@value
class Outcome:
    """How an episode ended (P 5.1): `success` at the end, `success_once` at any step, `held_steps` the longest run of steps in which the rule held.

    `cmr` is None where the paper defines none (selection).
    """

    status: Literal["success", "failure", "error"]
    success: bool
    success_once: bool
    held_steps: int
    cmr: bool | None
    wrong_object: bool
    first_object_correct: bool
    steps: int
    detail: str = ""
    touched: bool = False
    """Whether the robot touched or moved any object but the goal."""


@value
class Call:
    """One policy call of one episode, and one thing that it consumed: a camera's image, or the text.

    `changed` says whether the prompt changes it: pixels tinted in that view, or words rewritten. `consumed` and `raw` are digests of what the
    policy consumed of the prompted and of the raw input.
    """

    step: int
    name: str
    changed: bool
    pixels: int
    consumed: str
    raw: str

    @property
    def sound(self) -> bool:
        """What the prompt changes, changes what is consumed, and nothing else does."""
        return (self.consumed != self.raw) == self.changed


@value
class Episode:
    """A finished episode. `seconds` sums wall time by part: physics, render, attend, policy, record, ...; `calls` are there when it was audited."""

    opening: Opening
    frames: tuple[Frame, ...]
    outcome: Outcome
    seconds: Mapping[str, float]
    calls: tuple[Call, ...] = ()

    @property
    def key(self) -> tuple[str, str, str, int, int]:
        """Suite, task, method, seed and episode: what names it in a run."""
        row = self.opening.row
        return row.suite, row.task, self.opening.method, row.seed, row.episode

    def summary(self) -> dict[str, Any]:
        """One flat row for a results table."""
        row, out = self.opening.row, self.outcome
        margins = [g.margin for per_view in self.opening.groundings.values() for g in per_view]
        return {
            "suite": row.suite,
            "task": row.task,
            "split": row.split,
            "variant": row.variant,
            "episode": row.episode,
            "seed": row.seed,
            "method": self.opening.method,
            "policy": self.opening.policy,
            "outcome": out.status,
            "success": out.success,
            "success_once": out.success_once,
            "held_steps": out.held_steps,
            "cmr": out.cmr,
            "wrong_object": out.wrong_object,
            "first_object_correct": out.first_object_correct,
            "touched": out.touched,
            "steps": out.steps,
            "margin": min(margins) if margins else None,
            "detail": out.detail,
            **{f"seconds_{part}": seconds for part, seconds in self.seconds.items()},
        }
