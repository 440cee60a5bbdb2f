"""What a GLB, OBJ, PLY or STL file holds: one welded surface, closed if asked, and its colours.

A surface without a usable texture gets a new one: it is unfolded into flat charts, these are
packed, and every texel gets the colour of the nearest coloured point.
"""

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import ImageColor
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from vap_core.base.errors import BadObject, BadPhoto
from vap_core.base.media import BEHIND, HEAD_BYTES, decode_picture
from vap_core.base.types import Rgb, value
from vap_core.simulation.assets.scans.gltf import (
    CLAMPED,
    as_bitmap,
    multiply,
    outside,
    plain_glb,
    shares,
)
from vap_core.simulation.assets.shapes import Faces, Mesh, Vertices, area_vectors

if TYPE_CHECKING:
    import trimesh

SUFFIXES = (".glb", ".obj", ".ply", ".stl")
MAX_MB, MAX_FACES = 200, 500_000
SMALLEST_AREA = 1e-24
"""A surface of less, in square units of its file, is a point to the arithmetic."""
SAMPLES = 600_000
"""Coloured points that are taken from a surface."""
SMALLEST_PIECE = 0.02
"""Repair drops a separate piece with less than this share of the area."""
GUTTER_PX = 3
CREASE_COSINE = float(np.cos(np.radians(40)))
"""Neighbouring triangles that meet at a flatter angle than this are shaded as one surface."""
CornerPoints = Float[np.ndarray, "f 3 2"]
"""A point of the plane for every corner of every triangle."""


@value
class ScannedSurface:
    """A file's triangles welded into one surface, in the file's own units and axes.

    `point` and `rgb` are its colours at points all over it. `uv` and `picture` are set when the
    file has exactly one texture: they can be kept as they are.
    """

    vertex: Vertices
    face: Faces
    point: Float[np.ndarray, "p 3"]
    rgb: UInt8[np.ndarray, "p 3"]
    uv: CornerPoints | None = None
    picture: Rgb | None = None


