"""Whether a stack does on this machine what it should: three known photos with hand-drawn boxes.

After a download, in about a minute: a stack whose weights or pre-processing are wrong fails here.
What is measured is held against what the same stack gave elsewhere, where that is stored, else
against the drawn boxes. It is no measure of quality: one object, which one scene has, partly
hidden, and two have not.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

from vap_core.attend import Attender, Prompting
from vap_core.base.files import DATA
from vap_core.evaluation.photos.folder import read_photo_set
from vap_core.evaluation.photos.measure import CAMERA
from vap_core.memory import load_photo, register
from vap_core.perception.boxes import box_iou, mask_box, mask_iou
from vap_core.perception.stacks import load_stack

PHOTOS = DATA / "photo-set"
LEAST_IOU = 0.5
SPREAD = 0.05
"""By how much a figure may differ from the stored one."""
PROPOSED = "IoU of the best proposed box with the drawn one"
ELECTED = "IoU of the elected box with the drawn one"
FILLED = "IoU of the box around the mask with the drawn one"
KEPT = "IoU of the mask with the track in the same picture"
LEAD = "likeness lead of the scene with the object"
STORED: Mapping[str, Mapping[str, float]] = {
    "embedded": {PROPOSED: 0.43, ELECTED: 0.24, FILLED: 0.24, KEPT: 1.0, LEAD: 0.65},
}
"""By stack. Nobody has run the foundation stacks' weights and stored theirs."""


@dataclass(frozen=True)
class Check:
    """One figure and what it was held against: the stored one, or the least that is asked for."""

    what: str
    measured: float
    stored: float | None
    least: float

    @property
    def holds(self) -> bool:
        if self.stored is None:
            return self.measured >= self.least
        return abs(self.measured - self.stored) <= SPREAD

    def __str__(self) -> str:
        against = f"at least {self.least:g}"
        if self.stored is not None:
            against = f"stored {self.stored:.2f}"
        mark = "ok    " if self.holds else "FAILED"
        return f"{mark}  {self.what:<52} {self.measured:5.2f}  ({against})"


def verify_stack(name: str, folder: Path = PHOTOS) -> tuple[list[Check], float]:
    """Run a stack on the known photos; also the seconds of one grounding.

    Raises: MissingWeights, UnknownName: the stack cannot be loaded; BadPhotoSet.
    """
    photo_set = read_photo_set(folder)
    (subject,) = photo_set.subjects
    stack = load_stack(name)
    photos = [load_photo(photo.path, long_side=None) for photo in subject.photos]
    obj, _ = register(subject.name, subject.category, photos, stack.detector, stack.encoder)
    attender = Attender(stack, {obj.name: obj}, Prompting(always_tint=True))
    figures = {PROPOSED: 0.0, ELECTED: 0.0, FILLED: 0.0, KEPT: 0.0}
    likeness = {True: -1.0, False: -1.0}
    seconds = 0.0
    for scene in photo_set.scenes:
        rgb = load_photo(scene.path, long_side=None)
        truth = scene.boxes[subject.name]
        started = perf_counter()
        state, attended = attender.start({CAMERA: rgb}, f"bring my {obj.category}")
        seconds = perf_counter() - started
        (grounding,) = attended.groundings[CAMERA]
        present = len(truth) > 0
        if grounding.winner is not None:
            best = float(grounding.likeness[grounding.winner])
            likeness[present] = max(likeness[present], best)
        if not present or grounding.winner is None:
            continue
        overlap = box_iou(grounding.candidates.xyxy, truth).max(axis=1)
        figures[PROPOSED] = float(overlap.max())
        figures[ELECTED] = float(overlap[grounding.winner])
        mask = grounding.mask
        assert mask is not None
        around = mask_box(mask)
        if around is not None:
            figures[FILLED] = float(box_iou(around[None], truth).max())
        _, again = attender.step(state, {CAMERA: rgb})
        track = again.tracks[CAMERA][0].mask
        if track is not None:
            figures[KEPT] = mask_iou(track, mask)
    stored = STORED.get(name, {})
    checks = []
    for what, figure in figures.items():
        checks.append(Check(what, figure, stored.get(what), LEAST_IOU))
    lead = likeness[True] - likeness[False]
    checks.append(Check(LEAD, lead, stored.get(LEAD), 0.0))
    return checks, seconds
