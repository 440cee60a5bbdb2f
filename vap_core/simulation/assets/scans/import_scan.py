"""A 3-D file of the user's becomes an object.

The file is read, checked, set upright, reduced, textured, and split into convex parts. The result
stands on z = 0, centred on the z axis, z up, metres; its collision solids are the hulls of a convex
decomposition. As a script this module is that decomposition: CoACD cannot be interrupted, but the
system ends a process that has used its seconds of CPU.
"""

import re
import resource
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
from PIL import Image
from scipy.spatial import ConvexHull, QhullError

from vap_core import __version__
from vap_core.base.errors import BadObject, bounded
from vap_core.memory import NAME, NAME_RULE, kind_instead, plain_category
from vap_core.simulation import robots
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.scans.mesh_file import (
    ScannedSurface,
    bake_texture,
    close_surface,
    count_edge_flaws,
    creased_mesh,
    read_mesh_file,
)
from vap_core.simulation.assets.scans.storage import Scan, ScanMetadata
from vap_core.simulation.assets.shapes import Faces, Hull, Vertices, area_vectors
from vap_core.simulation.types import REST, ROBOT

VISUAL_FACES, TEXTURE_PX = 3000, 1024
MEMORY_BYTES, CPU_LIMIT_S = 6_000_000_000, 300.0
"""What an import may take; the convex decomposition has its own limits."""
HULLS, HULL_CORNERS = 16, 160
SPLIT_CPU_S, SPLIT_WALL_S = 60, 900
"""A surface that does not cross itself takes about ten seconds of CPU; a busy machine gives them
late."""
SLIVER_M3 = 1e-9
"""A convex part of less volume is dropped."""
SOLIDIFY = "give it thickness in your 3-D tool (solidify)"
SCRIPT = Path(__file__)
MOST_VISUAL_FACES = 5 * VISUAL_FACES
"""A surface of which more faces remain than this is refused: it crosses itself all over."""
SMALLEST_M, LARGEST_M, THINNEST_M = 0.01, 0.6, 0.002
DENSITY_KG_M3, MASS_KG = 400.0, (0.03, 0.5)
ROOM_NAMES = ("floor", "wall", "wall_back", "wall_left", "legs", "planks", "table", "lamp")
"""What the parts of a room are called in a scene."""
HEAVIEST_KG = 5
UpAxis = Literal["y", "z"]
OBJECT_FROM_FILE: dict[UpAxis, np.ndarray] = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}
"""Rotation to the object's axes (z up, front towards -y), by the file's axis that points up."""
Y_UP_SUFFIXES = (".glb", ".obj")
FLATTER = 0.3
"""Share of the footprint by which the bottom is flatter along the other axis than along the
format's own where a file stands on that one."""


def import_scan(
    path: Path,
    name: str,
    category: str,
    *,
    height_cm: float | None = None,
    up: UpAxis | None = None,
    mass_kg: float | None = None,
    colour: str | None = None,
    repair: bool = False,
    licence: str = "",
    report: Callable[[str], None] = print,
) -> tuple[ScanMetadata, Scan]:
    """Make a registry object of a GLB, OBJ, PLY or STL file; the decomposition takes some seconds.

    Without `height_cm` the file's units are metres; without `up` it is y for GLB and OBJ and z for
    PLY and STL, unless the object stands flat on the other one; without `mass_kg` the mass follows
    from the hulls' volume. `report` is called with a line for every slow step.

    Raises:
        BadObject: the names or the file will not do; the message says what is wrong and how to
            repair it.
    """
    _check_arguments(name, category, mass_kg)
    try:
        with bounded(MEMORY_BYTES, CPU_LIMIT_S):
            surface = read_mesh_file(path, colour)
            if repair:
                vertex, face = close_surface(surface.vertex, surface.face)
                surface = ScannedSurface(vertex, face, surface.point, surface.rgb)
            _check_closed(surface, path, repair)
            if up is None:
                up = guess_up(surface, path)
                report(f"the file's {up} axis points up; --up says otherwise")
            surface = _set_upright(surface, path, up, height_cm)
            scan = _build_scan(surface, report)
    except (MemoryError, TimeoutError) as error:
        raise BadObject(
            f"objects: {path} takes over {MEMORY_BYTES / 1e9:.0f} GB or {CPU_LIMIT_S:g} s of CPU; "
            "decimate the mesh and shrink its texture."
        ) from error
    if mass_kg is None:
        volume_m3 = sum(hull.volume for hull in scan.hulls)
        mass_kg = float(np.clip(DENSITY_KG_M3 * volume_m3, *MASS_KG))
    metadata = ScanMetadata(
        name=name,
        category=plain_category(category),
        mass_kg=round(mass_kg, 4),
        source=path.name,
        source_sha256=sha256(path.read_bytes()).hexdigest(),
        licence=licence,
        vap=__version__,
    )
    return metadata, scan


