"""A family of objects: one kind of thing, its generic instances and those kept for evaluation."""

from collections.abc import Callable

import numpy as np

from vap_core.base.types import value
from vap_make.objects.shapes import Shape
from vap_make.objects.textures import Texture

Instances = tuple[tuple[Shape, Texture], ...]


@value
class Family:
    """One kind of thing.

    `draw` makes the shape of a generic instance from its generator; `recolour` maps the texture
    drawn for it and its number to the texture that it gets. `instances` are the personal one, then
    its look-alikes from hard to easy: the first two or more share the personal instance's base and
    ink colours, the last ones do not. A family without instances is clutter or a receptacle; `prop`
    holds its one fixed instance of the benchmarks. `name_stem` begins the names of the family's
    objects where the category alone would be ambiguous.
    """

    category: str
    mass_kg: float
    draw: Callable[[np.random.Generator], Shape]
    instances: Instances = ()
    prop: Instances = ()
    recolour: Callable[[Texture, int], Texture] | None = None
    name_stem: str = ""

    @property
    def stem(self) -> str:
        """What the names of the family's objects begin with."""
        return self.name_stem or self.category.replace(" ", "-")
