"""A 3-D file of the user's becomes an object: read, checked, turned upright, reduced, painted, and split into convex parts.

What comes out stands on z = 0, centred on the z axis, z up, metres; its collision solids are the hulls of a convex decomposition.
"""

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from vap_core import __version__
from vap_core.errors import BadObject
from vap_core.memory import CATEGORY, NAME
from vap_core.sim import objects
from vap_core.sim.scans.bake import Paint, bake, shaded, shrink
from vap_core.sim.scans.closing import close, flaws
from vap_core.sim.scans.source import Source, read
from vap_core.sim.scans.stored import Card, Scan, scans
from vap_core.sim.scans.triangles import Faces, Vertices, decimate, normals
from vap_core.sim.shapes import Hull

VISUAL_FACES, TEXTURE_PX, HULLS, HULL_CORNERS = 3000, 1024, 16, 160
SMALLEST_M, LARGEST_M, THINNEST_M = 0.01, 0.6, 0.002
SLIVER_M3 = 1e-9
DENSITY_KG_M3, MASS_KG = 400.0, (0.03, 0.5)
TURN = {"z": np.eye(3), "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])}
"""Object (z up, front towards -y) from file, by the axis that points up in the file."""


def bring(
    path: Path, name: str, category: str, *, height_cm: float | None = None, up: Literal["y", "z"] | None = None, mass_kg: float | None = None,
    colour: str | None = None, repair: bool = False, licence: str = "", say: Callable[[str], None] = print,
) -> tuple[Card, Scan]:  # fmt: skip
    """Make a registry object of a GLB, OBJ, PLY or STL file; the decomposition takes some seconds, `say` hears of it.

    Without `height_cm` the file's units are metres; without `up` it is y for GLB and OBJ and z for PLY and STL; without `mass_kg` the
    mass follows from the hulls' volume.

    Raises:
        BadObject: the names or the file will not do; the message says what is wrong and how to mend it.
    """
    if not NAME.fullmatch(name):
        raise BadObject(f"objects: {name!r} cannot name an object; use letters, digits, space, dot, dash or underscore, for example --name my-mug.")
    if name in objects.OBJECTS or "-generic-" in name:
        raise BadObject(f"objects: {name!r} is one of the workspace's own objects; choose another --name, for example my-{name}.")
    if not CATEGORY.fullmatch(category.strip()):
        raise BadObject(f"objects: {category!r} cannot be a category; name the kind of thing in words, for example --category cup.")
    if mass_kg is not None and not 0 < mass_kg <= 5:
        raise BadObject(f"objects: a mass of {mass_kg:g} kg is beyond what the arms lift; give --mass-kg between 0 and 5.")
    source = read(path, colour)
    if repair:
        source = Source(*close(source.vertex, source.face), source.paint)
    _check_closed(source, path, repair)
    source = _upright(source, path, up or ("y" if path.suffix.lower() in (".glb", ".obj") else "z"), height_cm)
    scan = _scan(source, say)
    if mass_kg is None:
        mass_kg = float(np.clip(DENSITY_KG_M3 * sum(hull.volume for hull in scan.hulls), *MASS_KG))
    digest = sha256(path.read_bytes()).hexdigest()
    return Card(name, " ".join(category.lower().split()), round(mass_kg, 4), path.name, digest, licence, __version__), scan


def slug(path: Path) -> str:
    """A name for the object in a file."""
    return re.sub(r"[^A-Za-z0-9]+", "-", path.stem).strip("-")[:64]


def table() -> str:
    """Every object by name, the user's own last: category, split, tier of a look-alike, size (cm), faces, mass (g)."""
    lines = [f"{'name':28} {'category':14} {'split':10} {'tier':7} {'size, cm':>18} {'faces':>6} {'mass, g':>8}"]
    for model in [*objects.OBJECTS.values(), *map(objects.get, scans())]:
        grade = objects.tier(model) if model.split == "lookalike" else "-"
        size = " x ".join(f"{100 * side:.1f}" for side in objects.extent_m(model))
        faces = len(objects.mesh(model).face)
        lines.append(f"{model.name:28} {model.category:14} {model.split:10} {grade:7} {size:>18} {faces:6} {1000 * model.mass_kg:8.0f}")
    return "\n".join(lines)


def _check_closed(source: Source, path: Path, repaired: bool) -> None:
    mend = "close the surface in your 3-D tool (--repair was not enough)" if repaired else "pass --repair, or close the surface in your 3-D tool"
    loose, wrong = flaws(source.face)
    if loose:
        raise BadObject(f"objects: {path} is not watertight: {loose:,} open edges (edges that do not join exactly two triangles); {mend}.")
    if wrong:
        raise BadObject(f"objects: {path} has triangles that face opposite ways along {wrong:,} edges; {mend}.")


def _upright(source: Source, path: Path, up: Literal["y", "z"], height_cm: float | None) -> Source:
    """Turned z up, scaled, and set down on the origin, its triangles facing outwards."""
    turned = source.vertex @ TURN[up].T
    low, high = turned.min(axis=0), turned.max(axis=0)
    scale = 1.0 if height_cm is None else 0.01 * height_cm / max(float((high - low)[2]), 1e-30)
    size = scale * (high - low)
    if not SMALLEST_M <= size.max() <= LARGEST_M:
        mend = "give the real height with --height-cm" if height_cm is None else "check --height-cm and --up"
        raise BadObject(
            f"objects: {path} would be {_length(size.max())} long; an object is {_length(SMALLEST_M)} to {_length(LARGEST_M)}, "
            f"so its units are most likely not metres; {mend}."
        )
    if size.min() < THINNEST_M:
        thin = f"{path} would be only {_length(size.min())} thick, less than {_length(THINNEST_M)}"
        raise BadObject(f"objects: {thin}; give it thickness in your 3-D tool (solidify).")
    middle = np.array([*(low + high)[:2] / 2, low[2]])
    vertex = scale * (turned - middle)
    corner = vertex[source.face]
    volume = float((corner[:, 0] * normals(corner)).sum() / 6)
    if abs(volume) < 1e-4 * float(np.prod(size)) or abs(volume) < 1e-9:
        raise BadObject(f"objects: {path} encloses no volume ({1e6 * abs(volume):.3g} cm3); give it thickness in your 3-D tool (solidify).")
    paint = Paint(scale * (source.paint.point @ TURN[up].T - middle), source.paint.rgb)
    upright = replace(source, vertex=vertex, paint=paint)
    if volume > 0:
        return upright
    return replace(upright, face=source.face[:, ::-1].copy(), uv=None if source.uv is None else source.uv[:, ::-1].copy())


def _length(metres: float) -> str:
    """A length as a person would say it."""
    return f"{metres / 1000:.3g} km" if metres >= 1000 else f"{metres:.3g} m" if metres >= 1 else f"{100 * metres:.3g} cm"


def _scan(source: Source, say: Callable[[str], None]) -> Scan:
    vertex, face = source.vertex, source.face
    if len(face) > VISUAL_FACES:
        say(f"reducing {len(face):,} faces to {VISUAL_FACES:,} ...")
        vertex, face = decimate(vertex, face, VISUAL_FACES)
        vertex = np.clip(vertex, source.vertex.min(axis=0), source.vertex.max(axis=0))
    if len(face) == len(source.face) and source.uv is not None and source.picture is not None:
        form, image = shaded(vertex, face, source.uv), shrink(source.picture, TEXTURE_PX)
    else:
        say("painting a texture ...")
        form, image = bake(vertex, face, source.paint, TEXTURE_PX)
    say("splitting into convex parts, about 15 s ...")
    return Scan(form, _hulls(vertex, face), image)


def _hulls(vertex: Vertices, face: Faces) -> tuple[Hull, ...]:
    """Convex parts that cover the body; they stay inside its bounding box, so that it stands where its mesh stands."""
    import coacd

    coacd.set_log_level("off")
    parts = coacd.run_coacd(
        coacd.Mesh(vertex, face), threshold=0.1, preprocess_resolution=30, mcts_iterations=60, max_convex_hull=HULLS, decimate=True,
        max_ch_vertex=HULL_CORNERS, seed=0,
    )  # fmt: skip
    hulls = []
    for corners, _ in parts:
        inside = np.clip(corners, vertex.min(axis=0), vertex.max(axis=0))
        with suppress(QhullError):  # a part as flat as paper
            convex = ConvexHull(inside)
            if convex.volume > SLIVER_M3:
                hulls.append(Hull(inside[convex.vertices], float(convex.volume)))
    if not hulls:
        raise BadObject("objects: no convex part of this object has a volume; give it thickness in your 3-D tool (solidify).")
    return tuple(hulls)
