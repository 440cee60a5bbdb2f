"""What a GLB, OBJ, PLY or STL file holds: one welded surface, and the colours on it."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int
from PIL import ImageColor

from vap_core.errors import BadObject
from vap_core.sim.scans.bake import Corners, Paint
from vap_core.sim.scans.triangles import Faces, Vertices, normals
from vap_core.values import Rgb, value

if TYPE_CHECKING:
    import trimesh

SUFFIXES = (".glb", ".obj", ".ply", ".stl")
MAX_MB, MAX_FACES = 200, 500_000
PAINT_POINTS = 600_000


@value
class Source:
    """A file's triangles welded into one surface, in the file's own units and axes, and what is painted on them.

    `uv` and `picture` are there when the file has exactly one texture: they can be kept as they are.
    """

    vertex: Vertices
    face: Faces
    paint: Paint
    uv: Corners | None = None
    picture: Rgb | None = None


def read(path: Path, colour: str | None = None) -> Source:
    """The surface in a file, one `colour` (CSS, "#aa3322") all over it if given."""
    import trimesh

    if path.suffix.lower() not in SUFFIXES:
        raise BadObject(f"objects: {path} is no GLB, OBJ, PLY or STL file; export it as one of them.")
    if not path.is_file() or not path.stat().st_size:
        raise BadObject(f"objects: {path} is {'empty' if path.exists() else 'not there'}; check the path, or export it again.")
    if path.stat().st_size > MAX_MB * 1e6:
        raise BadObject(f"objects: {path} has {path.stat().st_size / 1e6:.0f} MB, over {MAX_MB}; decimate it or shrink its texture.")
    try:
        parts = [part for part in trimesh.load_scene(path).dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    except Exception as error:  # a damaged file makes the readers raise anything
        raise BadObject(f"objects: {path} cannot be read ({type(error).__name__}: {error}); export it again, without compression.") from error
    count = sum(len(part.faces) for part in parts)
    if not count:
        raise BadObject(f"objects: {path} holds no triangles; export the object as a mesh.")
    if count > MAX_FACES:
        raise BadObject(f"objects: {path} has {count:,} faces, over {MAX_FACES:,}; decimate it first, a hundred thousand are plenty.")
    corner = np.concatenate([np.asarray(part.triangles, np.float64) for part in parts])
    if not np.isfinite(corner).all():
        raise BadObject(f"objects: {path} has vertices that are not numbers; export it again.")
    vertex, face, alive = _weld(corner)
    looks = [_look(part, colour) for part in parts]
    if None in looks:
        beside = " (an OBJ needs its .mtl and picture beside it)" if path.suffix.lower() == ".obj" else ""
        raise BadObject(
            f"objects: {path} has no texture, UV map or vertex colours; bake a texture in your 3-D tool{beside}, or pass --colour '#aa3322'."
        )
    area = np.linalg.norm(normals(corner), axis=1)
    paint = _paint(corner, area, [look for look in looks if look is not None], [len(part.faces) for part in parts])
    visual: Any = parts[0].visual
    if len(parts) == 1 and colour is None and (picture := _picture(visual)) is not None:
        return Source(vertex, face, paint, (np.asarray(visual.uv, np.float64) * (1, -1) + (0, 1))[parts[0].faces][alive], picture)
    return Source(vertex, face, paint)


def _weld(corner: Float[np.ndarray, "f 3 3"]) -> tuple[Vertices, Int[np.ndarray, "k 3"], Bool[np.ndarray, " f"]]:
    """Shared vertices where corners meet within a millionth of the whole, without triangles that vanish; and which those are not."""
    point = corner.reshape(-1, 3)
    grain = max(float(np.ptp(point, axis=0).max()), 1e-30) * 1e-6
    _, first, packed = np.unique(np.round((point - point.min(axis=0)) / grain).astype(np.int64), axis=0, return_index=True, return_inverse=True)
    face = packed.reshape(-1, 3)
    alive = (face != np.roll(face, 1, axis=1)).all(axis=1)
    return point[first], face[alive], alive


Look = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Colours (n, 3) in 0..255 of points, each given by its triangle (n) and barycentric coordinates (n, 3)."""


def _picture(visual: Any) -> Rgb | None:
    """The texture of a part with texture coordinates, tinted as its material says; a 2 x 2 one only stands in for a missing file."""
    material = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None or getattr(visual, "uv", None) is None or max(image.size) <= 2:
        return None
    factor = getattr(material, "baseColorFactor", None)
    tint = np.ones(3) if factor is None else np.asarray(factor, np.float64)[:3] / 255
    return np.asarray(np.asarray(image.convert("RGB")) * tint, np.uint8)


def _look(part: "trimesh.Trimesh", colour: str | None) -> Look | None:
    """How to colour a point of a part: by `colour`, its texture, its vertices, or its material; None when it has nothing."""
    visual: Any = part.visual
    face = np.asarray(part.faces)
    if colour is not None:
        try:
            plain = np.array(ImageColor.getrgb(colour)[:3])
        except ValueError:
            raise BadObject(f"objects: {colour!r} is no colour; write it as --colour '#aa3322'.") from None
        return lambda own, share: np.broadcast_to(plain, (len(own), 3))
    if (picture := _picture(visual)) is not None:
        uv, (rows, cols, _) = np.asarray(visual.uv), picture.shape

        def textured(own: np.ndarray, share: np.ndarray) -> np.ndarray:
            u, v = np.einsum("nk,nkc->cn", share, uv[face[own]])
            return picture[np.floor((1 - v) % 1 * rows).astype(int) % rows, np.floor(u % 1 * cols).astype(int) % cols]

        return textured
    if visual.kind in ("vertex", "face") and visual.defined:
        painted = np.asarray(visual.vertex_colors, np.float64)[:, :3]
        return lambda own, share: np.einsum("nk,nkc->nc", share, painted[face[own]])
    flat = getattr(getattr(visual, "material", None), "baseColorFactor", None)
    if flat is None:
        return None
    return lambda own, share: np.broadcast_to(np.asarray(flat)[:3], (len(own), 3))


def _paint(corner: np.ndarray, area: np.ndarray, looks: list[Look], counts: list[int]) -> Paint:
    """Points all over the surface, as dense everywhere, and their colours."""
    rng = np.random.default_rng(7)
    own = np.sort(rng.choice(len(corner), PAINT_POINTS, p=area / area.sum()))
    share = np.sort(rng.random((PAINT_POINTS, 2)), axis=1)
    share = np.stack([share[:, 0], share[:, 1] - share[:, 0], 1 - share[:, 1]], axis=1)
    starts = np.cumsum([0, *counts])
    cuts = np.searchsorted(own, starts)
    spans = zip(looks, starts, cuts[:-1], cuts[1:], strict=False)
    rgb = np.concatenate([look(own[a:b] - start, share[a:b]) for look, start, a, b in spans])
    return Paint(np.einsum("nk,nkc->nc", share, corner[own]), np.clip(rgb, 0, 255).astype(np.uint8))
