"""The object registry: every object of the scenes by its name.

Every category has generic instances for training and, for evaluation, one personal instance with
its look-alikes. Look-alikes are graded: hard ones share the personal instance's base and ink
colours and differ in motif, layout and subtle shape. Generic instances draw their motifs and
layouts from lists that evaluation instances never use.

A "kind" is a category ("pen holder") or the stem of a family ("paper-cup").
"""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np

from vap_core.base.errors import UnknownName, one_of
from vap_core.base.types import Rgb, value
from vap_core.simulation.assets.atlas import render_atlas
from vap_core.simulation.assets.catalogue import FAMILIES, Family
from vap_core.simulation.assets.generics import draw_texture, draw_twin
from vap_core.simulation.assets.scans.storage import load_scan, scan_folders
from vap_core.simulation.assets.shapes import Mesh, Shape
from vap_core.simulation.assets.textures import Srgb, Texture

RED = "-red"
"""Ends the name of an object that is red by nature, and else as the one before it."""
RED_PAINT: Srgb = (196, 24, 28)

Tier = Literal["hard", "medium", "easy"]
TIERS: tuple[Tier, ...] = ("hard", "medium", "easy")


@value
class ObjectModel:
    """One object: its category, the split that may use it, its shape, its texture and its mass.

    `texture` is a decoration to draw, or the picture itself, as scans have.
    """

    name: str
    category: str
    split: Literal["generic", "personal", "lookalike", "prop"]
    shape: Shape
    texture: Texture | Rgb
    mass_kg: float


def _categories(with_instances: bool) -> tuple[str, ...]:
    """Categories in the catalogue's order: those with evaluation instances, or those without."""
    names: dict[str, None] = {}
    for family in FAMILIES:
        if bool(family.instances) == with_instances:
            names[family.category] = None
    return tuple(names)


def _fixed_objects() -> dict[str, ObjectModel]:
    """Every object but the generic ones and the scans: personal, look-alikes and props."""
    models: dict[str, ObjectModel] = {}

    def add(
        family: Family,
        suffix: str,
        split: Literal["personal", "lookalike", "prop"],
        shape: Shape,
        texture: Texture,
    ) -> None:
        name = f"{family.stem}-{suffix}"
        models[name] = ObjectModel(
            name=name,
            category=family.category,
            split=split,
            shape=shape,
            texture=texture,
            mass_kg=family.mass_kg,
        )

    for family in FAMILIES:
        for i, (shape, texture) in enumerate(family.instances):
            if i == 0:
                add(family, "personal", "personal", shape, texture)
            else:
                add(family, f"lookalike-{i}", "lookalike", shape, texture)
        for shape, texture in family.prop:
            add(family, "prop", "prop", shape, texture)
    return models


CATEGORIES: tuple[str, ...] = _categories(with_instances=True)
CLUTTER: tuple[str, ...] = _categories(with_instances=False)
"""Categories without evaluation instances: clutter and receptacles."""
OBJECTS: dict[str, ObjectModel] = _fixed_objects()
FAMILY_NUMBERS: dict[str, int] = {family.stem: i for i, family in enumerate(FAMILIES)}
"""Seeds depend on these numbers."""


def family_of(kind: str) -> Family:
    """The family of a kind. Raises: UnknownName."""
    for family in FAMILIES:
        if kind in (family.category, family.stem):
            return family
    raise one_of("objects: category", kind, [*CATEGORIES, *CLUTTER])


def personal_instance(kind: str) -> ObjectModel:
    """The user's own instance of a kind. Raises: UnknownName."""
    family = family_of(kind)
    if not family.instances:
        raise one_of("objects: category", kind, CATEGORIES)
    return OBJECTS[f"{family.stem}-personal"]


def lookalikes(kind: str) -> tuple[ObjectModel, ...]:
    """The look-alikes of the personal instance, hardest first."""
    prefix = personal_instance(kind).name.removesuffix("personal") + "lookalike-"
    return tuple(model for name, model in OBJECTS.items() if name.startswith(prefix))


