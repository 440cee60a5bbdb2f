"""The object registry: every category has generic instances for training and, for evaluation, one personal instance with four look-alikes.

Look-alikes share colours with the personal instance and differ in motif, layout and subtle shape. Generic instances draw their motifs
and layouts from lists that evaluation instances never use.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from vap_core.errors import one_of
from vap_core.sim.bodies import Bottle, Cup, Owl, PenHolder, StrawCup, Vase
from vap_core.sim.gadgets import CameraBody, Can, Shaver
from vap_core.sim.shapes import Mesh, Number
from vap_core.sim.textures import ATLAS_PX, GENERIC_FILLS, GENERIC_GLYPHS, GENERIC_LAYOUTS, Ink, Texture, atlas
from vap_core.values import value

if TYPE_CHECKING:
    import mujoco

CATEGORIES: tuple[str, ...] = ("cup", "bottle", "pen holder", "straw cup", "owl figurine", "vase", "camera", "shaver")
CLUTTER: tuple[str, ...] = ("coke can",)
Shape = Cup | Bottle | PenHolder | StrawCup | Owl | Vase | CameraBody | Shaver | Can
VISUAL_GROUP, COLLISION_GROUP = 2, 3


@value
class ObjectModel:
    """One object: its category, the split that may see it, and everything that decides its look, shape and mass (kg)."""

    name: str
    category: str
    split: Literal["generic", "personal", "lookalike"]
    shape: Shape
    texture: Texture
    mass_kg: float


def _slug(category: str) -> str:
    return category.replace(" ", "-")


CREAM, BONE, SAND, RUST = (233, 223, 201), (219, 214, 206), (201, 176, 139), (140, 79, 62)
SAGE, MOSS, TEAL, SLATE, NAVY = (157, 171, 146), (91, 106, 77), (71, 115, 117), (98, 112, 127), (51, 63, 86)
PLUM, ROSE, MUSTARD, COCOA, COAL = (102, 73, 93), (198, 151, 149), (198, 158, 83), (87, 66, 55), (57, 57, 61)
URN = ((0.0165, 0.0), (0.0185, 0.2), (0.0212, 0.55), (0.0195, 0.72), (0.011, 0.9), (0.0145, 1.0))
GOURD = ((0.0185, 0.0), (0.0212, 0.25), (0.0185, 0.55), (0.0172, 0.75), (0.0115, 0.9), (0.0155, 1.0))
AMPHORA = ((0.0150, 0.0), (0.0190, 0.35), (0.0215, 0.62), (0.0185, 0.76), (0.0085, 0.88), (0.0125, 1.0))
FLUTE = ((0.0165, 0.0), (0.0172, 0.3), (0.0182, 0.6), (0.0195, 0.85), (0.0215, 1.0))

_EVALUATION: dict[str, tuple[tuple[Shape, Texture], ...]] = {
    "cup": (
        (Cup(), Texture(CREAM, RUST, TEAL, "heart", "row", 4)),
        (Cup(0.0205, 0.0205, 0.070, "square", 0.016), Texture(CREAM, TEAL, RUST, "hoops", "full", 8)),
        (Cup(0.0185, 0.0215, 0.074, "ear", 0.018, "accent"), Texture(CREAM, CREAM, TEAL, "word", "band", 3, "MUG")),
        (Cup(0.0200, 0.0210, 0.068, "round", 0.015, "ink"), Texture(CREAM, RUST, TEAL, "dots", "full", 7)),
        (Cup(0.0195, 0.0215, 0.076, "ear", 0.016), Texture(CREAM, RUST, TEAL, "leaf", "brick", 6)),
    ),
    "bottle": (
        (Bottle(), Texture(SLATE, CREAM, MUSTARD, "star", "band", 4)),
        (Bottle(0.0205, 0.112, 0.72, 0.010, "sport"), Texture(SLATE, CREAM, MUSTARD, "stripes", "full", 7)),
        (Bottle(0.0195, 0.118, 0.66, 0.0085, "ball"), Texture(SLATE, CREAM, MUSTARD, "fish", "brick", 4)),
        (Bottle(0.0205, 0.114, 0.70, 0.009, "screw", 0.002), Texture(SLATE, CREAM, MUSTARD, "chevron", "half", 6)),
        (Bottle(0.0200, 0.110, 0.74, 0.011, "sport"), Texture(SLATE, CREAM, MUSTARD, "word", "row", 3, "H2O")),
    ),
    "pen holder": (
        (PenHolder(), Texture(SAGE, COCOA, CREAM, "paw", "row", 4)),
        (PenHolder(0.0205, 0.082, 6, 3, "ink"), Texture(SAGE, COCOA, CREAM, "checks", "full", 6)),
        (PenHolder(0.0200, 0.078, 4, 4, "base"), Texture(SAGE, COCOA, CREAM, "smile", "band", 4)),
        (PenHolder(0.0210, 0.080, 24, 5, "ink"), Texture(SAGE, CREAM, COCOA, "bolt", "brick", 6)),
        (PenHolder(0.0205, 0.076, 24, 3, "accent"), Texture(SAGE, COCOA, CREAM, "stripes", "half", 8)),
    ),
    "straw cup": (
        (StrawCup(), Texture(ROSE, PLUM, CREAM, "moon", "brick", 4)),
        (StrawCup(0.0170, 0.0215, 0.078, "dome", False), Texture(ROSE, PLUM, CREAM, "plaid", "full", 5)),
        (StrawCup(0.0175, 0.0210, 0.082, "step", True), Texture(ROSE, PLUM, CREAM, "flower", "band", 4)),
        (StrawCup(0.0165, 0.0210, 0.080, "flat", False), Texture(ROSE, PLUM, CREAM, "hoops", "half", 10)),
        (StrawCup(0.0170, 0.0215, 0.076, "dome", True), Texture(ROSE, PLUM, CREAM, "word", "row", 3, "YUM")),
    ),
    "owl figurine": (
        (Owl(), Texture(SAND, COCOA, CREAM, "heart", "brick", 8)),
        (Owl(0.076, 0.0215, "wide", 0.0080), Texture(SAND, COCOA, CREAM, "hoops", "full", 8)),
        (Owl(0.074, 0.0210, "none", 0.0068), Texture(SAND, COCOA, CREAM, "dots", "full", 9)),
        (Owl(0.080, 0.0210, "tuft", 0.0062, "spread"), Texture(SAND, MOSS, CREAM, "chevron", "full", 8)),
        (Owl(0.078, 0.0215, "wide", 0.0070, "spread"), Texture(SAND, COCOA, MUSTARD, "star", "band", 6)),
    ),
    "vase": (
        (Vase(), Texture(BONE, NAVY, SLATE, "leaf", "brick", 5)),
        (Vase(0.112, URN), Texture(BONE, NAVY, SLATE, "chevron", "full", 6)),
        (Vase(0.108, GOURD), Texture(BONE, NAVY, SLATE, "flower", "row", 4)),
        (Vase(0.114, AMPHORA, True), Texture(BONE, NAVY, SLATE, "hoops", "full", 10)),
        (Vase(0.106, FLUTE), Texture(BONE, BONE, NAVY, "fish", "band", 4)),
    ),
    "camera": (
        (CameraBody(), Texture(COAL, SAND, BONE, "dots", "full", 6)),
        (CameraBody(0.072, 0.052, 0.0150, "finder"), Texture(COAL, SAND, BONE, "stripes", "full", 5)),
        (CameraBody(0.064, 0.056, 0.0175, "flash"), Texture(COAL, BONE, SAND, "star", "brick", 5)),
        (CameraBody(0.070, 0.054, 0.0140, "none", True), Texture(COAL, SAND, BONE, "checks", "full", 5)),
        (CameraBody(0.066, 0.053, 0.0165, "prism", True), Texture(COAL, SAND, BONE, "chevron", "half", 5)),
    ),
    "shaver": (
        (Shaver(), Texture(TEAL, CREAM, COAL, "bolt", "brick", 4)),
        (Shaver(0.0190, 0.110, "rotary", 0.002, "bar"), Texture(TEAL, CREAM, COAL, "hoops", "half", 10)),
        (Shaver(0.0180, 0.116, "wide", 0.001), Texture(TEAL, CREAM, COAL, "stripes", "full", 6)),
        (Shaver(0.0190, 0.108, "foil", 0.002, "bar"), Texture(TEAL, CREAM, COAL, "checks", "full", 5)),
        (Shaver(0.0185, 0.114, "rotary", 0.0015), Texture(TEAL, CREAM, MUSTARD, "word", "band", 2, "TRIM")),
    ),
}
_MASS_KG = {
    "cup": 0.10,
    "bottle": 0.12,
    "pen holder": 0.10,
    "straw cup": 0.09,
    "owl figurine": 0.11,
    "vase": 0.12,
    "camera": 0.14,
    "shaver": 0.11,
    "coke can": 0.10,
}

OBJECTS: dict[str, ObjectModel] = {
    f"{_slug(category)}-{ending}": ObjectModel(
        f"{_slug(category)}-{ending}", category, "lookalike" if i else "personal", shape, texture, _MASS_KG[category]
    )
    for category, pairs in _EVALUATION.items()
    for i, (shape, texture) in enumerate(pairs)
    for ending in [f"lookalike-{i}" if i else "personal"]
}


def personal(category: str) -> ObjectModel:
    """The user's own instance of `category`."""
    if category not in CATEGORIES:
        raise one_of("personal: category", category, CATEGORIES)
    return OBJECTS[f"{_slug(category)}-personal"]


