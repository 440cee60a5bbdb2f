"""Made-up designs as GLB files, for measuring on objects that nothing here was trained on.

They are built of other forms than the objects of the scenes (prisms, amphorae, rings, animals of
ellipsoids), with handles and without, plain or loud. They enter as a user's scans do:
`measure objects` imports them. Quiet ones take their colours from the look-alikes among which they
will stand, so that paint does not tell them apart. A seed is a set: measure on one that nobody
tuned on.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from vap_core.base.files import write_files
from vap_core.base.types import Rgb, value
from vap_core.simulation.assets import objects
from vap_make.objects.closed_parts import (
    Corners,
    blob,
    hollow,
    lathe,
    ring,
    tube,
)
from vap_make.objects.design_paint import LOUD, QUIET, draw_colours
from vap_make.objects.textures import Srgb, Texture

Rng = np.random.Generator
Body = list[Corners]
TABLE = "objects.csv"
WALL_M = 0.003
HANDLED = ("hexagon", "two-handled", "angular", "amphora", "jug", "loop", "bow", "knob")
"""Forms with something to hold them by."""


@value
class Design:
    """A made-up object as a GLB file, its category, and what the report is split by."""

    name: str
    category: str
    groups: tuple[str, ...]
    glb: bytes


def write_designs(folder: Path, count: int, seed: int) -> list[Path]:
    """Write `count` designs as GLB, and objects.csv with their categories; returns the files.

    Kinds take turns, of each kind the forms, and every other round is loud.

    Raises: BadOutput when the folder cannot be written, or holds other contents under these names.
    """
    lines = ["file,category,height_cm,groups"]
    files = {}
    for i in range(count):
        design = draw_design(i, seed)
        path = folder / f"{design.name}.glb"
        files[path] = design.glb
        lines.append(f"{path.name},{design.category},,{';'.join(design.groups)}")
    table = "\n".join(lines) + "\n"
    write_files({**files, folder / TABLE: table.encode()}, "designs", "choose another folder")
    return list(files)


def draw_design(number: int, seed: int) -> Design:
    """One design of a set."""
    rng = np.random.default_rng([83, seed, number])
    kinds = list(FORMS)
    category = kinds[number % len(kinds)]
    turn = number // len(kinds)
    form_name, form = FORMS[category][turn % len(FORMS[category])]
    paints = LOUD if (turn + number) % 2 else QUIET
    paint = paints[int(rng.integers(len(paints)))]
    colours = draw_colours(rng)
    if paints is QUIET:
        colours = _colours_of_lookalikes(rng, category)
    picture = paint(rng, colours)
    corner = np.concatenate(form(rng))
    corner[..., 2] -= corner[..., 2].min()
    slug = category.replace(" ", "-")
    name = f"{slug}-{form_name}-{paint.__name__}-{seed}-{number:02d}"
    groups = (
        "with handle" if form_name in HANDLED else "no handle",
        "quiet" if paints is QUIET else "loud",
    )
    return Design(name=name, category=category, groups=groups, glb=_to_glb(corner, picture))


def _colours_of_lookalikes(rng: Rng, category: str) -> list[Srgb]:
    """Base and ink of one of the kind's listed look-alikes."""
    listed = objects.lookalikes(category)
    texture = listed[int(rng.integers(len(listed)))].texture
    assert isinstance(texture, Texture), "listed objects are painted"
    return [texture.base, texture.ink]


def _to_glb(corner: Corners, picture: Rgb) -> bytes:
    """Triangles with the picture wrapped around them, y up, as glTF has it."""
    import trimesh

    height = float(np.ptp(corner[..., 2]))
    turn = np.arctan2(corner[..., 1], corner[..., 0]) / (2 * np.pi) + 0.5
    across_seam = np.ptp(turn, axis=1) > 0.5
    turn[across_seam] += turn[across_seam] < 0.5
    uv = np.stack([turn / 2, corner[..., 2] / height], axis=-1).reshape(-1, 2)
    vertex = corner.reshape(-1, 3)[:, [0, 2, 1]] * (1, 1, -1)
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(picture), roughnessFactor=1.0, metallicFactor=0.0
    )
    mesh = trimesh.Trimesh(
        vertices=vertex,
        faces=np.arange(len(vertex)).reshape(-1, 3),
        visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
        process=False,
    )
    data = mesh.export(file_type="glb")
    assert isinstance(data, bytes), "GLB is binary"
    return data


