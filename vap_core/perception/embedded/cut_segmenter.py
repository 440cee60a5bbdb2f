"""Masks of photos: GrabCut, started from what the segmenter, which has seen renders only, makes of
them.

In views of the world that the segmenter was trained on its masks stay as they are. On 20 objects of
seven photos the mean IoU from true boxes is .83 [.78, .88] with GrabCut and .77 without, from boxes
whose edges are off by up to a tenth .79 and .72; a box takes 39 ms more.
"""

from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from vap_core.base.types import Boxes, Mask, Rgb
from vap_core.perception.embedded import segmenter
from vap_core.perception.embedded.segmenter import LiteSegmenter, likely_pixels, window_around

SIDE = 160
"""Pixels of the square window in which GrabCut runs."""
ITERATIONS = 4
UNLIKELY, SURE = 0.35, 0.9
"""The segmenter's probability below which a pixel of the box is probably background, and above
which it is foreground for sure."""
LEAST_PX = 64
"""The longer side of a box from which on GrabCut has colours enough to learn from."""
LEAST_SHARE = 0.05
"""Of the box: a smaller mask of GrabCut is none, and the segmenter's stays."""


class CutSegmenter:
    """The segmenter's masks in familiar views, and masks by GrabCut in others."""

    def __init__(self, lite: LiteSegmenter) -> None:
        self.lite = lite

    def __call__(self, image: Rgb, boxes: Boxes) -> Bool[np.ndarray, "n h w"]:
        probability = self.lite.mask_probability(image, boxes.xyxy)
        masks = likely_pixels(probability)
        if boxes.familiar:
            return masks
        sides = (boxes.xyxy[:, 2:] - boxes.xyxy[:, :2]).max(axis=1, initial=0.0)
        for i in np.flatnonzero(sides >= LEAST_PX):
            refined = refine(image, boxes.xyxy[i], probability[i])
            if refined is not None:
                masks[i] = refined
        return masks


def refine(
    image: Rgb, box_xyxy: Float[np.ndarray, "4"], probability: Float32[np.ndarray, "h w"]
) -> Mask | None:
    """The object in the box, given each pixel's probability to belong to it.

    None where GrabCut has nothing to tell apart, or leaves nearly nothing of the box.
    """
    h, w = image.shape[:2]
    left, top, side = window_around(box_xyxy)
    x0, y0 = max(left, 0), max(top, 0)
    x1, y1 = min(left + side, w), min(top + side, h)
    scale = min(1.0, SIDE / side)
    size = (max(8, round((x1 - x0) * scale)), max(8, round((y1 - y0) * scale)))
    part = cv2.resize(image[y0:y1, x0:x1], size, interpolation=cv2.INTER_AREA)
    likely = cv2.resize(probability[y0:y1, x0:x1], size, interpolation=cv2.INTER_LINEAR)
    scale_xy = np.array(size) / (x1 - x0, y1 - y0)
    corners = (box_xyxy.reshape(2, 2) - (x0, y0)) * scale_xy
    labels = _first_labels(likely, np.round(corners).astype(int).clip(0, size))
    if len(np.unique(labels & 1)) < 2:  # odd labels are foreground
        return None
    cv2.setRNGSeed(0)  # GrabCut's clusters start at random
    bgr = np.ascontiguousarray(part[..., ::-1])
    models = np.zeros((2, 1, 65))
    nowhere = (0, 0, 1, 1)  # not read where labels are given
    cv2.grabCut(bgr, labels, nowhere, models[0], models[1], ITERATIONS, cv2.GC_INIT_WITH_MASK)
    inside = (labels & 1).astype(np.float32)
    if inside.sum() < LEAST_SHARE * np.prod(corners[1] - corners[0]):
        return None
    mask = np.zeros((h, w), bool)
    whole = cv2.resize(inside, (x1 - x0, y1 - y0), interpolation=cv2.INTER_LINEAR)
    mask[y0:y1, x0:x1] = whole > 0.5
    return mask


def _first_labels(
    likely: Float32[np.ndarray, "h w"], corners: np.ndarray
) -> UInt8[np.ndarray, "h w"]:
    """What GrabCut starts from: outside of the box all is background."""
    labels = np.full(likely.shape, cv2.GC_BGD, np.uint8)
    (x0, y0), (x1, y1) = corners.tolist()
    of_box = np.full((y1 - y0, x1 - x0), cv2.GC_PR_FGD, np.uint8)
    inner = likely[y0:y1, x0:x1]
    of_box[inner < UNLIKELY] = cv2.GC_PR_BGD
    of_box[inner > SURE] = cv2.GC_FGD
    labels[y0:y1, x0:x1] = of_box
    return labels


@cache
def load() -> CutSegmenter:
    """The shipped segmenter of any view.

    Raises: MissingWeights: a file of data/weights is absent or damaged.
    """
    return CutSegmenter(segmenter.load())
