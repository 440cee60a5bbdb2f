"""A new texture for a mesh without a usable one.

The mesh is unfolded into flat charts, these are packed, and every texel gets the colour of the
nearest coloured point.
"""

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from vap_core.base.errors import BadObject
from vap_core.base.types import Rgb, value
from vap_core.simulation.assets.shapes import Mesh
from vap_core.simulation.assets.triangles import Faces, Vertices, area_vectors

GUTTER_PX = 3
CREASE_COSINE = float(np.cos(np.radians(40)))
"""Neighbouring triangles that meet at a flatter angle than this are shaded as one surface."""
CornerPoints = Float[np.ndarray, "f 3 2"]
"""A point of the plane for every corner of every triangle."""


@value
class ColouredPoints:
    """Points on a surface (metres) and the surface's colours there."""

    point: Float[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]


def bake_texture(
    vertex: Vertices, face: Faces, samples: ColouredPoints, side: int
) -> tuple[Mesh, Rgb]:
    """The mesh with texture coordinates of its own, and its texture, `side` x `side`."""
    chart, flat = _unfold(vertex, face)
    uv_px = _pack_charts(chart, flat, side)
    texel, point = _covered_texels(vertex[face], uv_px)
    _, nearest = cKDTree(samples.point).query(point)
    picture = np.zeros((side, side, 3), np.uint8)
    picture[texel[:, 1], texel[:, 0]] = samples.rgb[nearest]
    blank = np.ones((side, side), bool)
    blank[texel[:, 1], texel[:, 0]] = False
    rows, cols = distance_transform_edt(blank, return_distances=False, return_indices=True)
    return creased_mesh(vertex, face, uv_px / side), picture[rows, cols]


def shrink_image(picture: Rgb, side: int) -> Rgb:
    """The picture with its longer side at most `side` pixels."""
    image = Image.fromarray(picture)
    image.thumbnail((side, side))
    return np.array(image)


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
    return Mesh(
        vertex=kept[:, :3],
        normal=kept[:, 3:6],
        uv=kept[:, 6:],
        face=packed.reshape(-1, 3),
    )


def _neighbours(face: Faces) -> csr_array:
    """Which triangles share an edge, f x f."""
    low, high = np.sort(face[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).T
    _, edge = np.unique(low * (int(face.max()) + 1) + high, return_inverse=True)
    touch = coo_array((np.ones(len(edge)), (np.arange(len(edge)) // 3, edge))).tocsr()
    return (touch @ touch.T).tocsr()


def _unfold(vertex: Vertices, face: Faces) -> tuple[Int[np.ndarray, " f"], CornerPoints]:
    """Each triangle's chart, and its corners projected onto the chart's plane, metres.

    A chart is a connected group of triangles that face the same way along an axis.
    """
    adjacency, normal = _neighbours(face), area_vectors(vertex[face])
    for _ in range(3):
        normal = adjacency @ normal
    axis = np.abs(normal).argmax(axis=1)
    direction = 2 * axis + (np.take_along_axis(normal, axis[:, None], 1)[:, 0] > 0)
    a, b = adjacency.nonzero()
    alike = direction[a] == direction[b]
    joined = coo_array((np.ones(int(alike.sum())), (a[alike], b[alike])), shape=adjacency.shape)
    _, chart = connected_components(joined, directed=False)
    plane = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    axes = plane[:, None, :].repeat(3, axis=1)
    return chart.astype(np.int64), np.take_along_axis(vertex[face], axes, 2)


def _pack_charts(chart: Int[np.ndarray, " f"], flat: CornerPoints, side: int) -> CornerPoints:
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
        corner, bottom = _place_on_shelves(size, side)
        if bottom <= side and size.max() <= side:
            return (flat - low[chart][:, None]) * scale + corner[chart][:, None] + GUTTER_PX
        scale *= 0.96


def _place_on_shelves(
    size: Int[np.ndarray, "c 2"], side: int
) -> tuple[Int[np.ndarray, "c 2"], int]:
    """Corners of boxes (width, height) in rows, the tallest first, and where the last row ends."""
    corner, x, y, tall = np.zeros_like(size), 0, 0, 0
    for i in np.argsort(-size[:, 1], kind="stable"):
        width, height = size[i]
        if x + width > side:
            x, y, tall = 0, y + tall, 0
        corner[i] = x, y
        x, tall = x + int(width), max(tall, int(height))
    return corner, y + tall


def _covered_texels(
    corner: Float[np.ndarray, "f 3 3"], uv_px: CornerPoints
) -> tuple[Int[np.ndarray, "t 2"], Float[np.ndarray, "t 3"]]:
    """Every texel (x, y) whose centre lies in a triangle, and the point of the surface there."""
    texels, points = [np.zeros((0, 2), np.int64)], [np.zeros((0, 3))]
    for triangle, flat in zip(corner, uv_px, strict=True):
        across = np.array([flat[1] - flat[0], flat[2] - flat[0]]).T
        if abs(np.linalg.det(across)) < 1e-6:
            continue
        low, high = flat.min(axis=0), flat.max(axis=0)
        x = np.arange(int(low[0]), int(high[0]) + 1)
        y = np.arange(int(low[1]), int(high[1]) + 1)
        texel = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        share = (texel + 0.5 - flat[0]) @ np.linalg.inv(across).T
        inside = (share >= -1e-6).all(axis=1) & (share.sum(axis=1) <= 1 + 1e-6)
        texels.append(texel[inside])
        points.append(triangle[0] + share[inside] @ (triangle[1:] - triangle[0]))
    return np.concatenate(texels), np.concatenate(points)
