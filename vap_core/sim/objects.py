"""The object registry: every category has generic instances for training and, for evaluation, one personal instance with its look-alikes.

Look-alikes come graded: hard ones share the personal instance's base and ink colours and differ in motif, layout and subtle shape.
Generic instances draw their motifs and layouts from lists that evaluation instances never use.
"""

from colorsys import hsv_to_rgb
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from vap_core.errors import one_of
from vap_core.sim.catalogue import FAMILIES, Family
from vap_core.sim.catalogue.family import pick
from vap_core.sim.scans.stored import load, scans
from vap_core.sim.shapes import Hull, Mesh, Number, Shape, Solid
from vap_core.sim.textures import GENERIC_FILLS, GENERIC_GLYPHS, GENERIC_LAYOUTS, Ink, Texture, atlas
from vap_core.values import Rgb, value

if TYPE_CHECKING:
    import mujoco

VISUAL_GROUP, COLLISION_GROUP = 2, 3
_INDEX = {family.stem: i for i, family in enumerate(FAMILIES)}
CATEGORIES: tuple[str, ...] = tuple(dict.fromkeys(family.category for family in FAMILIES if family.instances))
CLUTTER: tuple[str, ...] = tuple(family.category for family in FAMILIES if not family.instances)


@value
class ObjectModel:
    """One object: its category, the split that may see it, and everything that decides its look, shape and mass (kg).

    `texture` is a decoration to draw, or the picture itself, as scans have.
    """

    name: str
    category: str
    split: Literal["generic", "personal", "lookalike", "prop"]
    shape: Shape
    texture: Texture | Rgb
    mass_kg: float


def _named(family: Family) -> list[ObjectModel]:
    named = [
        ObjectModel(
            f"{family.stem}-lookalike-{i}" if i else f"{family.stem}-personal", family.category, "lookalike" if i else "personal", shape, texture,
            family.mass_kg,
        )
        for i, (shape, texture) in enumerate(family.instances)
    ]  # fmt: skip
    return named + [ObjectModel(f"{family.stem}-prop", family.category, "prop", *prop, family.mass_kg) for prop in family.prop]


OBJECTS: dict[str, ObjectModel] = {model.name: model for family in FAMILIES for model in _named(family)}


def family_of(kind: str) -> Family:
    """The family of a category ("pen holder") or of a stem ("paper-cup"). Raises: UnknownName."""
    for family in FAMILIES:
        if kind in (family.category, family.stem):
            return family
    raise one_of("objects: category", kind, [*CATEGORIES, *CLUTTER])


def personal(kind: str) -> ObjectModel:
    """The user's own instance of a category, or of a family by its stem."""
    family = family_of(kind)
    if not family.instances:
        raise one_of("personal: category", kind, CATEGORIES)
    return OBJECTS[f"{family.stem}-personal"]


def lookalikes(kind: str) -> tuple[ObjectModel, ...]:
    """The instances that stand beside it, hardest first."""
    stem = personal(kind).name.removesuffix("personal")
    return tuple(model for name, model in OBJECTS.items() if name.startswith(f"{stem}lookalike-"))


def tier(model: ObjectModel) -> Literal["hard", "medium", "easy"]:
    """How close a look-alike's colours are to its personal instance: both base and ink shared, one of them, or neither."""
    mine = OBJECTS[f"{model.name.partition('-lookalike-')[0]}-personal"]
    return ("easy", "medium", "hard")[len(_inks(model) & _inks(mine))]


def _inks(model: ObjectModel) -> set[Ink]:
    return {model.texture.base, model.texture.ink} if isinstance(model.texture, Texture) else set()


def _colour(rng: np.random.Generator, bright: tuple[float, float], vivid: tuple[float, float] = (0.04, 0.4)) -> Ink:
    red, green, blue = hsv_to_rgb(float(rng.random()), float(rng.uniform(*vivid)), float(rng.uniform(*bright)))
    return round(255 * red), round(255 * green), round(255 * blue)


def _texture(rng: np.random.Generator) -> Texture:
    tones = [(0.72, 0.93), (0.22, 0.45), (0.4, 0.85)]
    light, dark, mid = (_colour(rng, tone) for tone in tones)
    base, ink = (light, dark) if rng.random() < 0.6 else (dark, light) if rng.random() < 0.5 else (mid, light)
    accent = mid if base != mid else dark
    motif = pick(rng, GENERIC_GLYPHS + GENERIC_FILLS)
    layout = pick(rng, GENERIC_LAYOUTS[:3] if motif in GENERIC_GLYPHS else GENERIC_LAYOUTS[3:])
    word = f"{rng.integers(1, 100)}" if motif == "digit" else ""
    return Texture(base, ink, accent, motif, layout, int(rng.integers(4, 9)), word, int(rng.integers(2**31)))


@lru_cache(maxsize=4096)
def generic(kind: str, index: int, twin: int = 0) -> ObjectModel:
    """Training instance number `index` (0 or more) of a category or stem: the same call, the same object.

    `twin` 1 or more is a look-alike of it, so that telling them apart can be trained without an evaluation object: decorated anew, in
    its colours (as often with one colour changed, now and then with all), and half the time of its very shape.
    """
    family = family_of(kind)
    rng = np.random.default_rng([20, _INDEX[family.stem], index])
    texture = _texture(rng)
    if family.paint is not None:
        texture = family.paint(texture, index)
    mass_kg = family.mass_kg * float(rng.uniform(0.8, 1.1))
    shape, name = family.draw(rng), f"{family.stem}-generic-{index:04d}"
    if twin:
        shape, texture, name = *_twin(family, shape, texture, index, twin), f"{name}-{twin}"
    return ObjectModel(name, family.category, "generic", shape, texture, mass_kg)


