"""A new texture for a mesh without a usable one: unfold it into flat charts, pack them, and colour every texel by the nearest painted point."""

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from vap_core.sim.scans.triangles import Faces, Vertices, normals
from vap_core.sim.shapes import Mesh
from vap_core.values import Rgb, value

GUTTER_PX = 3
CREASE = float(np.cos(np.radians(40)))
"""Neighbouring triangles that meet at a flatter angle than this are shaded as one smooth surface."""
Corners = Float[np.ndarray, "f 3 2"]
"""A point of the plane for every corner of every triangle."""


@value
class Paint:
    """Points on a surface (metres) and the colours seen there."""

    point: Float[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]


def bake(vertex: Vertices, face: Faces, paint: Paint, side: int) -> tuple[Mesh, Rgb]:
    """The mesh with texture coordinates of its own, and its texture, `side` x `side`."""
    chart, flat = _charts(vertex, face)
    uv_px = _pack(chart, flat, side)
    texel, point = _texels(vertex[face], uv_px)
    _, nearest = cKDTree(paint.point).query(point)
    picture, blank = np.zeros((side, side, 3), np.uint8), np.ones((side, side), bool)
    picture[texel[:, 1], texel[:, 0]] = paint.rgb[nearest]
    blank[texel[:, 1], texel[:, 0]] = False
    rows, cols = distance_transform_edt(blank, return_distances=False, return_indices=True)
    return shaded(vertex, face, uv_px / side), picture[rows, cols]


def shrink(picture: Rgb, side: int) -> Rgb:
    """The picture with its longer side at most `side` pixels."""
    image = Image.fromarray(picture)
    image.thumbnail((side, side))
    return np.array(image)


def shaded(vertex: Vertices, face: Faces, uv: Corners) -> Mesh:
    """A mesh with smooth normals, creased where the surface turns sharply; vertices are shared where normal and texture agree."""
    normal = normals(vertex[face])
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    smooth = np.empty((face.size, 3))
    order = np.argsort(face.ravel(), kind="stable")
    for corners in np.split(order, np.flatnonzero(np.diff(face.ravel()[order])) + 1):
        own = corners // 3
        smooth[corners] = (unit[own] @ unit[own].T > CREASE) @ normal[own]
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-30)
    rows = np.concatenate([vertex[face.ravel()], smooth, uv.reshape(-1, 2)], axis=1)
    _, first, packed = np.unique(np.round(rows, 6), axis=0, return_index=True, return_inverse=True)
    kept = rows[first]
    return Mesh(kept[:, :3], kept[:, 3:6], kept[:, 6:], packed.reshape(-1, 3))


def _neighbours(face: Faces) -> csr_array:
    """Which triangles share an edge, f x f."""
    low, high = np.sort(face[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).T
    _, edge = np.unique(low * (int(face.max()) + 1) + high, return_inverse=True)
    touch = coo_array((np.ones(len(edge)), (np.arange(len(edge)) // 3, edge))).tocsr()
    return (touch @ touch.T).tocsr()


def _charts(vertex: Vertices, face: Faces) -> tuple[Int[np.ndarray, " f"], Corners]:
    """Connected triangles that look the same way along an axis, and their projections along it, metres."""
    beside, normal = _neighbours(face), normals(vertex[face])
    for _ in range(3):
        normal = beside @ normal
    axis = np.abs(normal).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(normal, axis[:, None], 1)[:, 0] > 0)
    a, b = beside.nonzero()
    alike = side[a] == side[b]
    joined = coo_array((np.ones(int(alike.sum())), (a[alike], b[alike])), shape=beside.shape)
    _, chart = connected_components(joined, directed=False)
    plane = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    return chart.astype(np.int64), np.take_along_axis(vertex[face], plane[:, None, :].repeat(3, axis=1), 2)


def _pack(chart: Int[np.ndarray, " f"], flat: Corners, side: int) -> Corners:
    """Charts side by side on shelves, as large as fits the square, a gutter around each; pixels."""
    low, high = np.full((chart.max() + 1, 2), np.inf), np.full((chart.max() + 1, 2), -np.inf)
    np.minimum.at(low, chart, flat.min(axis=1))
    np.maximum.at(high, chart, flat.max(axis=1))
    scale = side / float(np.sqrt(np.prod(high - low, axis=1).sum()))
    while True:
        box = np.ceil((high - low) * scale).astype(int) + 2 * GUTTER_PX
        corner, bottom = _shelves(box, side)
        if bottom <= side and box.max() <= side:
            return (flat - low[chart][:, None]) * scale + corner[chart][:, None] + GUTTER_PX
        scale *= 0.96


def _shelves(box: Int[np.ndarray, "c 2"], side: int) -> tuple[Int[np.ndarray, "c 2"], int]:
    """Corners of boxes (width, height) set in rows, the tallest first, and where the last row ends."""
    corner, x, y, tall = np.zeros_like(box), 0, 0, 0
    for i in np.argsort(-box[:, 1], kind="stable"):
        if x + box[i, 0] > side:
            x, y, tall = 0, y + tall, 0
        corner[i] = x, y
        x, tall = x + int(box[i, 0]), max(tall, int(box[i, 1]))
    return corner, y + tall


def _texels(corner: Float[np.ndarray, "f 3 3"], uv_px: Corners) -> tuple[Int[np.ndarray, "t 2"], Float[np.ndarray, "t 3"]]:
    """Every texel (x, y) whose centre lies in a triangle, and the point of the surface there."""
    texels, points = [np.zeros((0, 2), np.int64)], [np.zeros((0, 3))]
    for solid, flat in zip(corner, uv_px, strict=True):
        across = np.array([flat[1] - flat[0], flat[2] - flat[0]]).T
        if abs(np.linalg.det(across)) < 1e-6:
            continue
        x, y = (np.arange(int(lo), int(hi) + 1) for lo, hi in zip(flat.min(axis=0), flat.max(axis=0), strict=True))
        texel = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        share = (texel + 0.5 - flat[0]) @ np.linalg.inv(across).T
        inside = (share >= -1e-6).all(axis=1) & (share.sum(axis=1) <= 1 + 1e-6)
        texels.append(texel[inside])
        points.append(solid[0] + share[inside] @ (solid[1:] - solid[0]))
    return np.concatenate(texels), np.concatenate(points)
