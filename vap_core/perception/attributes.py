"""What can be counted in one crop of an object: colours, patterns and proportions."""

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool

from vap_core.base.types import Boxes, Mask, Rgb, value
from vap_core.perception.boxes import MARGIN
from vap_core.perception.colours import COLOURS, colour_indices
from vap_core.perception.protocols import Segmenter

PATTERNS = ("stripes", "bands", "spots", "patches", "parts")
SHAPES = ("tall", "wide", "compact")
SIDE = 128
"""Pixels of a crop's longer side while it is measured."""
CENTRE_RADIUS = 0.5
"""Pixels nearer to the middle of a crop than this, in half-sides, always belong to the object."""
BRIGHT_LEVEL = 240.0
"""The level to which an image's brightest parts are raised."""
MIN_PATCH_SHARE = 0.0015
"""Share of an object's pixels that a patch needs to be counted."""


@value
class CropAttributes:
    """One crop: every colour's share of the object, lightness (0..100) and pattern; its shape."""

    share: Mapping[str, float]
    lightness: Mapping[str, float]
    pattern: Mapping[str, str]
    shape: str


def measure_crop(rgb: Rgb, segmenter: Segmenter) -> CropAttributes:
    """The attributes of the object in a crop, whose outline `segmenter` finds."""
    small = _resize(rgb)
    mask = _object_mask(small, segmenter)
    return _measure(_equalise_exposure(small), mask)


def pattern_of(part: Bool[np.ndarray, "h w"], whole: Mask) -> str:
    """How the pixels of one colour lie on an object.

    "stripes" are upright, "bands" go around it, "spots" are many and small, "patches" fewer and
    larger; everything else is "parts".
    """
    size = int(whole.sum())
    count, _, stats, _ = cv2.connectedComponentsWithStats(part.astype(np.uint8), connectivity=8)
    pieces = stats[1:count]
    pieces = pieces[pieces[:, cv2.CC_STAT_AREA] >= max(3, MIN_PATCH_SHARE * size)]
    if not len(pieces):
        return "parts"
    object_height, object_width = _extent(whole)
    width = pieces[:, cv2.CC_STAT_WIDTH]
    height = pieces[:, cv2.CC_STAT_HEIGHT]
    across = int(((width > 0.6 * object_width) & (height < 0.35 * object_height)).sum())
    upright = int(((height > 2.2 * width) & (height > 0.25 * object_height)).sum())
    largest = int(pieces[:, cv2.CC_STAT_AREA].max())
    if across and across >= upright:
        return "bands"
    if upright >= 2:
        return "stripes"
    if len(pieces) >= 4 and largest < 0.08 * size:
        return "spots"
    if len(pieces) >= 2 and largest < 0.2 * size:
        return "patches"
    return "parts"


def _resize(rgb: Rgb) -> Rgb:
    """The crop with a longer side of `SIDE` pixels."""
    scale = SIDE / max(rgb.shape[:2])
    h = max(8, round(scale * rgb.shape[0]))
    w = max(8, round(scale * rgb.shape[1]))
    interpolation = cv2.INTER_LINEAR
    if scale < 1:
        interpolation = cv2.INTER_AREA
    return cv2.resize(rgb, (w, h), interpolation=interpolation)


def _object_mask(rgb: Rgb, segmenter: Segmenter) -> Mask:
    """The object in a resized crop.

    It has no holes, lacks its outermost pixels, and always covers the crop's centre.
    """
    from scipy.ndimage import binary_fill_holes

    h, w = rgb.shape[:2]
    margin = MARGIN * SIDE / (1 + 2 * MARGIN)
    xyxy = np.array([[margin, margin, w - margin, h - margin]], np.float32)
    mask = segmenter(rgb, Boxes(xyxy, np.ones(1, np.float32), ""))[0].astype(np.uint8)
    mask = binary_fill_holes(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)))
    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    x = np.linspace(-1, 1, w)
    y = np.linspace(-1, 1, h)
    return inner | (x[None] ** 2 + y[:, None] ** 2 < CENTRE_RADIUS**2)


def _equalise_exposure(rgb: Rgb) -> Rgb:
    """Raise the brightest parts to `BRIGHT_LEVEL`, by a factor of 1.4 at most."""
    brightest = float(np.percentile(rgb.max(axis=2), 98))
    gain = float(np.clip(BRIGHT_LEVEL / max(brightest, 1.0), 1.0, 1.4))
    return np.clip(rgb * gain, 0, 255).astype(np.uint8)


def _measure(rgb: Rgb, mask: Mask) -> CropAttributes:
    lightness = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[..., 0]
    indices = colour_indices(rgb, mask)
    size = int(mask.sum())
    share: dict[str, float] = {}
    mean_lightness: dict[str, float] = {}
    pattern: dict[str, str] = {}
    for index, name in enumerate(COLOURS):
        part = (indices == index) & mask
        share[name] = float(part.sum() / size)
        mean_lightness[name] = 0.0
        if part.any():
            mean_lightness[name] = float(lightness[part].mean())
        pattern[name] = pattern_of(part, mask)
    return CropAttributes(share, mean_lightness, pattern, _shape_of(mask))


def _shape_of(mask: Mask) -> str:
    height, width = _extent(mask)
    ratio = height / width
    if ratio > 1.6:
        return "tall"
    if ratio < 0.9:
        return "wide"
    return "compact"


def _extent(mask: Mask) -> tuple[int, int]:
    """Height and width of a mask's box, pixels."""
    rows = np.flatnonzero(mask.any(axis=1))
    cols = np.flatnonzero(mask.any(axis=0))
    return int(rows[-1] - rows[0] + 1), int(cols[-1] - cols[0] + 1)
