"""What the prompts of one control step cover, by ground truth.

It is kept beside every frame, so that a failure can be explained.
"""

from collections.abc import Mapping

import numpy as np

from vap_core.base.types import Attended, Grounding, Mask
from vap_core.perception.boxes import box_iou, mask_box, mask_iou
from vap_core.rollout.types import MaskCoverage
from vap_core.simulation.types import Truth

MAJORITY = 0.5
"""The share of a mask that must lie on an object for the mask to cover it."""


def mask_coverage(
    attended: Attended, truth: Truth, target: str, *, opening: bool
) -> tuple[MaskCoverage, ...]:
    """Every view's prompt for the first target of the instruction; `truth` has masks.

    `opening`: t = 0, when proposals count too, of a method that grounds.
    """
    found = []
    for camera, tracks in attended.tracks.items():
        if not tracks:
            continue
        mask = tracks[0].mask
        masks = truth.masks[camera]
        true = masks.get(target)
        pixels = 0 if true is None else int(true.sum())
        overlap = 0.0
        if mask is not None and true is not None and mask.any():
            overlap = mask_iou(mask, true)
        proposal = float("nan")
        groundings = attended.groundings.get(camera, ())
        if opening and groundings and true is not None and pixels:
            proposal = best_proposal(groundings[0], true)
        coverage = MaskCoverage(
            camera=camera,
            object=covered_object(mask, masks),
            iou=overlap,
            pixels=pixels,
            proposal=proposal,
        )
        found.append(coverage)
    return tuple(found)


def covered_object(mask: Mask | None, masks: Mapping[str, Mask]) -> str | None:
    """The object on which most of a mask lies, "" when there is none such.

    None for no mask, or an empty one.
    """
    if mask is None or not mask.any():
        return None
    best = ""
    most = 0
    for name, of_object in masks.items():
        pixels = int((mask & of_object).sum())
        if pixels > most:
            best = name
            most = pixels
    if most >= MAJORITY * int(mask.sum()):
        return best
    return ""


def best_proposal(grounding: Grounding, true: Mask) -> float:
    """The best box IoU of any candidate with the target's true mask."""
    box = mask_box(true)
    if box is None or not len(grounding.candidates):
        return 0.0
    overlap = box_iou(grounding.candidates.xyxy, box[None])
    return float(np.max(overlap))
