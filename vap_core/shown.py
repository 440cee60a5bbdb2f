"""What the prompts of one control step covered, by the simulator's truth: kept beside every frame, so that a failure can be explained."""

from collections.abc import Mapping

import numpy as np

from vap_core.detect import box_iou
from vap_core.segment import bounds, iou
from vap_core.values import Attended, Grounding, Mask, Shown, Truth

MOST = 0.5
"""Share of a mask that must lie on one object for the mask to be that object's."""


def shown(attended: Attended, truth: Truth, target: str, *, opening: bool) -> tuple[Shown, ...]:
    """Every view's prompt for the first target of the instruction; `truth` has masks. `opening`: t = 0, when proposals count, too."""
    return tuple(
        _view(camera, tracks[0].mask, truth.masks[camera], target, attended.groundings[camera][0] if opening else None)
        for camera, tracks in attended.tracks.items()
    )


def _view(camera: str, mask: Mask | None, masks: Mapping[str, Mask], target: str, grounding: Grounding | None) -> Shown:
    true = masks.get(target)
    pixels = 0 if true is None else int(true.sum())
    overlap = iou(mask, true) if mask is not None and true is not None and mask.any() else 0.0
    return Shown(camera, covered(mask, masks), overlap, pixels, float("nan") if grounding is None or not pixels else _proposed(grounding, true))


def covered(mask: Mask | None, masks: Mapping[str, Mask]) -> str | None:
    """The object on which most of a mask lies, "" when there is none such; None for no mask, or an empty one."""
    if mask is None or not mask.any():
        return None
    on = {name: int((mask & other).sum()) for name, other in masks.items()}
    best = max(on, key=lambda name: on[name], default="")
    return best if best and on[best] >= MOST * int(mask.sum()) else ""


def _proposed(grounding: Grounding, true: Mask | None) -> float:
    box = None if true is None else bounds(true)
    if box is None or not len(grounding.candidates):
        return 0.0
    return float(np.max(box_iou(grounding.candidates.xyxy, box[None])))
