"""Visual prompts: tint a mask, and choose a colour that can be named and seen.

The paper's are in P 3.3 and tab:ablation_prompt.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int16, UInt8

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

HUES = 12
"""Hues that are told apart when a tint is chosen; a colour is as wide as three of them, so that
what lies between two names counts for both."""
OBJECT_SHARE = 0.12
VIEW_SHARE = 0.003
"""A hue is had from these shares of a candidate's, and of a view's, pixels on."""
PALEST, DARKEST = 64, 50
"""Saturation and value (of 255) from which on a pixel has a hue."""
ENOUGH = 75.0
"""Distance (CIE 1976) from which on a tint contrasts with a scene."""
SIDE = 224
"""Pixels of a view's side that are looked at."""

HUE_WIDTH = 18
LEAST_SATURATION = 89
LEAST_VALUE = 60
"""A pixel looks tinted when its hue (of 256) is that near, and it is saturated and bright enough
(of 255)."""


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
    """Which pixels look as if they were tinted with `colour`."""
    hue, saturation, value = np.moveaxis(_hsv(rgb), -1, 0)
    away = (hue - _hsv(np.array(colour.rgb, np.uint8))[0] + 128) % 256 - 128
    return (abs(away) <= HUE_WIDTH) & (saturation >= LEAST_SATURATION) & (value >= LEAST_VALUE)


def choose_colours(
    count: int, scenes: Iterable[tuple[Rgb, Sequence[Mask]]], palette: Sequence[Colour] = PALETTE
) -> tuple[Colour, ...]:
    """The tints that stand out most (P 3.3), the best first.

    `scenes` pairs every view with the masks of the candidates in it. A colour that no candidate and
    no view has comes first: one of which no neighbour (60 degrees away) is had either, then any;
    where none is left, the least present follows. What is chosen is had from then on. Among equals
    the one that contrasts most with the views is taken, and the palette's first where they contrast
    `ENOUGH`.

    Raises:
        BadInstruction: more targets than the palette has tints.
    """
    if count > len(palette):
        raise BadInstruction(
            f"choose_colours: {count} targets but {len(palette)} colours; name fewer objects at "
            "once."
        )
    paints = np.array([[colour.rgb for colour in palette]], np.uint8)
    presence = np.zeros(HUES)
    contrast = np.full(len(palette), ENOUGH)
    for rgb, masks in scenes:
        step = -(-max(rgb.shape[:2]) // SIDE)
        hues = _hues(rgb[::step, ::step])
        parts = [(hues[mask[::step, ::step]], OBJECT_SHARE) for mask in masks]
        for part, share in [(hues, VIEW_SHARE), *parts]:
            counts = np.bincount(part.ravel(), minlength=HUES + 1)[:HUES]
            wide = counts + np.roll(counts, 1) + np.roll(counts, -1)
            presence = np.maximum(presence, wide / max(part.size, 1) / share)
        scene = _lab(cv2.resize(rgb, (16, 16), interpolation=cv2.INTER_AREA))
        away = np.linalg.norm(_lab(paints)[0] - scene.reshape(-1, 1, 3), axis=-1)
        contrast = np.minimum(contrast, away.min(axis=0))
    named = _hues(paints)[0]
    chosen: list[Colour] = []
    for _ in range(count):
        own = np.maximum(presence, 1.0)
        neighbours = np.maximum(np.roll(own, HUES // 6), np.roll(own, -HUES // 6)) > 1
        order = np.lexsort((-contrast, neighbours[named], own[named]))
        best = next(i for i in order if palette[i] not in chosen)
        chosen.append(palette[best])
        presence[named[best]] = np.inf
    return tuple(chosen)


def _hsv(rgb: Pixels) -> Int16[np.ndarray, "*n 3"]:
    """Hue (of 256), saturation and value (of 255)."""
    hsv = cv2.cvtColor(rgb.reshape(1, -1, 3), cv2.COLOR_RGB2HSV_FULL)
    return hsv.reshape(rgb.shape).astype(np.int16)


def _hues(rgb: Rgb) -> Int16[np.ndarray, "h w"]:
    """Which of `HUES` every pixel has; HUES where it has none."""
    hue, saturation, value = np.moveaxis(_hsv(rgb), -1, 0)
    nearest = ((hue * HUES + 128) // 256) % HUES
    return np.where((saturation >= PALEST) & (value >= DARKEST), nearest, HUES)


def _lab(rgb: Rgb) -> Float32[np.ndarray, "h w 3"]:
    return cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
