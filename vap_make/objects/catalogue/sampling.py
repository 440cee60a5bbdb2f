"""How generic instances are drawn, clear of the shapes and colours of the evaluation's."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vap_make.objects.fabrics import GENERIC_FABRICS
from vap_make.objects.textures import Srgb, Texture

ColourScheme = tuple[Srgb, Srgb, Srgb]
"""Base, ink and accent."""
UNCHANGED_SHARE = 0.25
"""Share of generic instances that keep the texture drawn for them."""
FABRIC_SHARE = 0.6
"""Share of the others that get a generic fabric for a motif."""
COLOUR_JITTER = 14
"""A colour of a scheme varies by at most this many levels a channel."""


def choose[T](rng: np.random.Generator, choices: tuple[T, ...]) -> T:
    """One of `choices`, with its own type."""
    return choices[int(rng.integers(len(choices)))]


def uniform_outside(
    rng: np.random.Generator, low: float, high: float, gap: tuple[float, float]
) -> float:
    """Uniform over low..high but never within `gap`, which lies inside."""
    below, above = gap[0] - low, high - gap[1]
    t = float(rng.uniform(0, below + above))
    if t < below:
        return low + t
    return gap[1] + (t - below)


def recolour_with(schemes: tuple[ColourScheme, ...]) -> Callable[[Texture, int], Texture]:
    """A family's `recolour`: most instances get the colours of a scheme, often with a fabric."""

    def recolour(texture: Texture, index: int) -> Texture:
        rng = np.random.default_rng([29, index])
        if rng.random() < UNCHANGED_SHARE:
            return texture
        base, ink, accent = choose(rng, schemes)
        recoloured = replace(
            texture,
            base=_jitter(rng, base),
            ink=_jitter(rng, ink),
            accent=_jitter(rng, accent),
        )
        if rng.random() >= FABRIC_SHARE:
            return recoloured
        return replace(
            recoloured,
            motif=choose(rng, tuple(GENERIC_FABRICS)),
            layout=choose(rng, ("whole", "whole", "middle")),
            word="",
        )

    return recolour


def _jitter(rng: np.random.Generator, colour: Srgb) -> Srgb:
    change = rng.integers(-COLOUR_JITTER, COLOUR_JITTER + 1, 3)
    red, green, blue = np.clip(np.array(colour) + change, 0, 255).tolist()
    return red, green, blue
