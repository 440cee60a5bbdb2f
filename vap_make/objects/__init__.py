"""How the objects of the scenes are drawn: the catalogue, and generic instances for training.

Generic instances draw their motifs and layouts from lists that evaluation instances never use.
Fixed instances have the parameters that their rows in `data/catalogue/objects.jsonl` have; edit
those, and bake what ships with `python -m vap_make.objects`. Importing this package adds every
generic instance to what `get_object` finds.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from colorsys import hsv_to_rgb
from dataclasses import fields, replace
from functools import lru_cache
from typing import Any, get_type_hints

import numpy as np

from vap_core.base.errors import one_of
from vap_core.base.types import Mask, Rgb, value
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
from vap_core.simulation.assets.shapes import Mesh, Solid, Srgb, Texture
from vap_make.colours import HUES_DEG, MAIN, seen, shares
from vap_make.objects.families import FAMILIES, Family
from vap_make.objects.generics import draw_texture, draw_twin
from vap_make.objects.shapes import Shape
from vap_make.objects.textures import render_atlas

FAMILY_NUMBERS: dict[str, int] = {family.stem: i for i, family in enumerate(FAMILIES)}
"""Seeds depend on these numbers."""
WHOLE, SOAKED = 0.75, (0.35, 0.9)
"""Share of dyed objects that are dyed all around, and how much dye their materials take."""
HOW_MANY, MOST_DYED = (0.1, 0.25, 0.65), 0.9
"""Shares of scenes in which nothing is dyed, one object, or each with that chance."""
TRACE = 0.03
"""Share of materials from which they have a colour that was to be avoided."""
DYES = 1_000
"""Dyes have numbers below this one."""


@value
class Dye:
    """A colour that an object's materials are dyed with, from their left edge on.

    `share` of it is mixed into their own colours, so that a motif stays, in shades of one hue;
    `around` is the part of the decoration that is dyed.
    """

    rgb: Srgb
    share: float
    around: float = 1.0

    def on(self, picture: Rgb) -> Rgb:
        """The materials in `picture`, dyed."""
        dyed = picture.astype(np.float32)
        part = dyed[:, : round(self.around * picture.shape[1])]
        part += self.share * (np.array(self.rgb, np.float32) - part)
        return np.rint(dyed).astype(np.uint8)


@value
class Drawn:
    """A parametric body and its decoration."""

    body: Shape
    texture: Texture
    dye: Dye | None = None

    def mesh(self) -> Mesh:
        return self.body.mesh()

    def solids(self) -> tuple[Solid, ...]:
        return self.body.solids()

    def picture(self) -> Rgb:
        picture = render_atlas(self.texture, self.body.aspect())
        return picture if self.dye is None else self.dye.on(picture)


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


@lru_cache(maxsize=DYES)
def draw_dye(number: int) -> Dye:
    """Any hue, more or less vivid; now and then only half an object is dyed."""
    rng = np.random.default_rng([22, number])
    vivid, bright = rng.uniform((0.65, 0.4), 1.0)
    red, green, blue = (round(255 * c) for c in hsv_to_rgb(rng.random(), vivid, bright))
    around = 1.0 if rng.random() < WHOLE else float(rng.uniform(0.4, 0.7))
    return Dye((red, green, blue), float(rng.uniform(*SOAKED)), around)


@lru_cache(maxsize=4096)
def generic_instance(kind: str, index: int, twin: int = 0, dye: int = 0) -> ObjectModel:
    """Training instance number `index` (0 or more) of a kind: the same call, the same object.

    `twin` 1 or more is a look-alike of it, so that telling instances apart can be trained without
    an evaluation object: it is decorated anew, in its colours (as often with one colour changed,
    now and then with all), and half the time of its very shape. `dye` 1 or more is the number of a
    colour that it is dyed with.
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
    if dye:
        name = f"{family.stem}-generic-{index:04d}-{twin}-{dye}"
    shape, form = _spelled(body), Drawn(body, texture, draw_dye(dye) if dye else None)
    return ObjectModel(name, family.category, "generic", shape, texture, mass_kg, form)


def dyed(model: ObjectModel, dye: int) -> ObjectModel:
    """A generic instance with a dye of this number."""
    stem, _, numbers = model.name.rpartition("-generic-")
    index, twin = (*map(int, numbers.split("-")), 0)[:2]
    return generic_instance(stem, index, twin, dye)


def dye_some(
    models: Sequence[ObjectModel], rng: np.random.Generator, avoid: Collection[str] = ()
) -> list[ObjectModel]:
    """The objects, none of them dyed, one, or most, each in a hue that has a word of its own.

    One whose own materials have a colour to avoid is dyed in any case.
    """
    words = rng.permutation([word for word in HUES_DEG if word not in avoid]).tolist()
    most = rng.binomial(len(models), MOST_DYED)
    n = rng.choice([0, 1, most], p=HOW_MANY)
    marked = rng.permutation(len(models))[:n]
    chosen = []
    for i, model in enumerate(models):
        if i in marked or _has(shares(*_swatch(model)), avoid):
            model = dyed_as(words.pop(), model, rng, avoid)
        chosen.append(model)
    return chosen


def dyed_as(
    word: str, model: ObjectModel, rng: np.random.Generator, avoid: Collection[str] = ()
) -> ObjectModel:
    """The object with a dye that its materials are called by; without one where none does it."""
    picture, whole = _swatch(model)
    for number in rng.permutation(np.arange(1, DYES)).tolist():
        found = shares(draw_dye(number).on(picture), whole)
        if found[word] >= MAIN and not _has(found, avoid):
            return dyed(model, number)
    return model


def _has(found: Mapping[str, float], words: Collection[str]) -> bool:
    """Whether there is a trace of one of the colours."""
    return any(found[word] > TRACE for word in words)


@lru_cache(maxsize=8192)
def material_colours(name: str) -> tuple[str, frozenset[str]]:
    """The colours of a drawn object's materials in white light, as `colours.seen` tells them."""
    model = draw(name)
    assert model is not None
    picture, whole = _swatch(model)
    return seen([picture], [whole])


def _swatch(model: ObjectModel) -> tuple[Rgb, Mask]:
    """An object's materials."""
    picture = model.form.picture()[::4, ::4]
    return picture, np.ones(picture.shape[:2], bool)


def draw(name: str) -> ObjectModel | None:
    """The drawn object with exactly this name: fixed or generic, and with -red."""
    plain = name.removesuffix(RED)
    model = FIXED.get(plain)
    stem, _, numbers = plain.rpartition("-generic-")
    if stem in FAMILY_NUMBERS and re.fullmatch(r"\d+(-\d+){0,2}", numbers, re.ASCII):
        model = generic_instance(stem, *map(int, numbers.split("-")))
    if model is None or model.name != plain:
        return None
    if plain == name:
        return model
    assert isinstance(model.form, Drawn)
    texture = replace(model.form.texture, base=RED_PAINT)
    return replace(model, name=name, texture=texture, form=Drawn(model.form.body, texture))


if draw not in MAKERS:
    MAKERS.append(draw)
