"""Local features with geometric verification: how many points of a crop lie as they do on a
reference.

An embedding says how alike two crops look as a whole. Points that agree in their surroundings and
in one affine map, which an accident hardly gives, show the same print. A look-alike of the same
brand shares a part of it, in other colours: so points count by the share of the crop, put onto the
reference by that map, that has the reference's colours.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64

from vap_core.base.types import Rgb, value
from vap_core.perception.embedded.encoder import stretch_contrast

SIDE = 256
"""Pixels of a crop's longer side, at which its points are found."""
MOST_ENLARGED = 3.0
"""A small crop is enlarged by no more than this."""
MOST_POINTS = 500
MOST_KEPT = 128
"""Crops whose points are kept, a third of a megabyte each."""
CONTRAST = 0.02
EDGE = 12.0
"""SIFT's least contrast, and greatest ratio of curvatures."""
RATIO = 0.85
"""A point's match is nearer than this share of the distance to the next best one."""
LEAST_MATCHES = 6
"""From which on an affine map is looked for."""
NEAR_PX = 6.0
"""How far from its mapped place a verified point may lie, in pixels of the crop of `SIDE`."""
MOST_SKEWED = 3.0
SMALLEST, LARGEST = 0.2, 5.0
"""An affine map of a view stretches one direction by at most `MOST_SKEWED` more than the other, and
scales lengths by no less and no more than these."""


CELL = 8
"""Pixels of the crop at `SIDE` that share one colour."""
SAME_COLOUR = 10.0
"""Greatest difference of either chroma, in 8-bit CIE Lab, of cells of one colour. Lightness is
free: it changes with the light."""


@value
class Points:
    """Points of a crop, in pixels of the crop at `SIDE`; rows of `rootsift` have length 1.

    `chroma` is the mean green-red and blue-yellow of every cell.
    """

    xy: Float32[np.ndarray, "n 2"]
    rootsift: Float32[np.ndarray, "n 128"]
    chroma: Float32[np.ndarray, "h w 2"]

    def __len__(self) -> int:
        return len(self.xy)


class PointVerifier:
    """Counts the verified points of crops: RootSIFT, mutual matches, and RANSAC for each pair.

    The points of the latest crops are kept.
    """

    def __init__(self) -> None:
        self._known: OrderedDict[bytes, Points] = OrderedDict()

    def __call__(self, crops: Sequence[Rgb], references: Sequence[Rgb]) -> Int64[np.ndarray, "n k"]:
        """The verified points of each crop with each reference."""
        of_references = [self._points(reference) for reference in references]
        counts = np.zeros((len(crops), len(references)), np.int64)
        for row, rgb in zip(counts, crops, strict=True):
            points = self._points(rgb)
            row[:] = [count_verified(known, points) for known in of_references]
        return counts

    def _points(self, rgb: Rgb) -> Points:
        shape = np.array(rgb.shape, np.int64).tobytes()
        key = hashlib.sha256(shape + rgb.tobytes()).digest()
        points = self._known.get(key)
        if points is None:
            points = find_points(rgb)
            self._known[key] = points
        self._known.move_to_end(key)
        if len(self._known) > MOST_KEPT:
            self._known.popitem(last=False)
        return points


def find_points(rgb: Rgb) -> Points:
    """The SIFT points of a crop, at most `MOST_POINTS`."""
    scale = min(SIDE / max(rgb.shape), MOST_ENLARGED)
    size = (max(CELL, round(rgb.shape[1] * scale)), max(CELL, round(rgb.shape[0] * scale)))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    small = cv2.resize(rgb, size, interpolation=how)
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    found, sift = _detector().detectAndCompute(grey, None)
    if not found:
        sift = np.zeros((0, 128), np.float32)
    xy = np.array([point.pt for point in found], np.float32).reshape(-1, 2)[:MOST_POINTS]
    length = np.maximum(sift.sum(axis=1, keepdims=True), 1e-6)
    root = np.sqrt(sift / length).astype(np.float32)[:MOST_POINTS]
    return Points(xy, root, _chroma(small))