def read_mesh_file(path: Path, colour: str | None = None) -> ScannedSurface:
    """The surface in a file, with one `colour` (CSS, "#aa3322") all over it if given.

    Raises:
        BadObject: the file is missing, damaged, too large or colourless.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise BadObject(
            f"objects: {path} is no GLB, OBJ, PLY or STL file; export it as one of them."
        )
    if not path.is_file() or not path.stat().st_size:
        flaw = "not there"
        if path.exists():
            flaw = "empty" if path.is_file() else "no regular file"
        raise BadObject(f"objects: {path} is {flaw}; check the path, or export it again.")
    if path.stat().st_size > MAX_MB * 1e6:
        raise BadObject(
            f"objects: {path} has {path.stat().st_size / 1e6:.0f} MB, over {MAX_MB}; decimate it "
            "or shrink its texture."
        )
    try:
        return _read_surface(path, colour)
    except BadObject:
        raise
    except Exception as error:  # a damaged file makes the readers raise anything
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise BadObject(
            f"objects: {path} cannot be read ({reason:.120}); export it again, without compression."
        ) from error


def _read_surface(path: Path, colour: str | None) -> ScannedSurface:
    parts = _load_parts(path, colour)
    corner = np.concatenate([np.asarray(part.triangles, np.float64) for part in parts])
    if not np.isfinite(corner).all():
        raise BadObject(f"objects: {path} has vertices that are not numbers; export it again.")
    area = float(np.linalg.norm(area_vectors(corner), axis=1).sum())
    if not SMALLEST_AREA < area < np.inf:
        raise BadObject(
            f"objects: {path} has triangles of {area / 2:.3g} square units in all, so it is no "
            "surface; export it again, in metres."
        )
    vertex, face, alive = weld(corner)
    if not len(face):
        raise BadObject(f"objects: {path} has only triangles that vanish; export it again.")
    point, rgb = _sample_colours(path, corner, parts, colour)
    visual: Any = parts[0].visual
    picture = _texture_picture(visual)
    one = len(parts) == 1 and "color" not in getattr(visual, "vertex_attributes", {})
    if not one or colour is not None or picture is None:
        return ScannedSurface(vertex, face, point, rgb)
    uv = (np.asarray(visual.uv, np.float64) * (1, -1) + (0, 1))[parts[0].faces][alive]
    return ScannedSurface(vertex, face, point, rgb, uv, picture)


def _load_parts(path: Path, colour: str | None) -> "list[trimesh.Trimesh]":
    """The file's meshes that have triangles, in one frame.

    Raises: BadObject: there is none, there are too many, they are inconsistent, or a file that they
        refer to is not there, and no `colour` stands in.
    """
    import trimesh

    kind = path.suffix.lower().removeprefix(".")
    missing: list[str] = []
    refused: list[str] = []
    resolver = _beside(path, missing, refused)
    try:
        source = BytesIO(plain_glb(path, resolver.raw)) if kind == "glb" else path
        with _silent():
            scene = trimesh.load_scene(source, file_type=kind, resolver=resolver)
    except FileNotFoundError:
        if not missing:
            raise
        colour = None  # the numbers themselves are missing
    if refused:
        raise BadObject(f"objects: {path}: {refused[0]}.")
    if missing and colour is None:
        raise BadObject(
            f"objects: {path} refers to {missing[0]!r}, and there is no such file beside it; put "
            "it there, or pass --colour '#aa3322'."
        )
    meshes = {
        name: mesh
        for name, mesh in scene.geometry.items()
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)
    }
    for mesh in meshes.values():
        face, points = np.asarray(mesh.faces), len(mesh.vertices)
        uv = getattr(mesh.visual, "uv", None)
        if resolver.clamped and uv is not None and outside(uv).any():
            raise BadObject(f"objects: {path} {CLAMPED}.")
        _check_ply_colours(path, mesh)
        if face.ndim != 2 or face.shape[1] != 3 or face.min() < 0 or face.max() >= points:
            raise BadObject(
                f"objects: {path} has faces that name vertices that are not there; export it again."
            )
        if uv is not None and (np.shape(uv) != (points, 2) or not np.isfinite(uv).all()):
            raise BadObject(
                f"objects: {path} has texture coordinates that do not fit its vertices; unwrap the "
                "mesh and export it again."
            )
    placed = [scene.graph[node][1] for node in scene.graph.nodes_geometry]  # some many times
    count = sum(len(meshes[name].faces) for name in placed if name in meshes)
    if not count:
        raise BadObject(f"objects: {path} holds no triangles; export the object as a mesh.")
    if count > MAX_FACES:
        raise BadObject(
            f"objects: {path} has {count:,} faces, over {MAX_FACES:,}; decimate it first, a "
            "hundred thousand are plenty."
        )
    parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    for part in parts:
        loaded: Any = scene.geometry[part.metadata["name"]].visual
        copied: Any = part.visual
        if "color" in getattr(loaded, "vertex_attributes", {}):  # a copy forgets it
            copied.vertex_attributes["color"] = loaded.vertex_attributes["color"]
    if kind == "obj" and colour is None:
        _colour_obj(path, parts)
    return parts


def _colour_obj(path: Path, parts: "list[trimesh.Trimesh]") -> None:
    """Give the vertices of an OBJ their colours, which trimesh drops where it finds a material."""
    lines = path.read_text(errors="replace").splitlines()
    rows = [line.split()[1:7] for line in lines if line.startswith("v ")]
    if not rows or any(len(row) < 6 for row in rows):
        return
    numbers = np.array(rows, np.float64)
    rgb = 255 * shares(numbers[:, 3:], path, "vertex colours")
    tree = cKDTree(numbers[:, :3])
    for part in parts:
        visual: Any = part.visual
        if hasattr(visual, "vertex_attributes"):
            visual.vertex_attributes["color"] = rgb[tree.query(part.vertices)[1]]


def _check_ply_colours(path: Path, mesh: "trimesh.Trimesh") -> None:
    """Raises: BadObject for several textures, of which trimesh takes one, and for colours in floats
    that are no shares, which it cuts off."""
    raw = mesh.metadata.get("_ply_raw", {})
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES).partition(b"end_header")[0]
    if raw and head.count(b"TextureFile") > 1:
        raise BadObject(f"objects: {path} has several textures; bake them into one.")
    for element in ("vertex", "face"):
        cells = raw.get(element, {}).get("data", {})
        names = cells.dtype.names or () if isinstance(cells, np.ndarray) else cells
        for channel in ("red", "green", "blue"):
            if channel in names:
                column = np.asarray(cells[channel])
                if column.dtype.kind == "f":
                    shares(column, path, "colours in floats")


def _beside(path: Path, missing: list[str], refused: list[str]) -> Any:
    """Opens what the mesh refers to: regular files in its folder and below, of MAX_MB at most.

    A picture comes decoded, as a bitmap. What is not there is added to `missing`, what is not read
    here to `refused`.
    """
    from trimesh.resolvers import FilePathResolver

    class Bounded(FilePathResolver):
        clamped = False

        def raw(self, name: str) -> bytes:
            named = name.strip().strip('"').replace("\\", "/")
            whole = [named, unquote(named)]
            for candidate in dict.fromkeys([*whole, *(Path(each).name for each in whole)]):
                with suppress(ValueError):  # outside the folder
                    found = _any_case(Path(self.absolute(candidate)))
                    if found.is_file() and found.stat().st_size <= MAX_MB * 1e6:
                        return found.read_bytes()
            missing.append(named)
            raise FileNotFoundError(named)

        def get(self, name: str) -> bytes:
            if path.suffix.lower() == ".glb":
                return self.raw(name)
            if name.strip().lower().endswith(".mtl"):
                return ONE_LEVEL.sub(rb"\1 \2 \2 \2", self.raw(name))
            self.clamped |= " -clamp on " in f" {name} "
            named = _without_options(name.strip(), refused)
            data = BytesIO(self.raw(named))
            try:
                return as_bitmap(decode_picture(data, f"the texture {named!r}", upright=False))
            except BadPhoto as error:
                refused.append(str(error).removesuffix("."))
                raise

    return Bounded(str(path))


def _any_case(path: Path) -> Path:
    """The file of that name; where there is none, one that differs in case, as on Windows."""
    if not path.is_file() and path.parent.is_dir():
        for other in path.parent.iterdir():
            if other.name.lower() == path.name.lower():
                return other
    return path


ONE_LEVEL = re.compile(rb"^(\s*K[ade])\s+([\d.]+)\s*$", re.IGNORECASE | re.MULTILINE)
"""A line of an .mtl file with one level for red, green and blue, which trimesh does not read."""
MAP_OPTIONS = {"-mm": 2, "-o": 3, "-s": 3, "-t": 3}
"""How many numbers follow an option of a picture in an .mtl file, at most; one word else."""
UNMOVED = {"-s": (1, 1, 1), "-o": (0, 0, 0), "-t": (0, 0, 0), "-mm": (0, 1)}


def _without_options(name: str, refused: list[str]) -> str:
    """The file in a line of an .mtl file such as "-s 1 1 1 -clamp on label.png".

    A texture that is moved, scaled, clamped or brightened is added to `refused`.
    """
    words = name.split()
    while len(words) > 1 and words[0].startswith("-"):
        option = words.pop(0)
        values = [words.pop(0)]
        while len(values) < MAP_OPTIONS.get(option, 1) and len(words) > 1 and _is_number(words[0]):
            values.append(words.pop(0))
        numbers = UNMOVED.get(option, ())
        if [float(value) for value in values if numbers] != list(numbers[: len(values)]):
            refused.append(
                f"a texture is moved, scaled or brightened ({option} {' '.join(values)}), which is "
                "not read here; apply it in your 3-D tool"
            )
        name = " ".join(words)
    return name


def _is_number(word: str) -> bool:
    with suppress(ValueError):
        float(word)
        return True
    return False


@contextmanager
def _silent() -> Iterator[None]:
    """Inside the block trimesh logs nothing: what it misses is said here, in one line."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)