def default_name(path: Path) -> str:
    """A name for the object in a file."""
    return re.sub(r"[^A-Za-z0-9]+", "-", path.stem).strip("-")[:64] or "my-object"


def guess_up(surface: ScannedSurface, path: Path) -> UpAxis:
    """The axis that points up: the format's, unless the body is flatter below along the other."""
    usual: UpAxis = "y" if path.suffix.lower() in Y_UP_SUFFIXES else "z"
    other: UpAxis = "z" if usual == "y" else "y"
    if _flat_below(surface, other) - _flat_below(surface, usual) > FLATTER:
        return other
    return usual


def _flat_below(surface: ScannedSurface, up: UpAxis) -> float:
    """The area that the body would stand on, as a share of its bounding box's."""
    corner = (surface.vertex @ OBJECT_FROM_FILE[up].T)[surface.face]
    low, high = corner.min(axis=(0, 1)), corner.max(axis=(0, 1))
    lowest = corner[:, :, 2].max(axis=1) < low[2] + 0.02 * (high[2] - low[2])
    area = np.abs(area_vectors(corner[lowest])[:, 2]).sum() / 2
    return float(area / max(np.prod((high - low)[:2]), 1e-30))


def _check_arguments(name: str, category: str, mass_kg: float | None) -> None:
    kind, flaw = kind_instead(category), ""
    if not NAME.fullmatch(name):
        flaw = f"{name!r} cannot name an object; use {NAME_RULE}, for example --name my-mug"
    elif name in objects.OBJECTS or "-generic-" in name:
        flaw = f"{name!r} is one of the workspace's own objects; choose another --name"
    elif name in _scene_names():
        flaw = (
            f"{name!r} is what a part of the room or of a robot is called; choose another --name, "
            f"for example my-{name}"
        )
    elif name.endswith(objects.RED):
        flaw = (
            f"a name that ends in {objects.RED} is of an object that was made red; choose another "
            "--name"
        )
    elif kind:
        flaw = (
            f"{category!r} cannot be a category; name the kind of thing alone, in words, for "
            f"example --category {shlex.quote(kind)}"
        )
    elif mass_kg is not None and not 0 < mass_kg <= HEAVIEST_KG:
        flaw = (
            f"a mass of {mass_kg:g} kg is beyond what the arms lift; give --mass-kg between 0 and "
            f"{HEAVIEST_KG}"
        )
    if flaw:
        raise BadObject(f"objects: {flaw}.")


@cache
def _scene_names() -> frozenset[str]:
    """What the room and the robots are made of, and what contacts call them."""
    import mujoco

    names = {*ROOM_NAMES, ROBOT, REST}
    for robot in robots.ROBOTS.values():
        spec = mujoco.MjSpec.from_file(str(robot.xml))
        for part in (*spec.bodies, *spec.materials, *spec.meshes, *spec.textures):
            names.add(part.name)
    return frozenset(names)


def _check_closed(surface: ScannedSurface, path: Path, repaired: bool) -> None:
    remedy = "pass --repair, or close the surface in your 3-D tool"
    if repaired:
        remedy = "close the surface in your 3-D tool (--repair was not enough)"
    open_edges, facing_apart = count_edge_flaws(surface.face)
    if open_edges:
        raise BadObject(
            f"objects: {path} is not watertight: {open_edges:,} open edges (edges that do not join "
            f"exactly two triangles); {remedy}."
        )
    if facing_apart:
        raise BadObject(
            f"objects: {path} has triangles that face opposite ways along {facing_apart:,} edges; "
            f"{remedy}."
        )


def _set_upright(
    surface: ScannedSurface, path: Path, up: UpAxis, height_cm: float | None
) -> ScannedSurface:
    """Turned z up, scaled, and set down on the origin, its triangles facing outwards."""
    rotation = OBJECT_FROM_FILE[up]
    turned = surface.vertex @ rotation.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    scale = 0.01 * height_cm / max(float((high - low)[2]), 1e-30) if height_cm is not None else 1.0
    size = scale * (high - low)
    _check_size(size, path, height_cm)
    base = np.array([*(low + high)[:2] / 2, low[2]])
    vertex = scale * (turned - base)
    corner = vertex[surface.face]
    volume_m3 = float((corner[:, 0] * area_vectors(corner)).sum() / 6)  # < 0: it faces inwards
    if abs(volume_m3) < 1e-4 * float(np.prod(size)) or abs(volume_m3) < 1e-9:
        raise BadObject(
            f"objects: {path} encloses no volume ({1e6 * abs(volume_m3):.3g} cm3); {SOLIDIFY}."
        )
    point = scale * (surface.point @ rotation.T - base)
    upright = replace(surface, vertex=vertex, point=point)
    if volume_m3 > 0:
        return upright
    uv = None if surface.uv is None else surface.uv[:, ::-1].copy()
    return replace(upright, face=surface.face[:, ::-1].copy(), uv=uv)