def lookalikes(category: str) -> tuple[ObjectModel, ...]:
    """The instances that stand beside it."""
    if category not in CATEGORIES:
        raise one_of("lookalikes: category", category, CATEGORIES)
    return tuple(model for model in OBJECTS.values() if model.category == category and model.split == "lookalike")


def _vase(rng: np.random.Generator) -> Vase:
    low, mid, neck, lip = rng.uniform((0.0150, 0.0190, 0.0080, 0.0110), (0.0185, 0.0220, 0.0150, 0.0185)).tolist()
    waist = float(rng.uniform(0.35, 0.6))
    return Vase(float(rng.uniform(0.098, 0.118)), ((low, 0.0), (mid, waist), (0.92 * mid, 0.74), (neck, 0.89), (lip, 1.0)),
                bool(rng.random() < 0.25))  # fmt: skip


_DRAW: dict[str, Callable[[np.random.Generator], Shape]] = {
    "cup": lambda g: Cup(g.uniform(0.0175, 0.0210), g.uniform(0.0195, 0.0220), g.uniform(0.065, 0.080), _pick(g, ("round", "square", "ear")),
                         g.uniform(0.014, 0.020), _pick(g, ("base", "ink", "accent"))),
    "bottle": lambda g: Bottle(g.uniform(0.0185, 0.0215), g.uniform(0.105, 0.120), g.uniform(0.65, 0.75), g.uniform(0.0075, 0.012),
                               _pick(g, ("screw", "sport", "ball")), g.uniform(0, 0.003)),
    "pen holder": lambda g: PenHolder(g.uniform(0.0190, 0.0215), g.uniform(0.074, 0.084), _pick(g, (4, 6, 24, 24)), int(g.integers(3, 6)),
                                      _pick(g, ("base", "ink", "accent"))),
    "straw cup": lambda g: StrawCup(g.uniform(0.0155, 0.0180), g.uniform(0.0200, 0.0218), g.uniform(0.074, 0.084), _pick(g, ("flat", "dome", "step")),
                                    bool(g.random() < 0.5)),
    "owl figurine": lambda g: Owl(g.uniform(0.070, 0.084), g.uniform(0.0200, 0.0218), _pick(g, ("tuft", "wide", "none")), g.uniform(0.006, 0.0085),
                                  _pick(g, ("folded", "spread"))),
    "vase": _vase,
    "camera": lambda g: CameraBody(g.uniform(0.060, 0.074), g.uniform(0.050, 0.058), g.uniform(0.013, 0.018),
                                   _pick(g, ("prism", "finder", "flash", "none")), bool(g.random() < 0.3)),
    "shaver": lambda g: Shaver(g.uniform(0.0175, 0.0195), g.uniform(0.106, 0.118), _pick(g, ("foil", "wide", "rotary")), g.uniform(0, 0.0035),
                               _pick(g, ("round", "bar"))),
    "coke can": lambda g: Can(g.uniform(0.0205, 0.0220), g.uniform(0.078, 0.090)),
}  # fmt: skip


