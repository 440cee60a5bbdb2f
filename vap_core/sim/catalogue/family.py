"""A family of things: one kind, how its generic instances are drawn, and which instances are kept for evaluation."""

from collections.abc import Callable

import numpy as np

from vap_core.sim.shapes import Shape
from vap_core.sim.textures import Texture
from vap_core.values import value


@value
class Family:
    """`draw` makes the shape of a generic instance from its own random stream; `instances` are the personal one, then its look-alikes.

    Look-alikes are ordered from hard to easy: the first two or more share the personal instance's base and ink colours, the last
    ones do not. A family without instances is clutter, or a place to put things; `prop` holds its one fixed instance of the benchmarks.
    `paint` maps a drawn texture and the instance's number to the one it wears. `stem` begins the names of the family's objects.
    """

    category: str
    mass_kg: float
    draw: Callable[[np.random.Generator], Shape]
    instances: tuple[tuple[Shape, Texture], ...] = ()
    prop: tuple[tuple[Shape, Texture], ...] = ()
    paint: Callable[[Texture, int], Texture] | None = None
    slug: str = ""

    @property
    def stem(self) -> str:
        return self.slug or self.category.replace(" ", "-")


def pick[T](rng: np.random.Generator, choices: tuple[T, ...]) -> T:
    """One of `choices`, typed as they are."""
    return choices[int(rng.integers(len(choices)))]
