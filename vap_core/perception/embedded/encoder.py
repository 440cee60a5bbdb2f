"""The embedded encoder: an object's appearance as one L2-normalised row per crop (P 3.3, f).

A row joins three descriptors, each L2-normalised and weighted: GeM-pooled Lite0 features (shape and
texture: what kind of thing it is), a centre-weighted Lab histogram, and the row of a head that was
trained to distinguish look-alikes (which of them it is). The cosine of two rows is the mean of the
three cosines, weighted by the squares of their weights.

The head has seen renders only. The encoder for other views, real photos above all, weighs it less
and stretches every crop's contrast first.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from vap_core.base.types import Rgb, value
from vap_core.perception.embedded.networks import (
    CHANNELS,
    GREY,
    PERCEPTION,
    Network,
    head_weights,
    load_network,
    load_weights,
    resize_and_pad,
    trunk_weights,
)

GRAPH = "encoder.onnx"
SIDE = 224
"""Pixels of the square in which a crop is embedded."""
HISTOGRAM_SIDE = 64
HISTOGRAM_BINS = (4, 8, 8)
"""Lightness, green-red, blue-yellow."""
HISTOGRAM_LENGTH = int(np.prod(HISTOGRAM_BINS))
HISTOGRAM_SIGMA = 0.4
"""How fast a pixel's weight falls with its distance from the centre, in half-sides."""
HISTOGRAM_WEIGHT = 0.5
INSTANCE_TAPS = ("b4", "b10", "b14")
INSTANCE_SIDE = 112
"""The features that the instance head reads, and the side of its pixels."""
INSTANCE_WIDTH = 128
"""Numbers of the instance head's row."""
INSTANCE_WEIGHT = 1.0
"""Weight of the instance head's row. Held-out generic look-alikes: 75.1 % right without it, 84.7 at
0.7, 86.3 at 1; real photos, which it was not trained on: 98.8, 98.8, 98.0."""


UNFAMILIAR_WEIGHT = 0.5
"""The same in views of another world than the one that the head was trained on."""
DARKEST_PERCENT, BRIGHTEST_PERCENT = 3.0, 97.0
STRETCHED = (15.0, 235.0)
LEAST_CONTRAST = 40.0
"""Grey levels: what a crop's darkest and brightest pixels are stretched to, and the least contrast
that is assumed, so that noise is not stretched."""


class LiteEncoder:
    """The embedded encoder; `network` computes an `encode_network.EncodeNetwork`.

    Without an instance head, rows have no part that distinguishes look-alikes. `tag` ends the name
    that is stored with every memory. `familiar` off makes it the encoder of unfamiliar views.
    """

    def __init__(
        self, network: Network, *, has_head: bool = True, tag: str = "", familiar: bool = True
    ) -> None:
        self.network = network
        self.stretch = not familiar
        self.weight = INSTANCE_WEIGHT if familiar else UNFAMILIAR_WEIGHT
        self.name = f"lite0-gem3-lab{HISTOGRAM_WEIGHT:g}"
        self.dim = CHANNELS["head"] + HISTOGRAM_LENGTH
        if has_head:
            self.name += f"-look{self.weight:g}{tag}"
            self.dim += INSTANCE_WIDTH
        if self.stretch:
            self.name += "-stretched"

    def __call__(self, crops: Sequence[Rgb]) -> Float32[np.ndarray, "n d"]:
        return np.array([self._embed(rgb) for rgb in crops], np.float32).reshape(-1, self.dim)

    def _embed(self, rgb: Rgb) -> Float32[np.ndarray, " d"]:
        if self.stretch:
            rgb = stretch_contrast(rgb)
        whole = pad_to_square(rgb)
        small = cv2.resize(whole, (INSTANCE_SIDE, INSTANCE_SIDE), interpolation=cv2.INTER_AREA)
        histogram = _unit(lab_histogram(rgb))
        colour = histogram.astype(np.float32)
        deepest, *instance = self.network(whole[None], small[None], colour[None])
        parts = [_unit(gem(deepest[0])), HISTOGRAM_WEIGHT * histogram]
        for rows in instance:
            parts.append(self.weight * rows[0])
        return _unit(np.concatenate(parts)).astype(np.float32)


def stretch_contrast(rgb: Rgb) -> Rgb:
    """The picture with its darkest and brightest pixels, by the mean of R, G and B, at `STRETCHED`.

    All channels are scaled alike, so hues stay.
    """
    dark, bright = _grey_percentiles(rgb, (DARKEST_PERCENT, BRIGHTEST_PERCENT))
    low, high = STRETCHED
    scale = (high - low) / max(bright - dark, LEAST_CONTRAST)
    of_value = np.clip((np.arange(256) - dark) * scale + low, 0, 255)
    return cv2.LUT(rgb, of_value.astype(np.uint8))


