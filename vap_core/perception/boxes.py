"""Boxes and masks as arrays: overlap, bounds, and how crops are cut.

Boxes are `x0 y0 x1 y1` in pixels, far corner exclusive.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int64

from vap_core.base.types import Mask, Rgb

MARGIN = 0.03
"""Context kept around a crop on each side, as a fraction of the box's longer side; look-alikes
share their background, so it is small."""
NMS_IOU = 0.5
"""A box that overlaps a better one by more than this IoU is suppressed."""
MAX_BOXES = 10
"""Boxes that a detector returns for one phrase in one view."""
SAME_PLACE = 0.5
"""Of two boxes of which the smaller is covered by more than this share, one shows the place."""


def parse_box(text: str, told: str, error: type[Exception]) -> Float32[np.ndarray, "4"]:
    """A box that a person wrote as "x0,y0,x1,y1". Raises: `error`, beginning with `told`."""
    try:
        box = np.array([float(word) for word in text.split(",")], np.float32)
    except ValueError:
        box = np.empty(0, np.float32)
    if len(box) != 4:
        raise error(f"{told} {text!r} is not x0,y0,x1,y1; for example 40,60,180,220.")
    if not (np.isfinite(box).all() and (box[2:] - box[:2] >= 1).all() and box.max() > 1):
        raise error(
            f"{told} {text!r} has no area; give pixels, not fractions; x to the right, y down, far "
            "corner last."
        )
    return box


def crop(image: Rgb, box_xyxy: Float[np.ndarray, "4"], margin: float = MARGIN) -> Rgb:
    """The box with `margin` context, clipped to the image.

    References and candidates are cut alike.
    """
    x0, y0, x1, y1 = box_xyxy.tolist()
    extra = margin * max(x1 - x0, y1 - y0)
    h, w = image.shape[:2]
    left = int(np.clip(np.floor(x0 - extra), 0, w - 1))
    top = int(np.clip(np.floor(y0 - extra), 0, h - 1))
    right = int(np.clip(np.ceil(x1 + extra), left + 1, w))
    bottom = int(np.clip(np.ceil(y1 + extra), top + 1, h))
    return image[top:bottom, left:right].copy()


def box_iou(a: Float[np.ndarray, "n 4"], b: Float[np.ndarray, "m 4"]) -> Float[np.ndarray, "n m"]:
    """Intersection over union of every pair of boxes."""
    both, area_a, area_b = _overlaps(a, b)
    return both / np.maximum(area_a + area_b - both, 1e-9)


def box_cover(a: Float[np.ndarray, "n 4"], b: Float[np.ndarray, "m 4"]) -> Float[np.ndarray, "n m"]:
    """Intersection over the smaller box's area, of every pair of boxes."""
    both, area_a, area_b = _overlaps(a, b)
    return both / np.maximum(np.minimum(area_a, area_b), 1e-9)


def _overlaps(
    a: Float[np.ndarray, "n 4"], b: Float[np.ndarray, "m 4"]
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n 1"], Float[np.ndarray, "1 m"]]:
    """The area (px^2) that every pair of boxes shares, and the areas of the two boxes."""
    near = np.maximum(a[:, None, :2], b[None, :, :2])
    far = np.minimum(a[:, None, 2:], b[None, :, 2:])
    both = np.clip(far - near, 0, None).prod(-1)
    area_a = (a[:, 2:] - a[:, :2]).prod(-1)
    area_b = (b[:, 2:] - b[:, :2]).prod(-1)
    return both, area_a[:, None], area_b[None]


def suppress_overlaps(
    xyxy: Float32[np.ndarray, "n 4"],
    score: Float32[np.ndarray, " n"],
    *,
    iou: float = NMS_IOU,
    most: int = MAX_BOXES,
) -> Int64[np.ndarray, " k"]:
    """Non-maximum suppression: indices of at most `most` boxes, best first.

    A box that overlaps a better one by more than `iou` is left out. Scores are above 0.
    """
    # torchvision's finds the same, but takes 1.5 s to import.
    xywh = np.concatenate([xyxy[:, :2], xyxy[:, 2:] - xyxy[:, :2]], axis=1)
    kept = cv2.dnn.NMSBoxes(
        bboxes=xywh.tolist(),
        scores=score.tolist(),
        score_threshold=0.0,
        nms_threshold=iou,
    )
    return np.asarray(kept, np.int64).reshape(-1)[:most]


def other_places(
    xyxy: Float32[np.ndarray, "n 4"],
    order: Int64[np.ndarray, " m"],
    most: int,
    kept: Sequence[int] = (),
) -> Int64[np.ndarray, " k"]:
    """The boxes `kept`, and those next in `order` in other places, up to `most`; in order."""
    cover = box_cover(xyxy, xyxy)
    chosen = list(kept)
    for i in order.tolist():
        if len(chosen) < most and cover[i, chosen].max(initial=0.0) <= SAME_PLACE:
            chosen.append(i)
    return np.array(sorted(chosen), np.int64)


def mask_iou(one: Mask, other: Mask) -> float:
    """Intersection over union of two masks; two empty masks agree."""
    union = int((one | other).sum())
    if union == 0:
        return 1.0
    return int((one & other).sum()) / union


def mask_box(mask: Mask) -> Float32[np.ndarray, "4"] | None:
    """The box of a mask; None when it is empty."""
    rows = np.flatnonzero(mask.any(axis=1))
    cols = np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    return np.array([cols[0], rows[0], cols[-1] + 1, rows[-1] + 1], np.float32)
