"""Colour names of pixels, as a person would give them."""

import cv2
import numpy as np
from jaxtyping import Int64

from vap_core.base.types import Mask, Rgb

HUE_ENDS_DEG = (5.0, 48.0, 72.0, 104.0, 168.0, 232.0, 308.0, 340.0)
HUE_NAMES = ("pink", "red", "orange", "yellow", "green", "teal", "blue", "purple")
"""Hue angles in CIE Lab up to each end have that name; what is beyond the last is pink again."""
NEUTRALS = ("black", "white", "grey", "brown", "beige")
COLOURS = (*NEUTRALS, *HUE_NAMES)
BLACK, WHITE, GREY, BROWN, BEIGE, PINK = range(6)
"""Indices in `COLOURS`."""
SHADES = ("light", "dark")
GREY_CHROMA = 9.0
"""Chroma below which a colour is a grey."""
VIVID_CHROMA = 38.0
"""Chroma from which warm colours are neither brown nor beige."""


def colour_indices(rgb: Rgb, mask: Mask) -> Int64[np.ndarray, "h w"]:
    """Of every pixel, the index of its colour in `COLOURS`.

    What counts as white depends on the brightest grey pixels in `mask`, so that a white object is
    white in its shaded parts too.
    """
    lab = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    light = lab[..., 0]
    chroma = np.hypot(lab[..., 1], lab[..., 2])
    angle = np.degrees(np.arctan2(lab[..., 2], lab[..., 1])) % 360.0
    hue = len(NEUTRALS) + np.digitize(angle, HUE_ENDS_DEG) % len(HUE_NAMES)

    warm = (angle > 20) & (angle < 100) & (chroma < VIVID_CHROMA)
    colour = np.where(warm, np.where(light < 55, BROWN, BEIGE), hue)
    dark_red = (angle < 20) & (chroma < VIVID_CHROMA) & (light < 40)
    colour = np.where(dark_red, BROWN, colour)
    reddish = (angle > 340) | (angle < 45)
    pale_red = reddish & (light > 55) & (chroma < 1.5 * VIVID_CHROMA) & ~warm
    colour = np.where(pale_red, PINK, colour)

    blue = (angle > 232) & (angle < 300)
    faint = chroma < np.where(blue, 0.6 * GREY_CHROMA, GREY_CHROMA)
    faint |= light < 14
    faint |= (light > 80) & (chroma < 1.7 * GREY_CHROMA)
    white_from = _white_lightness(light[faint & mask])
    neutral = np.where(light < 26, BLACK, np.where(light < white_from, GREY, WHITE))
    return np.where(faint, neutral, colour).astype(np.int64)


def add_shade(name: str, lightness: float) -> str:
    """The colour's name, after "light" or "dark" where its lightness (0..100) is extreme."""
    light, dark = SHADES
    if name in ("black", "white"):
        return name
    if lightness < 38:
        return f"{dark} {name}"
    if lightness > 74:
        return f"{light} {name}"
    return name


def _white_lightness(grey_lightness: np.ndarray) -> float:
    """The lightness from which a grey is white, given those of the object's grey pixels."""
    if len(grey_lightness) == 0:
        return 66.0
    brightest = float(np.percentile(grey_lightness, 95))
    if brightest <= 74:
        return 66.0
    return max(42.0, 0.55 * brightest)