def _twin(family: Family, shape: Shape, texture: Texture, index: int, twin: int) -> tuple[Shape, Texture]:
    rng = np.random.default_rng([21, _INDEX[family.stem], index, twin])
    kind, same_shape = rng.random(), rng.random() < 0.5
    for _ in range(20):
        fresh = _texture(rng)
        if family.paint is not None:
            fresh = family.paint(fresh, int(rng.integers(2**31)))
        base, ink = (texture.ink, texture.base) if rng.random() < 0.2 else (texture.base, texture.ink)
        accent = texture.accent if rng.random() < 0.6 else fresh.accent
        if kind > 0.9:
            base, ink, accent = fresh.base, fresh.ink, fresh.accent
        elif kind > 0.5:
            base, ink = (base, fresh.ink) if rng.random() < 0.5 else (fresh.base, ink)
        other = replace(fresh, base=base, ink=ink, accent=accent)
        if (other.motif, other.layout) != (texture.motif, texture.layout) or len({base, ink} & {texture.base, texture.ink}) < 2:
            return shape if same_shape else family.draw(rng), other
    return family.draw(rng), other


def get(name: str) -> ObjectModel:
    """The object of that name: one of `OBJECTS`, or `<stem>-generic-<number>`, or one of the user's own scans (see `scan`)."""
    if name in OBJECTS:
        return OBJECTS[name]
    stem, _, rest = name.rpartition("-generic-")
    digits, _, twin = rest.partition("-")
    if stem in _INDEX and digits.isdecimal() and (twin.isdecimal() or not twin) and generic(stem, int(digits), int(twin or 0)).name == name:
        return generic(stem, int(digits), int(twin or 0))
    if name in (mine := scans()):
        return own(mine[name])
    raise one_of("get: object", name, [*OBJECTS, *(f"{kind}-generic-NNNN" for kind in _INDEX), *mine])


def own(place: Path) -> ObjectModel:
    """The scan in that folder. Raises: BadObject when it is damaged."""
    card, scan = load(place)
    return ObjectModel(card.name, card.category, "personal", scan, scan.image, card.mass_kg)


@lru_cache(maxsize=256)
def mesh(model: ObjectModel) -> Mesh:
    """The visual mesh, metres, standing on z = 0."""
    return model.shape.mesh()


def skin(model: ObjectModel) -> Rgb:
    """The picture that its texture coordinates point into."""
    return atlas(model.texture, model.shape.aspect()) if isinstance(model.texture, Texture) else model.texture


def extent_m(model: ObjectModel) -> tuple[float, float, float]:
    """Full x, y, z extents of the visual mesh, metres."""
    x, y, z = np.ptp(mesh(model).vertex, axis=0)
    return float(x), float(y), float(z)


def add_object(spec: "mujoco.MjSpec", model: ObjectModel, pos: tuple[Number, Number, Number] = (0, 0, 0), yaw: Number = 0.0) -> "mujoco.MjsBody":
    """Add the object, free to move, at `pos` (metres) and `yaw` (radians); the body's origin is the centre of its base.

    Visual geom in group 2 (no contact, no mass), collision geoms in group 3; the free joint is `<name>/free`.
    """
    import mujoco

    form, name = mesh(model), model.name
    face = form.face.ravel().tolist()
    picture = skin(model)
    height, width, _ = picture.shape
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height, nchannel=3)
    texture.data = picture.tobytes()
    material = spec.add_material(name=name, specular=0.25, shininess=0.4)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    spec.add_mesh(name=name, uservert=form.vertex.ravel(), usernormal=form.normal.ravel(), usertexcoord=form.uv.ravel(), userface=face,
                  userfacenormal=face, userfacetexcoord=face, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)  # fmt: skip
    body = spec.worldbody.add_body(name=name, pos=pos, quat=(np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)))
    body.add_freejoint(name=f"{name}/free")
    body.add_geom(name=f"{name}/visual", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, group=VISUAL_GROUP, contype=0, conaffinity=0,
                  density=0, mass=0)  # fmt: skip
    solids: tuple[Solid | Hull, ...] = model.shape.solids()
    volume = np.array([solid.volume for solid in solids])
    for i, (solid, mass_kg) in enumerate(zip(solids, model.mass_kg * volume / volume.sum(), strict=True)):
        body.add_geom(name=f"{name}/solid{i}", **_form(spec, f"{name}/solid{i}", solid), group=COLLISION_GROUP, mass=float(mass_kg), condim=4,
                      friction=(1, 0.01, 0.001), solref=(0.004, 1), solimp=(0.95, 0.99, 0.001, 0.5, 2))  # fmt: skip
    return body


def _form(spec: "mujoco.MjSpec", name: str, solid: Solid | Hull) -> dict[str, Any]:
    """What a collision geom is, and where: a primitive, or a convex mesh that the spec gets under `name`."""
    import mujoco

    if isinstance(solid, Hull):
        spec.add_mesh(name=name, uservert=solid.vertex.ravel())
        return {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": name}
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, solid.rotation().ravel())
    kind = getattr(mujoco.mjtGeom, f"mjGEOM_{solid.kind.upper()}")
    return {"type": kind, "size": (*solid.size, 0.0)[:3], "pos": solid.pos, "quat": quat}
