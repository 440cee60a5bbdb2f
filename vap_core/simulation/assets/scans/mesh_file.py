"""What a GLB, OBJ, PLY or STL file holds: one welded surface, and the colours on it."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int
from PIL import ImageColor

from vap_core.base.errors import BadObject
from vap_core.base.types import Rgb, value
from vap_core.simulation.assets.scans.bake import ColouredPoints, CornerPoints
from vap_core.simulation.assets.scans.mesh_parts import check_file, load_parts
from vap_core.simulation.assets.triangles import Faces, Vertices, area_vectors

if TYPE_CHECKING:
    import trimesh

SMALLEST_AREA = 1e-24
"""A surface of less, in square units of its file, is a point to the arithmetic."""
SAMPLES = 600_000
"""Coloured points that are taken from a surface."""
ColourLookup = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Colours (n, 3) in 0..255 of points on one part of a file.

A point is given by its triangle's number (n) and its barycentric coordinates there (n, 3).
"""


@value
class ScannedSurface:
    """A file's triangles welded into one surface, in the file's own units and axes.

    `samples` are its colours. `uv` and `picture` are set when the file has exactly one texture:
    they can be kept as they are.
    """

    vertex: Vertices
    face: Faces
    samples: ColouredPoints
    uv: CornerPoints | None = None
    picture: Rgb | None = None


def read_mesh_file(path: Path, colour: str | None = None) -> ScannedSurface:
    """The surface in a file, with one `colour` (CSS, "#aa3322") all over it if given.

    Raises:
        BadObject: the file is missing, damaged, too large or colourless.
    """
    check_file(path)
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
    parts = load_parts(path)
    corner = np.concatenate([np.asarray(part.triangles, np.float64) for part in parts])
    if not np.isfinite(corner).all():
        raise BadObject(f"objects: {path} has vertices that are not numbers; export it again.")
    area = float(np.linalg.norm(area_vectors(corner), axis=1).sum())
    if not SMALLEST_AREA < area < np.inf:
        raise BadObject(
            f"objects: {path} has triangles of {area / 2:.3g} square units in all, so it is no "
            "surface; export it again, in metres."
        )
    vertex, face, alive = _weld(corner)
    if not len(face):
        raise BadObject(f"objects: {path} has only triangles that vanish; export it again.")
    samples = _sample_colours(corner, parts, _colour_lookups(path, parts, colour))
    visual: Any = parts[0].visual
    picture = _texture_picture(visual)
    if len(parts) > 1 or colour is not None or picture is None:
        return ScannedSurface(vertex, face, samples)
    uv = (np.asarray(visual.uv, np.float64) * (1, -1) + (0, 1))[parts[0].faces][alive]
    return ScannedSurface(vertex, face, samples, uv=uv, picture=picture)


def _weld(
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
    """The texture of a part with texture coordinates, tinted as its material says.

    A texture of 2 x 2 pixels only stands in for a missing file and does not count.
    """
    material = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None or getattr(visual, "uv", None) is None or max(image.size) <= 2:
        return None
    factor = getattr(material, "baseColorFactor", None)
    rgb = image.convert("RGB")
    if factor is not None:
        table = np.outer(np.asarray(factor, np.float64)[:3] / 255, np.arange(256))
        rgb = rgb.point(table.astype(np.uint8).ravel().tolist())
    return np.array(rgb)


def _colour_lookups(
    path: Path, parts: "Sequence[trimesh.Trimesh]", colour: str | None
) -> list[ColourLookup]:
    """A lookup for every part. Raises: BadObject when a part has no colours."""
    lookups = []
    for part in parts:
        if colour is not None:
            lookups.append(_uniform_colour(_parse_colour(colour)))
            continue
        lookup = _colour_lookup(part)
        if lookup is None:
            hint = ""
            if path.suffix.lower() == ".obj":
                hint = " (an OBJ needs its .mtl and picture beside it)"
            raise BadObject(
                f"objects: {path} has no texture, UV map or vertex colours; bake a texture in your "
                f"3-D tool{hint}, or pass --colour '#aa3322'."
            )
        lookups.append(lookup)
    return lookups


def _parse_colour(colour: str) -> np.ndarray:
    try:
        return np.array(ImageColor.getrgb(colour)[:3])
    except ValueError:
        raise BadObject(
            f"objects: {colour!r} is no colour; write it as --colour '#aa3322'."
        ) from None


def _colour_lookup(part: "trimesh.Trimesh") -> ColourLookup | None:
    """How to colour a point of a part: by its texture, its vertices, or its material."""
    visual: Any = part.visual
    face = np.asarray(part.faces)
    picture = _texture_picture(visual)
    if picture is not None:
        return _textured(picture, np.asarray(visual.uv)[face])
    if visual.kind in ("vertex", "face") and visual.defined:
        return _vertex_coloured(np.asarray(visual.vertex_colors, np.float64)[:, :3][face])
    material_colour = getattr(getattr(visual, "material", None), "baseColorFactor", None)
    if material_colour is None:
        return None
    return _uniform_colour(np.asarray(material_colour)[:3])


def _uniform_colour(rgb: np.ndarray) -> ColourLookup:
    def look_up(triangle: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
        return np.broadcast_to(rgb, (len(triangle), 3))

    return look_up


def _vertex_coloured(corner_rgb: Float[np.ndarray, "f 3 3"]) -> ColourLookup:
    def look_up(triangle: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkc->nc", barycentric, corner_rgb[triangle])

    return look_up


def _textured(picture: Rgb, corner_uv: Float[np.ndarray, "f 3 2"]) -> ColourLookup:
    rows, cols, _ = picture.shape

    def look_up(triangle: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
        u, v = np.einsum("nk,nkc->cn", barycentric, corner_uv[triangle])
        row = np.floor((1 - v) % 1 * rows).astype(int) % rows
        col = np.floor(u % 1 * cols).astype(int) % cols
        return picture[row, col]

    return look_up


def _sample_colours(
    corner: Float[np.ndarray, "f 3 3"],
    parts: "Sequence[trimesh.Trimesh]",
    lookups: Sequence[ColourLookup],
) -> ColouredPoints:
    """Points all over the surface, equally dense everywhere, and their colours."""
    area = np.linalg.norm(area_vectors(corner), axis=1)
    rng = np.random.default_rng(7)
    triangle = np.sort(rng.choice(len(corner), SAMPLES, p=area / area.sum()))
    cut = np.sort(rng.random((SAMPLES, 2)), axis=1)
    barycentric = np.stack([cut[:, 0], cut[:, 1] - cut[:, 0], 1 - cut[:, 1]], axis=1)
    rgb, first = [], 0
    for part, lookup in zip(parts, lookups, strict=True):
        stop = first + len(part.faces)
        start_row, stop_row = np.searchsorted(triangle, [first, stop])
        rows = slice(start_row, stop_row)
        rgb.append(lookup(triangle[rows] - first, barycentric[rows]))
        first = stop
    return ColouredPoints(
        point=np.einsum("nk,nkc->nc", barycentric, corner[triangle]),
        rgb=np.clip(np.concatenate(rgb), 0, 255).astype(np.uint8),
    )
