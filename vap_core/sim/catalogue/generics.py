"""How generic instances keep clear of the evaluation's: numbers outside a gap, and coats from a palette."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vap_core.sim.catalogue.family import pick
from vap_core.sim.fabrics import GENERIC_FABRICS
from vap_core.sim.textures import Ink, Texture

Coat = tuple[Ink, Ink, Ink]
"""Base, ink and accent, sRGB 0..255."""
PLAIN, FABRIC = 0.25, 0.6
"""Shares of generic instances that keep their drawn texture, and, of the others, that wear a fabric."""


def beside(rng: np.random.Generator, low: float, high: float, gap: tuple[float, float]) -> float:
    """Uniform over low..high but never within `gap`, which lies inside."""
    below, above = gap[0] - low, high - gap[1]
    t = float(rng.uniform(0, below + above))
    return low + t if t < below else gap[1] + (t - below)


def dressed(coats: tuple[Coat, ...]) -> Callable[[Texture, int], Texture]:
    """A family's `paint`: most instances wear one of `coats`, each colour up to 14 levels off, often with a generic fabric."""

    def paint(texture: Texture, index: int) -> Texture:
        rng = np.random.default_rng([29, index])
        if rng.random() < PLAIN:
            return texture

        def near(colour: Ink) -> Ink:
            red, green, blue = np.clip(np.array(colour) + rng.integers(-14, 15, 3), 0, 255).tolist()
            return red, green, blue

        base, ink, accent = (near(colour) for colour in pick(rng, coats))
        worn = replace(texture, base=base, ink=ink, accent=accent)
        if rng.random() < FABRIC:
            return replace(worn, motif=pick(rng, tuple(GENERIC_FABRICS)), layout=pick(rng, ("whole", "whole", "middle")), word="")
        return worn

    return paint
