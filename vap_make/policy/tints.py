"""Tints in training scenes, for a recipe that has a share of them; the benchmarks' have none.

Whether a scene is tinted, and which objects carry the tints, is drawn before anything else, by
equal odds for every object that may be meant and for none.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import UInt8

from vap_core.base.types import Colour
from vap_core.prompt import tint
from vap_make.recipe import TINTS, Recipe

LOST = 0.12
"""How often a view's tint is missing (a tracker that lost its target); one view keeps it."""
Images = UInt8[np.ndarray, "c s s 3"]
"""The views of one frame."""


def draw_tints(
    n: int, recipe: Recipe, rng: np.random.Generator, at_once: int = 1
) -> dict[int, Colour]:
    """The tint of each of `n` objects that carries one, `at_once` at most."""
    tints: dict[int, Colour] = {}
    if rng.random() >= recipe.tint_share:
        return tints
    for _ in range(at_once):
        carrier = int(rng.integers(n + 1)) - 1
        if carrier < 0 or carrier in tints:
            continue
        left = [colour for colour in TINTS if colour not in tints.values()]
        tints[carrier] = left[rng.integers(len(left))]
    return tints


def tint_views(
    images: Images,
    ids: UInt8[np.ndarray, "c s s"],
    tints: Mapping[int, Colour],
    rng: np.random.Generator,
) -> Images:
    """The views with tints where `ids` is i + 1, as VAP does it; now and then a view has none."""
    tinted = images.copy()
    for i, colour in tints.items():
        alpha = float(rng.uniform(0.3, 0.7))
        kept = rng.random(len(images)) > LOST
        kept[rng.integers(len(images))] = True
        for view in np.flatnonzero(kept):
            tinted[view] = tint(tinted[view], ids[view] == i + 1, colour, alpha)
    return tinted