def _check_size(size: np.ndarray, path: Path, height_cm: float | None) -> None:
    if not SMALLEST_M <= size.max() <= LARGEST_M:
        remedy = "check --height-cm and --up"
        if height_cm is None:
            remedy = "give the real height with --height-cm"
        raise BadObject(
            f"objects: {path} would be {_format_length(size.max())} long; an object is "
            f"{_format_length(SMALLEST_M)} to {_format_length(LARGEST_M)}, so its units are most "
            f"likely not metres; {remedy}."
        )
    if size.min() < THINNEST_M:
        raise BadObject(
            f"objects: {path} would be only {_format_length(size.min())} thick, less than "
            f"{_format_length(THINNEST_M)}; {SOLIDIFY}."
        )


def _format_length(metres: float) -> str:
    if metres >= 1000:
        return f"{metres / 1000:.3g} km"
    if metres >= 1:
        return f"{metres:.3g} m"
    return f"{100 * metres:.3g} cm"


def _build_scan(surface: ScannedSurface, report: Callable[[str], None]) -> Scan:
    """The surface reduced, textured, and split into convex parts."""
    from fast_simplification import simplify

    vertex, face = surface.vertex, surface.face
    if len(face) > VISUAL_FACES:
        report(f"reducing {len(face):,} faces to {VISUAL_FACES:,} ...")
        fewer, face = simplify(vertex, face.astype(np.int32), target_count=VISUAL_FACES, agg=3.0)
        face = np.asarray(face, np.int64)
        if len(face) > MOST_VISUAL_FACES:
            raise BadObject(
                f"objects: the surface cannot be reduced to {VISUAL_FACES:,} faces, {len(face):,} "
                "remain; smooth or remesh it in your 3-D tool."
            )
        vertex = np.clip(np.asarray(fewer, np.float64), vertex.min(axis=0), vertex.max(axis=0))
    unchanged = len(face) == len(surface.face)
    if unchanged and surface.uv is not None and surface.picture is not None:
        form = creased_mesh(vertex, face, surface.uv)
        picture = Image.fromarray(surface.picture)
        picture.thumbnail((TEXTURE_PX, TEXTURE_PX))
        image = np.array(picture)
    else:
        report("painting a texture ...")
        form, image = bake_texture(vertex, face, surface, TEXTURE_PX)
    report("splitting into convex parts, some seconds ...")
    return Scan(form=form, hulls=convex_parts(vertex, face), image=image)


def convex_parts(vertex: Vertices, face: Faces) -> tuple[Hull, ...]:
    """Convex parts that cover the body.

    They stay inside its bounding box, so that it stands where its mesh stands.

    Raises: BadObject: no part has a volume, or the time limit passed.
    """
    hulls = []
    for corners in _split(vertex, face):
        inside = np.clip(corners, vertex.min(axis=0), vertex.max(axis=0))
        with suppress(QhullError):  # a part as flat as paper
            convex = ConvexHull(inside)
            if convex.volume > SLIVER_M3:
                hulls.append(Hull(inside[convex.vertices], float(convex.volume)))
    if not hulls:
        raise BadObject(f"objects: no convex part of this object has a volume; {SOLIDIFY}.")
    return tuple(hulls)


def _split(vertex: Vertices, face: Faces) -> list[np.ndarray]:
    """The corners of every part, found in a process of its own. Raises: BadObject."""
    with TemporaryDirectory(prefix="vap-convex-") as folder:
        source, target = Path(folder, "surface.npz"), Path(folder, "parts.npz")
        np.savez(source, vertex=vertex, face=face)
        words = [sys.executable, "-I", SCRIPT, source, target, SPLIT_CPU_S]
        try:
            status = subprocess.run(
                [*map(str, words)], capture_output=True, timeout=SPLIT_WALL_S
            ).returncode
        except subprocess.TimeoutExpired:
            status = -signal.SIGKILL
        if status in (-signal.SIGXCPU, -signal.SIGKILL):
            raise BadObject(
                f"objects: splitting the surface into convex parts took over {SPLIT_CPU_S} s, so "
                "it most likely crosses itself; remesh or smooth it in your 3-D tool."
            )
        if status or not target.exists():
            raise BadObject(
                f"objects: the surface cannot be split into convex parts (status {status}); "
                "remesh it in your 3-D tool."
            )
        with np.load(target) as parts:
            return [parts[name] for name in parts.files]


def _decompose(source: str, target: str, seconds: str) -> None:
    """CoACD's convex parts of the surface in one .npz file, into another."""
    resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds)))
    import coacd

    surface = np.load(source)
    coacd.set_log_level("off")
    parts = coacd.run_coacd(
        coacd.Mesh(surface["vertex"], surface["face"]),
        threshold=0.1,
        preprocess_resolution=30,
        mcts_iterations=60,
        max_convex_hull=HULLS,
        decimate=True,
        max_ch_vertex=HULL_CORNERS,
        seed=0,
    )
    np.savez(target, *(vertex for vertex, _ in parts))


if __name__ == "__main__":
    _decompose(*sys.argv[1:])
