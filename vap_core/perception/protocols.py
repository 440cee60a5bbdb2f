"""The four frozen models of the method as protocols, and the stack that holds one of each."""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Int64

from vap_core.base.errors import BadOutput
from vap_core.base.files import parse_json, write_atomic, writing
from vap_core.base.types import Boxes, Rgb, Track


@runtime_checkable
class Detector(Protocol):
    """Finds every box that matches an open-vocabulary phrase (P 3.3).

    Or proposes boxes of any object.
    """

    def __call__(
        self, images: Sequence[Rgb], phrase: str, threshold: float | None = None
    ) -> list[Boxes]:
        """One `Boxes` per image, best first, in that image's pixels.

        A `Boxes` is empty when nothing scores `threshold` (None: the detector's own).
        """
        ...


@runtime_checkable
class FamiliarityJudge(Protocol):
    """A detector that knows whether a view is of the world that its stack was trained on."""

    def is_familiar(self, image: Rgb, phrase: str) -> bool:
        """The `Boxes.familiar` of boxes that are given by hand."""
        ...


@runtime_checkable
class ReferenceCropper(Protocol):
    """A detector that looks for the object of a reference photo otherwise than in a scene."""

    def reference_boxes(
        self, photo: Rgb, phrase: str, threshold: float
    ) -> tuple[Boxes, Float32[np.ndarray, " n"]]:
        """Where the object may be, and the evidence for each; empty below `threshold`."""
        ...


@runtime_checkable
class Encoder(Protocol):
    """Embeds crops (P 3.3, f).

    `name` is stored with every memory, because rows of different encoders cannot be compared.
    """

    name: str

    def __call__(self, crops: Sequence[Rgb]) -> Float32[np.ndarray, "n d"]:
        """One L2-normalised row per crop; n may be 0."""
        ...


@runtime_checkable
class Verifier(Protocol):
    """Compares crops with references point by point, which an embedding as a whole cannot."""

    def __call__(self, crops: Sequence[Rgb], references: Sequence[Rgb]) -> Int64[np.ndarray, "n k"]:
        """How many points of each crop lie as they do on each reference."""
        ...


@runtime_checkable
class Segmenter(Protocol):
    """Masks the object inside each box (P 3.3)."""

    def __call__(self, image: Rgb, boxes: Boxes) -> Bool[np.ndarray, "n h w"]:
        """One mask per box, in the boxes' order; n may be 0."""
        ...


@runtime_checkable
class Tracker(Protocol):
    """Follows every identity of each view (P 3.3).

    State is argument and result. A step leaves the states that it is given as they are: where one
    episode fails, those of the others are stepped again.
    """

    def start(
        self, images: Sequence[Rgb], masks: Sequence[Bool[np.ndarray, "_n _h _w"]]
    ) -> list[Any]:
        """One state per view (t = 0); row i of a view's masks is identity i."""
        ...

    def step(
        self, states: Sequence[Any], images: Sequence[Rgb]
    ) -> tuple[list[Any], list[tuple[Track, ...]]]:
        """The next frame of every view: one `Track` per identity, in order."""
        ...


@runtime_checkable
class TargetTracker(Protocol):
    """A tracker that can follow a few identities and know the others from t = 0 only."""

    def start_targets(
        self,
        images: Sequence[Rgb],
        masks: Sequence[Bool[np.ndarray, "_n _h _w"]],
        targets: Sequence[Sequence[int]],
    ) -> list[Any]:
        """As `Tracker.start`, but only the `targets` of a view are followed.

        Every other identity is evidence of what they are not; its tracks have no mask.
        """
        ...


class JudgedDetector:
    """A detector of any boxes, and what another says of their views: whether these are familiar."""

    def __init__(self, detector: Detector, judge: FamiliarityJudge) -> None:
        self.detector = detector
        self.is_familiar = judge.is_familiar
        if isinstance(detector, ReferenceCropper):
            self.reference_boxes = detector.reference_boxes

    def __call__(
        self, images: Sequence[Rgb], phrase: str, threshold: float | None = None
    ) -> list[Boxes]:
        """The detector's boxes; a view without any is judged, too."""
        return [
            replace(boxes, familiar=self.is_familiar(image, phrase))
            for image, boxes in zip(images, self.detector(images, phrase, threshold), strict=True)
        ]


def judged_by(judge: FamiliarityJudge, detector: Detector) -> Detector:
    """The detector with the judge's word on familiarity, unless it has one of its own."""
    if isinstance(detector, FamiliarityJudge):
        return detector
    return JudgedDetector(detector, judge)