def _pick[T](rng: np.random.Generator, choices: tuple[T, ...]) -> T:
    return choices[int(rng.integers(len(choices)))]


def _colour(rng: np.random.Generator, bright: tuple[float, float], vivid: tuple[float, float] = (0.04, 0.4)) -> Ink:
    from colorsys import hsv_to_rgb

    red, green, blue = hsv_to_rgb(float(rng.random()), float(rng.uniform(*vivid)), float(rng.uniform(*bright)))
    return round(255 * red), round(255 * green), round(255 * blue)


def _texture(rng: np.random.Generator) -> Texture:
    tones = [(0.72, 0.93), (0.22, 0.45), (0.4, 0.85)]
    light, dark, mid = (_colour(rng, tone) for tone in tones)
    base, ink = (light, dark) if rng.random() < 0.6 else (dark, light) if rng.random() < 0.5 else (mid, light)
    accent = mid if base != mid else dark
    motif = _pick(rng, GENERIC_GLYPHS + GENERIC_FILLS)
    layout = _pick(rng, GENERIC_LAYOUTS[:3] if motif in GENERIC_GLYPHS else GENERIC_LAYOUTS[3:])
    word = f"{rng.integers(1, 100)}" if motif == "digit" else ""
    return Texture(base, ink, accent, motif, layout, int(rng.integers(4, 9)), word, int(rng.integers(2**31)))


