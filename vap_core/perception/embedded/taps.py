"""Pixels for the shared backbone, and what it gives: features at named taps."""

import cv2
import numpy as np

from vap_core.base.types import Rgb

CHANNELS = {"b0": 16, "b2": 24, "b4": 40, "b10": 112, "b14": 192, "head": 1280}
STRIDE = {"b0": 2, "b2": 4, "b4": 8, "b10": 16, "b14": 32, "head": 32}
GREY = 127
"""The grey level that normalises to zero."""


def resize_and_pad(image: Rgb, long_side: int, multiple: int = 32) -> tuple[Rgb, float]:
    """The image with a longer side of `long_side` pixels, and the scale.

    It is padded right and bottom with grey to a multiple of `multiple`.
    """
    h, w = image.shape[:2]
    scale = long_side / max(h, w)
    small_w = max(1, round(w * scale))
    small_h = max(1, round(h * scale))
    small = image
    if (small_h, small_w) != (h, w):
        interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        small = cv2.resize(image, (small_w, small_h), interpolation=interpolation)
    padded_h = -(-small_h // multiple) * multiple
    padded_w = -(-small_w // multiple) * multiple
    padded = np.full((padded_h, padded_w, 3), GREY, np.uint8)
    padded[:small_h, :small_w] = small
    return padded, scale