def tier(lookalike: ObjectModel) -> Tier:
    """How close a look-alike's colours are to its personal instance's.

    hard: base and ink are both shared; medium: one of them; easy: neither.
    """
    stem, _, _ = lookalike.name.partition("-lookalike-")
    shared = _base_and_ink(lookalike) & _base_and_ink(OBJECTS[f"{stem}-personal"])
    return ("easy", "medium", "hard")[len(shared)]


def _base_and_ink(model: ObjectModel) -> set[Srgb]:
    if isinstance(model.texture, Texture):
        return {model.texture.base, model.texture.ink}
    return set()


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
    shape = family.draw(rng)
    name = f"{family.stem}-generic-{index:04d}"
    if twin:
        twin_rng = np.random.default_rng([21, number, index, twin])
        shape, texture = draw_twin(family, shape, texture, twin_rng)
        name = f"{name}-{twin}"
    return ObjectModel(
        name=name,
        category=family.category,
        split="generic",
        shape=shape,
        texture=texture,
        mass_kg=mass_kg,
    )


def get_object(name: str) -> ObjectModel:
    """The object of that name.

    It is one of `OBJECTS`, or `<stem>-generic-<index>`, or `<stem>-generic-<index>-<twin>`, or one
    of these in red, `<name>-red`, or one of the user's own scans.

    Raises:
        UnknownName: there is no such object, or VAP_OBJECTS names no folder.
        BadObject: it is a scan that is damaged.
    """
    if name in OBJECTS:
        return OBJECTS[name]
    generic = _generic_of_name(name)
    if generic is not None:
        return generic
    red = _red_of_name(name)
    if red is not None:
        return red
    scanned = scan_folders()
    if name in scanned:
        return load_scanned_object(scanned[name])
    generic_names = [f"{stem}-generic-NNNN" for stem in FAMILY_NUMBERS]
    unknown = one_of("objects: object", name, [*OBJECTS, *generic_names, *scanned])
    raise UnknownName(
        f"{unknown} One that was registered has photos alone: bring its scan by objects import, or "
        "point VAP_OBJECTS at its folder."
    )


def _generic_of_name(name: str) -> ObjectModel | None:
    """The generic instance with exactly this name."""
    stem, _, numbers = name.rpartition("-generic-")
    index, _, twin = numbers.partition("-")
    if stem not in FAMILY_NUMBERS or not index.isdecimal():
        return None
    if twin and not twin.isdecimal():
        return None
    model = generic_instance(stem, int(index), int(twin or 0))
    if model.name != name:
        return None
    return model


@lru_cache(maxsize=256)
def _red_of_name(name: str) -> ObjectModel | None:
    """The drawn object with this name, red where its base colour is."""
    plain = name.removesuffix(RED)
    if plain == name:
        return None
    model = OBJECTS.get(plain) or _generic_of_name(plain)
    if model is None or not isinstance(model.texture, Texture):
        return None
    return replace(model, name=name, texture=replace(model.texture, base=RED_PAINT))


def load_scanned_object(folder: Path) -> ObjectModel:
    """The scan in that folder. Raises: BadObject when it is damaged."""
    metadata, scan = load_scan(folder)
    return ObjectModel(
        name=metadata.name,
        category=metadata.category,
        split="personal",
        shape=scan,
        texture=scan.image,
        mass_kg=metadata.mass_kg,
    )


@lru_cache(maxsize=256)
def mesh_of(model: ObjectModel) -> Mesh:
    """The visual mesh, metres, standing on z = 0."""
    return model.shape.mesh()


def texture_image(model: ObjectModel) -> Rgb:
    """The picture that the mesh's texture coordinates point into."""
    if isinstance(model.texture, Texture):
        return render_atlas(model.texture, model.shape.aspect())
    return model.texture


def extent_m(model: ObjectModel) -> tuple[float, float, float]:
    """Full x, y, z extents of the visual mesh, metres."""
    x, y, z = np.ptp(mesh_of(model).vertex, axis=0)
    return float(x), float(y), float(z)
