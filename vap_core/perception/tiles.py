"""Small objects in large pictures: a detector that looks at overlapping tiles, too."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Bool, Float32, Int64

from vap_core.base.types import Boxes, Rgb
from vap_core.perception.boxes import suppress_overlaps
from vap_core.perception.protocols import Detector

SMALL_MEGAPIXELS = 3.0
"""From this size on a picture is worth looking at in tiles."""
GRID = 3
"""Tiles along each side; each is half as long as the picture, so that they overlap by half."""
NMS_IOU = 0.6
MOST_BOXES = 40
CUT_PX = 2
"""A box that comes this near to a tile's edge inside the picture is cut by it."""


class TiledDetector:
    """Any detector on the whole picture and on nine overlapping half-size tiles of it.

    Boxes that a tile cuts are left to the other tiles; the rest compete by score.
    """

    def __init__(self, detector: Detector) -> None:
        self.detector = detector

    def __call__(
        self, images: Sequence[Rgb], phrase: str, threshold: float | None = None
    ) -> list[Boxes]:
        found = []
        for image in images:
            corners = tile_corners(image.shape[0], image.shape[1])
            parts = [image]
            for x0, y0, x1, y1 in corners.tolist():
                parts.append(image[y0:y1, x0:x1])
            whole, *of_tiles = self.detector(parts, phrase, threshold)
            kept = [whole]
            for corner, boxes in zip(corners, of_tiles, strict=True):
                uncut = ~_cut_by_edge(boxes.xyxy, corner, image.shape[1], image.shape[0])
                shift = np.tile(corner[:2], 2).astype(np.float32)
                moved = replace(boxes, xyxy=boxes.xyxy + shift)
                kept.append(moved.take(np.flatnonzero(uncut)))
            found.append(_merge(kept))
        return found


def tile_corners(height: int, width: int) -> Int64[np.ndarray, "9 4"]:
    """Half-size tiles on a 3 x 3 grid, x0 y0 x1 y1."""
    tall, wide = -(-height // 2), -(-width // 2)
    corners = []
    for row, column in product(range(GRID), range(GRID)):
        y = (height - tall) * row // (GRID - 1)
        x = (width - wide) * column // (GRID - 1)
        corners.append([x, y, x + wide, y + tall])
    return np.array(corners, np.int64)


def _cut_by_edge(
    xyxy: Float32[np.ndarray, "n 4"], corner: Int64[np.ndarray, "4"], width: int, height: int
) -> Bool[np.ndarray, " n"]:
    """Which boxes of a tile touch an edge of it that is no edge of the picture."""
    x0, y0, x1, y1 = corner.tolist()
    near = (xyxy[:, :2] <= CUT_PX) & np.array([x0 > 0, y0 > 0])
    size = np.array([x1 - x0, y1 - y0])
    far = (xyxy[:, 2:] >= size - CUT_PX) & np.array([x1 < width, y1 < height])
    return near.any(axis=1) | far.any(axis=1)


def _merge(parts: Sequence[Boxes]) -> Boxes:
    """The best boxes, overlaps removed; `familiar` is that of the first, the whole picture."""
    xyxy = np.concatenate([part.xyxy for part in parts])
    score = np.concatenate([part.score for part in parts])
    prior = None
    if all(part.prior is not None for part in parts):
        prior = np.concatenate([part.prior for part in parts])
    if not len(xyxy):
        return parts[0]
    best = suppress_overlaps(xyxy, score, iou=NMS_IOU, most=MOST_BOXES)
    return replace(parts[0], xyxy=xyxy, score=score, prior=prior).take(best)