def count_verified(reference: Points, crop: Points) -> int:
    """Matches that one affine map of the reference onto the crop explains, times the share of the
    crop that has the reference's colours; 0 where there is no such map.

    OpenCV's RANSAC starts from the same random numbers in every call.
    """
    pairs = match(reference, crop)
    if len(pairs) < LEAST_MATCHES:
        return 0
    source = reference.xy[pairs[:, 0]]
    target = crop.xy[pairs[:, 1]]
    affine, inliers = cv2.estimateAffine2D(
        source, target, method=cv2.RANSAC, ransacReprojThreshold=NEAR_PX, maxIters=1000
    )
    if affine is None or not is_view(affine[:, :2]):
        return 0
    return round(float(inliers.sum()) * same_colours(reference, crop, affine))


def same_colours(reference: Points, crop: Points, affine: Float64[np.ndarray, "2 3"]) -> float:
    """The share of the reference's cells that the crop covers in which both have one colour."""
    of_cells = affine.copy()
    of_cells[:, 2] = (affine[:, 2] + (CELL - 1) / 2 * (affine[:, :2].sum(axis=1) - 1)) / CELL
    height, width = reference.chroma.shape[:2]
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    nowhere = (np.nan, np.nan)
    moved = cv2.warpAffine(crop.chroma, of_cells, (width, height), flags=how, borderValue=nowhere)
    apart = np.abs(moved - reference.chroma).max(axis=2)
    covered = np.isfinite(apart)
    if not covered.any():
        return 0.0
    return float((apart[covered] < SAME_COLOUR).mean())


def match(a: Points, b: Points) -> Int64[np.ndarray, "m 2"]:
    """Pairs of points, each the other's nearest, by Lowe's ratio on both sides."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    cosine = a.rootsift @ b.rootsift.T
    forth = _nearest(cosine)
    back = _nearest(np.ascontiguousarray(cosine.T))
    rows = np.flatnonzero(forth >= 0)
    mutual = rows[back[forth[rows]] == rows]
    return np.stack([mutual, forth[mutual]], axis=1)


def is_view(linear: Float64[np.ndarray, "2 2"]) -> bool:
    """Whether a surface that is seen from elsewhere may be mapped like this; no mirror can."""
    if np.linalg.det(linear) <= 0:
        return False
    long, short = np.linalg.svd(linear, compute_uv=False)
    return bool(long <= MOST_SKEWED * short and long <= LARGEST and short >= SMALLEST)


def _nearest(cosine: Float32[np.ndarray, "n m"]) -> Int64[np.ndarray, " n"]:
    """The most similar column of each row; -1 where the next one is nearly as similar."""
    rows = np.arange(len(cosine))
    best = cosine.argmax(axis=1)
    others = cosine.copy()
    others[rows, best] = -1.0
    near = np.maximum(2 - 2 * cosine[rows, best], 0)  # squared distances
    next_best = 2 - 2 * others.max(axis=1)
    return np.where(near <= RATIO**2 * next_best, best, -1)


def _chroma(rgb: Rgb) -> Float32[np.ndarray, "h w 2"]:
    """The chroma of every cell, the contrast stretched as for the encoder."""
    height, width = rgb.shape[:2]
    size = (max(1, width // CELL), max(1, height // CELL))
    cells = cv2.resize(stretch_contrast(rgb), size, interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(cells, cv2.COLOR_RGB2LAB)[..., 1:].astype(np.float32)


@cache
def _detector() -> cv2.SIFT:
    return cv2.SIFT.create(MOST_POINTS, contrastThreshold=CONTRAST, edgeThreshold=EDGE)


@cache
def load() -> PointVerifier:
    """The shipped verifier; it needs no weights."""
    return PointVerifier()