def weld(
    corner: Float[np.ndarray, "f 3 3"],
) -> tuple[Vertices, Int[np.ndarray, "k 3"], Bool[np.ndarray, " f"]]:
    """Vertices, faces, and which of the given triangles they keep.

    Corners within a millionth of the whole become one vertex; triangles that vanish are dropped.
    """
    point = corner.reshape(-1, 3)
    grain = max(float(np.ptp(point, axis=0).max()), 1e-30) * 1e-6
    cell = np.round((point - point.min(axis=0)) / grain).astype(np.int64)
    _, first, packed = np.unique(cell, axis=0, return_index=True, return_inverse=True)
    face = packed.reshape(-1, 3)
    alive = (face != np.roll(face, 1, axis=1)).all(axis=1)
    return point[first], face[alive], alive


def _texture_picture(visual: Any) -> Rgb | None:
    """The texture of a part with texture coordinates, as `plain_glb` or `_beside` decoded it.

    A texture of 2 x 2 pixels only stands in for a missing file and does not count.
    """
    material = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None or getattr(visual, "uv", None) is None or max(image.size) <= 2:
        return None
    return np.array(image.convert("RGB"))


def _diffuse(path: Path, words: dict[str, Any]) -> np.ndarray | None:
    """Kd of an .mtl file and what it gives off, 0 to 255, over grey where it is transparent."""
    kd, glow = words.get("kd"), words.get("ke") or ()
    if kd is None:
        return None
    rgb = np.broadcast_to(shares(kd, path, "Kd"), 3)
    if any(map(_is_number, glow)):
        rgb = np.minimum(rgb + np.array(glow, np.float64), 1)
    opacity = 1.0
    if "d" in words:
        opacity = float(words["d"][-1])
    elif "tr" in words:
        opacity = 1 - float(words["tr"][-1])
    seen = shares(opacity, path, "d or Tr")
    return np.round(255 * seen * rgb + (1 - seen) * BEHIND)


