"""Visual prompts: tint a mask, and choose a colour that can be named and seen (P 3.3, tab:ablation_prompt)."""

from collections.abc import Iterable, Sequence

import numpy as np

from vap_core.errors import BadInstruction
from vap_core.values import Colour, Mask, Rgb

PALETTE: tuple[Colour, ...] = (
    Colour("red", (255, 0, 0)),
    Colour("blue", (0, 0, 255)),
    Colour("green", (0, 255, 0)),
    Colour("magenta", (255, 0, 255)),
    Colour("cyan", (0, 255, 255)),
    Colour("yellow", (255, 255, 0)),
)
"""Nameable colours, in the order of preference; the paper tints red."""

ALPHA = 0.5
"""Opacity of the tint (P appendix: the default of the opacity ablation)."""

OBVIOUS = 0.12
"""A colour is free when fewer than this share of every object's pixels, ..."""
SCENERY = 0.01
"""... and of every view's pixels, already look like it."""


def tint(rgb: Rgb, mask: Mask, colour: Colour, alpha: float = ALPHA) -> Rgb:
    """I~ = (1 - alpha) I + alpha * colour inside the mask, rounded to the nearest level; the rest is bit-identical."""
    if rgb.shape[:2] != mask.shape:
        raise ValueError(f"tint: image {rgb.shape[:2]} and mask {mask.shape} differ in size")
    if not 0.0 <= alpha <= 1.0:
        raise ValueError(f"tint: alpha {alpha} outside [0, 1]")
    out = rgb.copy()
    out[mask] = np.rint((1.0 - alpha) * rgb[mask] + alpha * np.asarray(colour.rgb)).astype(np.uint8)
    return out


def looks_like(rgb: np.ndarray, colour: Colour) -> np.ndarray:
    """Which pixels (... x 3, uint8) a person would call `colour`: saturated, and of its hue to within 25 degrees."""
    pixels = rgb.astype(np.float32)
    top, low = pixels.max(axis=-1), pixels.min(axis=-1)
    saturation = (top - low) / np.maximum(top, 1.0)
    off = np.abs((_hue(pixels) - float(_hue(np.asarray([colour.rgb], np.float32))[0]) + 180.0) % 360.0 - 180.0)
    return (off <= 25.0) & (saturation >= 0.35) & (top >= 60.0)


def choose_colours(count: int, scenes: Iterable[tuple[Rgb, Sequence[Mask]]], palette: Sequence[Colour] = PALETTE) -> tuple[Colour, ...]:
    """The first `count` colours that nothing in view already has (P 3.3: the tint must stand out).

    `scenes` pairs every view with the masks of the candidates in it. A colour is taken when it covers more than `OBVIOUS` of
    any candidate, or more than `SCENERY` of any view. Free colours come first, in the palette's order; when too few are free,
    the least present follow.

    Raises:
        BadInstruction: more targets than the palette has colours.
    """
    if count > len(palette):
        raise BadInstruction(f"choose_colours: {count} targets but {len(palette)} colours; name fewer objects at once.")
    presence = np.zeros(len(palette))
    for rgb, masks in scenes:
        pixels = [rgb[mask] for mask in masks if mask.any()]
        for index, colour in enumerate(palette):
            shares = [float(looks_like(inside, colour).mean()) / OBVIOUS for inside in pixels]
            presence[index] = max([presence[index], float(looks_like(rgb, colour).mean()) / SCENERY, *shares])
    ranked = sorted(range(len(palette)), key=lambda i: (max(presence[i], 1.0), i))
    return tuple(palette[i] for i in ranked[:count])


def _hue(pixels: np.ndarray) -> np.ndarray:
    r, g, b = pixels[..., 0], pixels[..., 1], pixels[..., 2]
    return np.degrees(np.arctan2(np.sqrt(3.0) * (g - b), 2.0 * r - g - b)) % 360.0