def _cup(rng: Rng, *, sides: int, handles: int, corners: int = 12) -> Body:
    """A mug: a prism or a barrel, with no handle, one or two; few corners make handles angular."""
    height, wide = rng.uniform(0.065, 0.078), rng.uniform(0.0195, 0.0215)
    belly = wide * rng.uniform(0.9, 1.06)
    profile = [(wide, 0.0), (belly, 0.35 * height), (belly, 0.65 * height), (wide, height)]
    parts = [hollow(profile, WALL_M, sides)]
    reach = rng.uniform(0.011, 0.015)
    path = ring((0.9 * wide, 0.0, 0.5 * height), (reach, 0.28 * height), WALL_M / 2, corners)
    for i in range(handles):
        parts.append(_turned(tube(path, 0.0026), np.pi * i))
    return parts


def _vase(rng: Rng, *, sides: int, handles: int, neck: float) -> Body:
    """A vase: a belly below and a neck above; an amphora with two handles."""
    height, wide = rng.uniform(0.095, 0.115), rng.uniform(0.019, 0.0215)
    foot, throat = 0.6 * wide, neck * wide
    profile = [
        (foot, 0.0),
        (0.9 * wide, 0.18 * height),
        (wide, 0.36 * height),
        (0.8 * wide, 0.55 * height),
        (throat, 0.72 * height),
        (throat, 0.9 * height),
        (1.25 * throat, height),
    ]
    parts = [hollow(profile, WALL_M, sides)]
    path = ring((throat, 0.0, 0.72 * height), (0.7 * wide, 0.15 * height), WALL_M / 2)
    for i in range(handles):
        parts.append(_turned(tube(path, 0.0024), np.pi * i))
    return parts


def _plant(rng: Rng, *, sides: int, crown: str) -> Body:
    """A pot, a prism or round, with a cactus of spheres, a tree of cones, or a bush of leaves."""
    wide, pot = rng.uniform(0.018, 0.021), rng.uniform(0.028, 0.034)
    parts = [lathe([(0, 0), (0.75 * wide, 0), (wide, pot), (0.0, pot)], sides)]
    if crown == "cactus":
        parts.append(blob((0, 0, pot + 0.013), (0.012, 0.012, 0.017)))
        parts.append(blob((0.013, 0, pot + 0.019), (0.006, 0.006, 0.009)))
        parts.append(blob((-0.012, 0.002, pot + 0.012), (0.006, 0.006, 0.008)))
    elif crown == "tree":
        for i in range(3):
            low, high = pot - 0.002 + 0.01 * i, pot + 0.018 + 0.01 * i
            parts.append(lathe([(0, low), (0.018 - 0.004 * i, low), (0, high)], 12))
    else:
        for i in range(5):
            angle = 2 * np.pi * i / 5 + rng.uniform(-0.3, 0.3)
            x, y = 0.009 * np.cos(angle), 0.009 * np.sin(angle)
            parts.append(blob((x, y, pot + 0.012), (0.009, 0.009, rng.uniform(0.012, 0.018))))
    return parts