def _grey_percentiles(rgb: Rgb, percents: tuple[float, ...]) -> list[float]:
    """np.percentile of the pixels' means of R, G and B, to the bit.

    Counting the 766 sums of a large crop takes a tenth of the time of partitioning its pixels.
    """
    sums = rgb[..., 0].astype(np.uint16)
    sums += rgb[..., 1]
    sums += rgb[..., 2]
    last = sums.size - 1
    ranked = np.bincount(sums.ravel()).cumsum()
    found = []
    for percent in percents:
        place = last * (percent / 100)
        rank = int(place)
        share = place - rank
        lower = int(np.searchsorted(ranked, rank, side="right")) / 3
        upper = int(np.searchsorted(ranked, min(rank + 1, last), side="right")) / 3
        if share < 0.5:
            found.append(lower + (upper - lower) * share)
        else:
            found.append(upper - (upper - lower) * (1 - share))
    return found


def gem(features_chw: Float32[np.ndarray, "c h w"]) -> Float32[np.ndarray, " c"]:
    """Generalised-mean pooling with p = 3: (mean of x^3)^(1/3) per channel."""
    x = np.maximum(features_chw, np.float32(1e-6))
    return np.cbrt((x * x * x).mean((1, 2)))  # a fifth of the time of general powers


def lab_histogram(rgb: Rgb) -> Float[np.ndarray, " b"]:
    """Square-rooted histogram over CIE Lab.

    A pixel weighs exp(-r^2 / 2 sigma^2), r its distance from the centre in half-sides.
    """
    size = (HISTOGRAM_SIDE, HISTOGRAM_SIDE)
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB)
    lightness, chroma = _histogram_bins()
    _, greens, blues = HISTOGRAM_BINS
    flat = lightness[lab[..., 0]] * greens * blues
    flat += chroma[0][lab[..., 1]] * blues
    flat += chroma[1][lab[..., 2]]
    counts = np.bincount(flat.ravel(), _histogram_weight(), minlength=HISTOGRAM_LENGTH)
    return np.sqrt(counts)


@cache
def _histogram_weight() -> Float[np.ndarray, " q"]:
    """The weight of every pixel of the square, row by row."""
    r = np.linspace(-1, 1, HISTOGRAM_SIDE)
    squared = r[:, None] ** 2 + r[None] ** 2
    return np.exp(-squared / (2 * HISTOGRAM_SIGMA**2)).ravel()


@cache
def _histogram_bins() -> tuple[Int64[np.ndarray, "256"], tuple[Int64[np.ndarray, "256"], ...]]:
    """The bin of every value of 8-bit lightness, and of both chromas."""
    value = np.arange(256, dtype=np.float32)
    lights, *colours = HISTOGRAM_BINS
    lightness = _bin(value / 255.0, lights)
    # Chroma beyond +-64 shares the outer bins.
    chroma = tuple(_bin((value - 64.0) / 128.0, n) for n in colours)
    return lightness, chroma


def _bin(unit: Float32[np.ndarray, " v"], n: int) -> Int64[np.ndarray, " v"]:
    return np.clip((unit * n).astype(np.int64), 0, n - 1)


def pad_to_square(rgb: Rgb) -> Rgb:
    """The image in a square of `SIDE` pixels, its aspect kept, centred on grey."""
    small, _ = resize_and_pad(rgb, SIDE, multiple=1)
    h, w = small.shape[:2]
    out = np.full((SIDE, SIDE, 3), GREY, np.uint8)
    top = (SIDE - h) // 2
    left = (SIDE - w) // 2
    out[top : top + h, left : left + w] = small
    return out


@cache
def load() -> LiteEncoder:
    """The shipped encoder.

    Raises: MissingWeights: a file of data/weights is absent or damaged.
    """
    weights, entry = load_weights(PERCEPTION, "look.")
    arrays = {**trunk_weights([*INSTANCE_TAPS, "head"]), **head_weights(weights)}
    network = load_network(GRAPH, arrays, entry["sha256"])
    return LiteEncoder(network, tag=f"-{entry['sha256'][:6]}")


@cache
def load_unfamiliar() -> LiteEncoder:
    """The shipped encoder of unfamiliar views; it shares the network of `load`.

    Raises: MissingWeights: a file of data/weights is absent or damaged.
    """
    _, entry = load_weights(PERCEPTION, "look.")
    return LiteEncoder(load().network, tag=f"-{entry['sha256'][:6]}", familiar=False)


def _unit(row: np.ndarray) -> np.ndarray:
    return row / np.maximum(np.linalg.norm(row, axis=-1, keepdims=True), 1e-12)


LOCAL_SIDE = 256
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
    scale = min(LOCAL_SIDE / max(rgb.shape), MOST_ENLARGED)
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
def load_local() -> PointVerifier:
    """The shipped verifier; it needs no weights."""
    return PointVerifier()
