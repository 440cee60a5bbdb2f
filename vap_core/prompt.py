"""Visual prompts: tint a mask, and choose a colour that can be named and seen.

The paper's are in P 3.3 and tab:ablation_prompt.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, UInt8

from vap_core.base.errors import BadInstruction
from vap_core.base.types import Colour, Mask, Rgb

Pixels = UInt8[np.ndarray, "*n 3"]

PALETTE: tuple[Colour, ...] = (
    Colour("red", (255, 0, 0)),
    Colour("blue", (0, 0, 255)),
    Colour("green", (0, 255, 0)),
    Colour("magenta", (255, 0, 255)),
    Colour("cyan", (0, 255, 255)),
    Colour("yellow", (255, 255, 0)),
)
"""Nameable tints, in the order of preference; the paper tints red."""

ALPHA = 0.5
"""Opacity of the tint (P appendix: the default of the opacity ablation)."""

OBJECT_SHARE = 0.12
VIEW_SHARE = 0.01
"""A tint is free while fewer than these shares of every candidate's, and of every view's, pixels
have its colour."""

HUE_WIDTH_DEG = 25.0
LEAST_SATURATION = 0.35
LEAST_VALUE = 60.0
"""A pixel has a tint's colour when its hue is that near, and it is saturated and bright enough."""


def tint(rgb: Rgb, mask: Mask, colour: Colour, alpha: float = ALPHA) -> Rgb:
    """I~ = (1 - alpha) I + alpha * colour inside the mask, rounded to the nearest level.

    Pixels outside the mask are bit-identical.

    Raises: ValueError: the mask has another size, or alpha is outside [0, 1].
    """
    if rgb.shape[:2] != mask.shape:
        raise ValueError(f"tint: image {rgb.shape[:2]} and mask {mask.shape} differ in size")
    if not 0.0 <= alpha <= 1.0:
        raise ValueError(f"tint: alpha {alpha} outside [0, 1]")
    out = rgb.copy()
    blend = (1.0 - alpha) * rgb[mask] + alpha * np.asarray(colour.rgb)
    out[mask] = np.rint(blend).astype(np.uint8)
    return out


@runtime_checkable
class PromptForm(Protocol):
    """How one target is marked in one view. Other forms are ablations (study.methods)."""

    def __call__(self, rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
        """The marked picture; `rgb` stays as it is.

        `mask` is the target's; it may be empty. `others` are the masks of the other candidates,
        which are followed only for a form with a true `marks_others`; for others it is empty.
        """
        ...


@dataclass(frozen=True)
class Tint:
    """The method's form: the target's pixels are tinted, and nothing else changes."""

    alpha: float = ALPHA

    def __call__(self, rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
        return tint(rgb, mask, colour, self.alpha)


def has_colour(rgb: Pixels, colour: Colour) -> Bool[np.ndarray, "*n"]:
    """Which pixels a person would call `colour`."""
    return colour_maps(rgb, [colour])[0]


def colour_maps(rgb: Pixels, colours: Sequence[Colour]) -> Bool[np.ndarray, "c *n"]:
    """`has_colour` for several colours; the hue of every pixel is computed once."""
    pixels = rgb.astype(np.float32)
    top = pixels.max(axis=-1)
    saturation = (top - pixels.min(axis=-1)) / np.maximum(top, 1.0)
    vivid = (saturation >= LEAST_SATURATION) & (top >= LEAST_VALUE)
    hue = _hue_deg(pixels[vivid])
    found = np.zeros((len(colours), *vivid.shape), bool)
    for has, colour in zip(found, colours, strict=True):
        named = float(_hue_deg(np.asarray([colour.rgb], np.float32))[0])
        has[vivid] = np.abs((hue - named + 180.0) % 360.0 - 180.0) <= HUE_WIDTH_DEG
    return found


def choose_colours(
    count: int, scenes: Iterable[tuple[Rgb, Sequence[Mask]]], palette: Sequence[Colour] = PALETTE
) -> tuple[Colour, ...]:
    """The first `count` tints that nothing in view already has (P 3.3: the tint must stand out).

    `scenes` pairs every view with the masks of the candidates in it. A tint is taken when its
    colour covers more than `OBJECT_SHARE` of any candidate, or more than `VIEW_SHARE` of any view.
    Free tints come first, in the palette's order; when too few are free, the least present follow.

    Raises:
        BadInstruction: more targets than the palette has tints.
    """
    if count > len(palette):
        raise BadInstruction(
            f"choose_colours: {count} targets but {len(palette)} colours; name fewer objects at "
            "once."
        )
    presence = np.zeros(len(palette))
    for rgb, masks in scenes:
        found = colour_maps(rgb, palette)
        presence = np.maximum(presence, found.mean(axis=(1, 2)) / VIEW_SHARE)
        for mask in masks:
            if mask.any():
                presence = np.maximum(presence, found[:, mask].mean(axis=1) / OBJECT_SHARE)
    order = np.argsort(np.maximum(presence, 1.0), kind="stable")
    return tuple(palette[i] for i in order[:count])


def _hue_deg(pixels: np.ndarray) -> np.ndarray:
    r, g, b = np.moveaxis(pixels, -1, 0)
    angle = np.arctan2(np.sqrt(3.0) * (g - b), 2.0 * r - g - b)
    return np.degrees(angle) % 360.0