@lru_cache(maxsize=4096)
def generic(category: str, index: int) -> ObjectModel:
    """Training instance number `index` (0 or more) of a category or clutter kind: the same call, the same object."""
    kinds = CATEGORIES + CLUTTER
    if category not in kinds:
        raise one_of("generic: category", category, kinds)
    rng = np.random.default_rng([20, kinds.index(category), index])
    texture = _texture(rng)
    if category == "coke can":
        texture = Texture((150, 52, 52), (232, 228, 222), (150, 52, 52), "waves", "middle", 1 + index % 3)
    mass_kg = _MASS_KG[category] * float(rng.uniform(0.8, 1.1))
    return ObjectModel(f"{_slug(category)}-generic-{index:04d}", category, "generic", _DRAW[category](rng), texture, mass_kg)


def get(name: str) -> ObjectModel:
    """The object of that name: one of `OBJECTS`, or `<category>-generic-<number>` with hyphens for spaces."""
    if name in OBJECTS:
        return OBJECTS[name]
    slug, _, digits = name.rpartition("-generic-")
    kinds = {_slug(category): category for category in CATEGORIES + CLUTTER}
    if slug in kinds and digits.isdecimal() and name == f"{slug}-generic-{int(digits):04d}":
        return generic(kinds[slug], int(digits))
    raise one_of("get: object", name, [*OBJECTS, *(f"{kind}-generic-NNNN" for kind in kinds)])


@lru_cache(maxsize=256)
def mesh(model: ObjectModel) -> Mesh:
    """The visual mesh, metres, standing on z = 0."""
    return model.shape.mesh()


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
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=ATLAS_PX, height=ATLAS_PX, nchannel=3)
    texture.data = atlas(model.texture, model.shape.aspect()).tobytes()
    material = spec.add_material(name=name, specular=0.25, shininess=0.4)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    spec.add_mesh(name=name, uservert=form.vertex.ravel(), usernormal=form.normal.ravel(), usertexcoord=form.uv.ravel(), userface=face,
                  userfacenormal=face, userfacetexcoord=face, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)  # fmt: skip
    body = spec.worldbody.add_body(name=name, pos=pos, quat=(np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)))
    body.add_freejoint(name=f"{name}/free")
    body.add_geom(name=f"{name}/visual", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, group=VISUAL_GROUP, contype=0, conaffinity=0,
                  density=0, mass=0)  # fmt: skip
    kinds = {"box": mujoco.mjtGeom.mjGEOM_BOX, "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER}
    solids = model.shape.solids()
    volume = np.array([8 * np.prod(s.size) if s.kind == "box" else 2 * np.pi * s.size[0] ** 2 * s.size[1] for s in solids])
    for i, (solid, mass_kg) in enumerate(zip(solids, model.mass_kg * volume / volume.sum(), strict=True)):
        quat = (np.sqrt(0.5), np.sqrt(0.5), 0, 0) if solid.axis == "y" else (1, 0, 0, 0)
        body.add_geom(name=f"{name}/solid{i}", type=kinds[solid.kind], size=(*solid.size, 0.0)[:3], pos=solid.pos, quat=quat, group=COLLISION_GROUP,
                      mass=float(mass_kg), condim=4, friction=(1, 0.01, 0.001), solref=(0.004, 1), solimp=(0.95, 0.99, 0.001, 0.5, 2))  # fmt: skip
    return body
