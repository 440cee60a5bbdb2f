"""How the objects of the scenes are drawn: the catalogue, and generic instances for training.

Generic instances draw their motifs and layouts from lists that evaluation instances never use.
Fixed instances have the parameters that their rows in `data/catalogue/objects.jsonl` have; edit
those, and bake what ships with `python -m vap_make.objects`. Importing this package adds every
generic instance to what `get_object` finds.
"""

from collections.abc import Mapping
from dataclasses import fields, replace
from functools import lru_cache
from typing import Any, get_type_hints

import numpy as np

from vap_core.base.errors import one_of
from vap_core.base.types import Rgb, value
from vap_core.simulation.assets.objects import (
    CATEGORIES,
    CLUTTER,
    MAKERS,
    OBJECTS,
    RED,
    RED_PAINT,
    Baked,
    ObjectModel,
)
from vap_core.simulation.assets.shapes import Mesh, Solid, Texture
from vap_make.objects.families import FAMILIES, Family
from vap_make.objects.generics import draw_texture, draw_twin
from vap_make.objects.shapes import Shape
from vap_make.objects.textures import render_atlas

FAMILY_NUMBERS: dict[str, int] = {family.stem: i for i, family in enumerate(FAMILIES)}
"""Seeds depend on these numbers."""


@value
class Drawn:
    """A parametric body and its decoration."""

    body: Shape
    texture: Texture

    def mesh(self) -> Mesh:
        return self.body.mesh()

    def solids(self) -> tuple[Solid, ...]:
        return self.body.solids()

    def picture(self) -> Rgb:
        return render_atlas(self.texture, self.body.aspect())


def _spelled(body: Shape) -> dict[str, Any]:
    """The parameters of a body, as digests of runs spell them."""
    lengths = {part.name: getattr(body, part.name) for part in fields(body)}  # type: ignore[arg-type]
    return {"kind": type(body).__name__, **lengths}


def _body(family: Family, shape: Mapping[str, Any]) -> Shape:
    """The body of a family with the parameters of a row of the catalogue."""

    def tuples(given: Any) -> Any:
        return tuple(map(tuples, given)) if isinstance(given, list) else given

    kind: type[Shape] = get_type_hints(family.draw)["return"]
    names = {part.name for part in fields(kind)}  # type: ignore[arg-type]
    return kind(**{name: tuples(given) for name, given in shape.items() if name in names})


def family_of(kind: str) -> Family:
    """The family of a category or a stem. Raises: UnknownName."""
    for family in FAMILIES:
        if kind in (family.category, family.stem):
            return family
    raise one_of("objects: category", kind, [*CATEGORIES, *CLUTTER])


def _drawn(model: ObjectModel) -> ObjectModel:
    """An object of the catalogue, drawn with its row's parameters."""
    assert isinstance(model.form, Baked)
    assert isinstance(model.shape, dict)
    body = _body(family_of(model.form.stem), model.shape)
    return replace(model, form=Drawn(body, model.form.texture))


FIXED: dict[str, ObjectModel] = {name: _drawn(model) for name, model in OBJECTS.items()}
"""Personal instances, look-alikes and props: their parameters are the catalogue's rows."""


@lru_cache(maxsize=4096)
def generic_instance(kind: str, index: int, twin: int = 0) -> ObjectModel:
    """Training instance number `index` (0 or more) of a kind: the same call, the same object.

    `twin` 1 or more is a look-alike of it, so that telling instances apart can be trained without
    an evaluation object: it is decorated anew, in its colours (as often with one colour changed,
    now and then with all), and half the time of its very shape.
    """
    family = family_of(kind)
    number = FAMILY_NUMBERS[family.stem]
    rng = np.random.default_rng([20, number, index])
    texture = draw_texture(rng)
    if family.recolour is not None:
        texture = family.recolour(texture, index)
    mass_kg = family.mass_kg * float(rng.uniform(0.8, 1.1))
    body = family.draw(rng)
    name = f"{family.stem}-generic-{index:04d}"
    if twin:
        twin_rng = np.random.default_rng([21, number, index, twin])
        body, texture = draw_twin(family, body, texture, twin_rng)
        name = f"{name}-{twin}"
    shape, form = _spelled(body), Drawn(body, texture)
    return ObjectModel(name, family.category, "generic", shape, texture, mass_kg, form)


def draw(name: str) -> ObjectModel | None:
    """The drawn object with exactly this name: fixed or generic, and with -red."""
    plain = name.removesuffix(RED)
    model = FIXED.get(plain)
    stem, _, numbers = plain.rpartition("-generic-")
    index, _, twin = numbers.partition("-")
    if stem in FAMILY_NUMBERS and index.isdecimal() and (twin or "0").isdecimal():
        model = generic_instance(stem, int(index), int(twin or 0))
    if model is None or model.name != plain:
        return None
    if plain == name:
        return model
    assert isinstance(model.form, Drawn)
    texture = replace(model.form.texture, base=RED_PAINT)
    return replace(model, name=name, texture=texture, form=Drawn(model.form.body, texture))


if draw not in MAKERS:
    MAKERS.append(draw)