def _sample_colours(
    path: Path,
    corner: Float[np.ndarray, "f 3 3"],
    parts: "list[trimesh.Trimesh]",
    colour: str | None,
) -> tuple[Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """Points all over the surface, equally dense everywhere, and their colours.

    Raises: BadObject when a part has no colours, or `colour` is none.
    """
    import trimesh

    whole = trimesh.Trimesh(corner.reshape(-1, 3), np.arange(corner.size // 3).reshape(-1, 3),
                            process=False)  # fmt: skip
    point, triangle, share = trimesh.sample.sample_surface(
        whole, SAMPLES, return_barycentric=True, seed=7
    )
    rgb = np.zeros((SAMPLES, 3), np.uint8)
    if colour is not None:
        try:
            rgb[:] = ImageColor.getrgb(colour)[:3]
        except ValueError:
            raise BadObject(
                f"objects: {colour!r} is no colour; write it as --colour '#aa3322'."
            ) from None
        return point, rgb
    first = 0
    for part in parts:
        mine = (triangle >= first) & (triangle < first + len(part.faces))
        found = _colours(path, part, triangle[mine] - first, share[mine])
        if found is None:
            hint = ""
            if path.suffix.lower() == ".obj":
                hint = " (an OBJ needs its .mtl and picture beside it)"
            raise BadObject(
                f"objects: {path} has no texture, UV map or vertex colours; bake a texture in your "
                f"3-D tool{hint}, or pass --colour '#aa3322'."
            )
        rgb[mine] = np.clip(found, 0, 255)
        first += len(part.faces)
    return point, rgb


def _colours(
    path: Path,
    part: "trimesh.Trimesh",
    triangle: Int[np.ndarray, " n"],
    share: Float[np.ndarray, "n 3"],
) -> np.ndarray | None:
    """By a part's texture or material, times its vertices', at points with barycentric `share`s."""
    visual: Any = part.visual
    corner = np.asarray(part.faces)[triangle]
    material: Any = getattr(visual, "material", None)
    vertices = getattr(visual, "vertex_attributes", {}).get("color")
    if visual.kind in ("vertex", "face") and visual.defined:
        vertices = visual.vertex_colors
    painted = None
    if vertices is not None:
        painted = np.einsum("nk,nkc->nc", share, np.asarray(vertices, np.float64)[:, :3][corner])
    picture = _texture_picture(visual)
    if picture is not None:
        rows, cols, _ = picture.shape
        u, v = np.einsum("nk,nkc->cn", share, np.asarray(visual.uv)[corner])
        row = np.floor((1 - v) % 1 * rows).astype(int) % rows
        texel = picture[row, np.floor(u % 1 * cols).astype(int) % cols]
        return texel if painted is None else multiply(texel, painted)
    flat = getattr(material, "baseColorFactor", None)
    if flat is None:
        flat = _diffuse(path, getattr(material, "kwargs", {}))
    if flat is None:
        return painted
    flat = np.broadcast_to(np.asarray(flat)[:3], (len(triangle), 3))
    return flat if painted is None else multiply(flat, painted)


def count_edge_flaws(face: Faces) -> tuple[int, int]:
    """How many edges do not join exactly two triangles, and how many join two that face apart.

    Two triangles face opposite ways where both run along their edge in the same direction.
    """
    edge = face[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    number, uses = _edges(face)
    paired = edge[(uses == 2)[number]]
    return int((uses != 2).sum()), len(paired) - len(np.unique(paired, axis=0))


def _edges(face: Faces) -> tuple[Int[np.ndarray, " e"], Int[np.ndarray, " u"]]:
    """The number of every triangle's three edges, and how many triangles each joins."""
    edge = np.sort(face[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, number, uses = np.unique(edge @ (1 << 31, 1), return_inverse=True, return_counts=True)
    return number, uses


def close_surface(
    vertex: Vertices, face: Faces
) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, "k 3"]]:
    """The surface as closed as simple means allow; `count_edge_flaws` shows what is left open.

    Drops double triangles, small separate pieces and triangles at edges that join more than two;
    turns triangles to face the same way, and caps holes.
    """
    import trimesh

    mesh = trimesh.Trimesh(vertex, face, process=False)
    mesh.update_faces(mesh.unique_faces())
    piece = trimesh.graph.connected_component_labels(
        mesh.face_adjacency, node_count=len(mesh.faces)
    )
    area = np.bincount(piece, mesh.area_faces)
    mesh.update_faces((area >= SMALLEST_PIECE * area.sum())[piece])
    while True:
        number, uses = _edges(np.asarray(mesh.faces))
        crowded = (uses[number].reshape(-1, 3) > 2).any(axis=1)
        if not crowded.any() or crowded.all():
            break
        mesh.update_faces(~crowded)
    trimesh.repair.fix_winding(mesh)
    kept = np.array(mesh.faces, np.int64)
    number, uses = _edges(kept)
    vertices, faces = [vertex], [kept]
    for loop in _loops(kept[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)[(uses == 1)[number]]):
        centre = np.full(len(loop), len(vertex) + len(vertices) - 1)
        vertices.append(vertex[loop].mean(axis=0, keepdims=True))
        faces.append(np.stack([np.roll(loop, -1), loop, centre], axis=1))
    return np.concatenate(vertices), np.concatenate(faces)


def _loops(boundary: Int[np.ndarray, "e 2"]) -> Iterator[Int[np.ndarray, " k"]]:
    """Closed walks along directed edges that pass no vertex twice."""
    onward: dict[int, list[int]] = {}
    for start, end in boundary.tolist():
        onward.setdefault(start, []).append(end)
    for first in list(onward):
        walk = [first]
        while onward.get(walk[-1]):
            step = onward[walk[-1]].pop()
            if step in walk:
                place = walk.index(step)
                yield np.array(walk[place:])
                del walk[place:]
            walk.append(step)


def creased_mesh(vertex: Vertices, face: Faces, uv: CornerPoints) -> Mesh:
    """A mesh with smooth normals, creased where the surface turns sharply.

    Vertices are shared where normal and texture coordinates agree.
    """
    normal = area_vectors(vertex[face])
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    smooth = np.empty((face.size, 3))
    order = np.argsort(face.ravel(), kind="stable")
    for corners in np.split(order, np.flatnonzero(np.diff(face.ravel()[order])) + 1):
        triangles = corners // 3
        alike = unit[triangles] @ unit[triangles].T > CREASE_COSINE
        smooth[corners] = alike @ normal[triangles]
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-30)
    rows = np.concatenate([vertex[face.ravel()], smooth, uv.reshape(-1, 2)], axis=1)
    _, first, packed = np.unique(np.round(rows, 6), axis=0, return_index=True, return_inverse=True)
    kept = rows[first]
    return Mesh(kept[:, :3], kept[:, 3:6], kept[:, 6:], packed.reshape(-1, 3))


def bake_texture(
    vertex: Vertices, face: Faces, surface: ScannedSurface, side: int
) -> tuple[Mesh, Rgb]:
    """The mesh with texture coordinates of its own, and its texture, `side` x `side`.

    Raises: BadObject when the surface is too rugged.
    """
    chart, flat = _unfold(vertex, face)
    uv_px = pack_charts(chart, flat, side)
    texel, point = _covered_texels(vertex[face], uv_px)
    _, nearest = cKDTree(surface.point).query(point)
    picture = np.zeros((side, side, 3), np.uint8)
    picture[texel[:, 1], texel[:, 0]] = surface.rgb[nearest]
    blank = np.ones((side, side), bool)
    blank[texel[:, 1], texel[:, 0]] = False
    rows, cols = distance_transform_edt(blank, return_distances=False, return_indices=True)
    return creased_mesh(vertex, face, uv_px / side), picture[rows, cols]


def _unfold(vertex: Vertices, face: Faces) -> tuple[Int[np.ndarray, " f"], CornerPoints]:
    """Each triangle's chart, and its corners projected onto the chart's plane, metres.

    A chart is a connected group of triangles that face the same way along an axis.
    """
    import trimesh

    pairs = trimesh.Trimesh(vertex, face, process=False).face_adjacency
    normal = area_vectors(vertex[face])
    for _ in range(3):
        spread = 3 * normal
        np.add.at(spread, pairs, normal[pairs[:, ::-1]])
        normal = spread
    axis = np.abs(normal).argmax(axis=1)
    direction = 2 * axis + (np.take_along_axis(normal, axis[:, None], 1)[:, 0] > 0)
    alike = pairs[direction[pairs[:, 0]] == direction[pairs[:, 1]]]
    chart = trimesh.graph.connected_component_labels(alike, node_count=len(face))
    axes = np.array([[1, 2], [0, 2], [0, 1]])[axis][:, None, :].repeat(3, axis=1)
    return chart.astype(np.int64), np.take_along_axis(vertex[face], axes, 2)


def pack_charts(chart: Int[np.ndarray, " f"], flat: CornerPoints, side: int) -> CornerPoints:
    """Charts side by side on shelves, as large as fits the square, a gutter around each; pixels.

    Raises: BadObject when there are more of them than fit at any size.
    """
    count = int(chart.max()) + 1
    most = (side // (2 * GUTTER_PX + 1)) ** 2
    if count > most:
        raise BadObject(
            f"objects: the surface falls into {count:,} pieces that face apart, and a texture "
            f"holds {most:,}; smooth or remesh it in your 3-D tool."
        )
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, chart, flat.min(axis=1))
    np.maximum.at(high, chart, flat.max(axis=1))
    scale = side / float(np.sqrt(np.prod(high - low, axis=1).sum()))
    while True:
        size = np.ceil((high - low) * scale).astype(int) + 2 * GUTTER_PX
        corner, x, y, tall = np.zeros_like(size), 0, 0, 0
        for i in np.argsort(-size[:, 1], kind="stable"):
            width, height = map(int, size[i])
            if x + width > side:
                x, y, tall = 0, y + tall, 0
            corner[i] = x, y
            x, tall = x + width, max(tall, height)
        if y + tall <= side and size.max() <= side:
            return (flat - low[chart][:, None]) * scale + corner[chart][:, None] + GUTTER_PX
        scale *= 0.96


def _covered_texels(
    corner: Float[np.ndarray, "f 3 3"], uv_px: CornerPoints
) -> tuple[Int[np.ndarray, "t 2"], Float[np.ndarray, "t 3"]]:
    """Every texel (x, y) whose centre lies in a triangle, and the point of the surface there."""
    texels, points = [np.zeros((0, 2), np.int64)], [np.zeros((0, 3))]
    for triangle, flat in zip(corner, uv_px, strict=True):
        across = np.array([flat[1] - flat[0], flat[2] - flat[0]]).T
        if abs(np.linalg.det(across)) < 1e-6:
            continue
        low, high = flat.min(axis=0).astype(int), flat.max(axis=0).astype(int) + 1
        grid = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        texel = np.stack(grid, axis=-1).reshape(-1, 2)
        share = (texel + 0.5 - flat[0]) @ np.linalg.inv(across).T
        inside = (share >= -1e-6).all(axis=1) & (share.sum(axis=1) <= 1 + 1e-6)
        texels.append(texel[inside])
        points.append(triangle[0] + share[inside] @ (triangle[1:] - triangle[0]))
    return np.concatenate(texels), np.concatenate(points)