def _toy(rng: Rng, *, ears: str, legs: int) -> Body:
    """An animal of ellipsoids, sitting (two legs) or on all fours."""
    wide = rng.uniform(0.017, 0.02)
    parts = [blob((0, 0, 0.028), (wide, 1.25 * wide, 0.02))]
    head = (0.0, -0.9 * wide, 0.048)
    parts.append(blob(head, (0.016, 0.015, 0.0145)))
    parts.append(blob((0.0, head[1] - 0.013, 0.045), (0.006, 0.006, 0.005)))
    longest = {"long": 0.016, "round": 0.006, "flat": 0.004}[ears]
    broad = 0.011 if ears == "flat" else 0.005
    for side in (-1, 1):
        at = (side * 0.011, head[1], 0.059 + 0.6 * longest)
        parts.append(blob(at, (broad, 0.004, longest)))
        for i in range(legs // 2):
            y = (-0.7 + 1.4 * i) * wide
            parts.append(blob((side * 0.6 * wide, y, 0.012), (0.007, 0.008, 0.012), boxy=1.5))
    parts.append(blob((0, 1.3 * wide, 0.03), (0.005, 0.009, 0.005)))
    return parts


def _pouch(rng: Rng, *, handle: str, boxy: float) -> Body:
    """A flat bag, with no handle, a loop at its side, or a bow above."""
    wide, deep, tall = rng.uniform(0.033, 0.038), rng.uniform(0.016, 0.019), 0.028
    parts = [blob((0, 0, tall), (wide, deep, tall), boxy)]
    if handle == "loop":
        path = ring((0.9 * wide, 0, tall), (0.012, 0.012), 0.004)
        parts.append(tube(path, 0.0025))
    elif handle == "bow":
        path = []
        for angle in np.linspace(0, np.pi, 14):
            z = 1.7 * tall + 0.018 * float(np.sin(angle))
            path.append((0.55 * wide * float(np.cos(angle)), 0.0, z))
        parts.append(tube(path, 0.0028))
    return parts


def _slipper(rng: Rng, *, heel: float, strap: str) -> Body:
    """A sole, with a closed toe, one strap, or two, and a heel of some height (m)."""
    long, wide = rng.uniform(0.046, 0.052), rng.uniform(0.019, 0.022)
    parts = [blob((0, 0, heel + 0.008), (wide, long, 0.008), 2.0)]
    if heel:
        parts.append(blob((0, 0.55 * long, 0.6 * heel), (0.8 * wide, 0.4 * long, 0.6 * heel), 2.5))
        parts.append(blob((0, -0.6 * long, 0.6 * heel), (0.8 * wide, 0.3 * long, 0.6 * heel), 2.5))
    if strap == "toe":
        parts.append(blob((0, -0.5 * long, heel + 0.018), (0.95 * wide, 0.45 * long, 0.018)))
        return parts
    places = (-0.45,) if strap == "one" else (-0.6, -0.1)
    for share in places:
        path = []
        for angle in np.linspace(0, np.pi, 14):
            z = heel + 0.008 + 0.026 * float(np.sin(angle))
            path.append((0.9 * wide * float(np.cos(angle)), share * long, z))
        parts.append(tube(path, 0.003, flat=3.0))
    return parts


def _scrubber(rng: Rng, *, grip: str, boxy: float) -> Body:
    """A block, with a knob, a bow or nothing to hold it by."""
    wide, deep = rng.uniform(0.018, 0.021), rng.uniform(0.018, 0.021)
    tall = 0.03 if grip == "none" else 0.018
    parts = [blob((0, 0, tall), (wide, deep, tall), boxy)]
    if grip == "knob":
        parts.append(lathe([(0, 0.03), (0.006, 0.03), (0.006, 0.05), (0, 0.05)]))
        parts.append(blob((0, 0, 0.054), (0.013, 0.013, 0.01)))
    elif grip == "bow":
        path = []
        for angle in np.linspace(0, np.pi, 14):
            z = 0.03 + 0.028 * float(np.sin(angle))
            path.append((0.8 * wide * float(np.cos(angle)), 0.0, z))
        parts.append(tube(path, 0.0045))
    return parts


def _turned(corner: Corners, angle: float) -> Corners:
    """Turned around the z axis."""
    cos, sin = np.cos(angle), np.sin(angle)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return corner @ rotation.T


FORMS: dict[str, tuple[tuple[str, Callable[[Rng], Body]], ...]] = {
    "cup": (
        ("hexagon", partial(_cup, sides=6, handles=1)),
        ("two-handled", partial(_cup, sides=40, handles=2)),
        ("beaker", partial(_cup, sides=4, handles=0)),
        ("angular", partial(_cup, sides=40, handles=1, corners=3)),
    ),
    "vase": (
        ("amphora", partial(_vase, sides=40, handles=2, neck=0.5)),
        ("prism", partial(_vase, sides=5, handles=0, neck=0.6)),
        ("jug", partial(_vase, sides=40, handles=1, neck=0.65)),
    ),
    "plushie": (
        ("hare", partial(_toy, ears="long", legs=4)),
        ("mouse", partial(_toy, ears="flat", legs=2)),
        ("bear", partial(_toy, ears="round", legs=4)),
    ),
    "slipper": (
        ("clog", partial(_slipper, heel=0.014, strap="toe")),
        ("sandal", partial(_slipper, heel=0.0, strap="two")),
        ("mule", partial(_slipper, heel=0.012, strap="one")),
    ),
    "plant": (
        ("cactus", partial(_plant, sides=4, crown="cactus")),
        ("tree", partial(_plant, sides=40, crown="tree")),
        ("bush", partial(_plant, sides=6, crown="bush")),
    ),
    "stuffed toy": (
        ("mouse", partial(_toy, ears="flat", legs=4)),
        ("bear", partial(_toy, ears="round", legs=2)),
        ("hare", partial(_toy, ears="long", legs=2)),
    ),
    "pouch": (
        ("loop", partial(_pouch, handle="loop", boxy=1.6)),
        ("cushion", partial(_pouch, handle="none", boxy=1.0)),
        ("bow", partial(_pouch, handle="bow", boxy=2.2)),
    ),
    "scrubber": (
        ("knob", partial(_scrubber, grip="knob", boxy=2.0)),
        ("block", partial(_scrubber, grip="none", boxy=2.5)),
        ("bow", partial(_scrubber, grip="bow", boxy=1.0)),
    ),
}
"""Of every category of tabletop, in the order in which they take turns."""