@dataclass(frozen=True)
class Thresholds:
    """The least `Grounding.likeness` of an object that is in view, in familiar and other views.

    `together` is about all familiar views of an episode: the object is in none of them unless the
    best view's likeness, less `attend.OF_AGREEMENT` times the mean cosine among the references,
    reaches it, or the likeness is `attend.MOST_ASKED`.
    """

    familiar: float
    unfamiliar: float
    together: float | None = None


@dataclass(frozen=True)
class Stack:
    """The four frozen models.

    `by_category` finds boxes of the phrase's category alone; None where `detector` does.
    `unfamiliar_encoder` embeds crops of views that are not `Boxes.familiar`, and the references for
    them, from the crops that a memory keeps; None: `encoder` does.
    `verifier` compares crops of such views with the references point by point.
    `thresholds` is None where none were measured: then the best candidate wins, however unlike.
    """

    name: str
    detector: Detector
    encoder: Encoder
    segmenter: Segmenter
    tracker: Tracker
    by_category: Detector | None = None
    unfamiliar_encoder: Encoder | None = None
    thresholds: Thresholds | None = None
    verifier: Verifier | None = None

    def with_parts(
        self,
        name: str,
        *,
        detector: Detector | None = None,
        encoder: Encoder | None = None,
        segmenter: Segmenter | None = None,
        tracker: Tracker | None = None,
    ) -> "Stack":
        """A stack with parts of your own, without what was measured for those that they replace.

        With another encoder it has no `unfamiliar_encoder`, with another detector or encoder
        neither `thresholds` nor a `verifier`. Where the encoder or the segmenter stays, which tell
        familiar views from others, this stack's detector still says which are, unless `detector`
        does itself (`FamiliarityJudge`).
        """
        roles = ("detector", "encoder", "segmenter", "tracker")
        given = zip(roles, (detector, encoder, segmenter, tracker), strict=True)
        changed: dict[str, Any] = {role: part for role, part in given if part is not None}
        if encoder is not None:
            changed["unfamiliar_encoder"] = None
        stays = encoder is None or segmenter is None
        if detector is not None and stays and isinstance(self.detector, FamiliarityJudge):
            changed["detector"] = judged_by(self.detector, detector)
        if detector is not None or encoder is not None:
            changed |= {"thresholds": None, "verifier": None}
        return replace(self, name=name, **changed)

    @property
    def category_detector(self) -> Detector:
        """What says where things of one kind are, to scripted policies and surveys."""
        return self.by_category or self.detector

    def encoder_of(self, boxes: Boxes) -> Encoder:
        """The encoder of the view in which these boxes are."""
        if boxes.familiar or self.unfamiliar_encoder is None:
            return self.encoder
        return self.unfamiliar_encoder


def thresholds_file(folder: Path, kind: str) -> Path:
    """Where the thresholds of a stack are kept."""
    return folder / f"thresholds-{re.sub(r'[^\w.=-]+', '_', kind)}.json"


def keep_command(kind: str, photos: bool) -> str:
    """The command that measures a stack's thresholds and keeps them, on photos too where asked."""
    on_photos = " --photos SET" if photos else ""
    return f"./vap measure calibration --stack {kind}{on_photos} --keep"


def keep_thresholds(folder: Path, kind: str, encoder: str, thresholds: Thresholds) -> Path:
    """Write a stack's thresholds, which hold for one encoder. Raises: BadOutput."""
    path = thresholds_file(folder, kind)
    about = {
        "encoder": encoder,
        "familiar": thresholds.familiar,
        "unfamiliar": thresholds.unfamiliar,
    }
    with writing(path, "calibrate", "make room, or point VAP_WEIGHTS at another folder"):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path, (json.dumps(about, indent=1) + "\n").encode())
    return path


def read_thresholds(folder: Path, kind: str, encoder: str) -> Thresholds | None:
    """What `keep_thresholds` wrote; None where there is nothing, or nothing for this encoder.

    Raises: BadOutput: the file is damaged.
    """
    from vap_core.perception.foundation.weights import needs_photos

    path = thresholds_file(folder, kind)
    if not path.is_file():
        return None
    try:
        about = parse_json(path.read_bytes())
        if about["encoder"] != encoder:
            return None
        thresholds = Thresholds(float(about["familiar"]), float(about["unfamiliar"]))
        if not (math.isfinite(thresholds.familiar) and math.isfinite(thresholds.unfamiliar)):
            raise ValueError(f"{thresholds} are no thresholds")
        return thresholds
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadOutput(
            f"load_stack: {path} is damaged; delete it and run "
            f"{keep_command(kind, needs_photos(kind))}."
        ) from error
