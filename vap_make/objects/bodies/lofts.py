"""Surfaces that are not turned: grids of points, stacked rings, discs, and capsules along a path.

Lengths are metres. `swatch` is a number of `textures`, or `DECORATED` for the decoration.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from vap_core.simulation.assets.shapes import area_vectors
from vap_make.objects.bodies.turned import grid_faces
from vap_make.objects.shapes import Mesh, Number, Solid
from vap_make.objects.textures import DECORATED, decoration_v, swatch_uv


def smooth_mesh(
    vertex: Float[np.ndarray, "n 3"], uv: Float[np.ndarray, "n 2"], face: np.ndarray
) -> Mesh:
    """The triangles with area-weighted normals, without collapsed ones.

    Vertices within a micrometre share their normal.
    """
    area = area_vectors(vertex[face])
    alive = np.linalg.norm(area, axis=1) > 1e-10
    face, area = face[alive], area[alive]
    rounded = np.rint(vertex / 1e-6).astype(np.int64)
    _, place = np.unique(rounded, axis=0, return_inverse=True)
    place = place.ravel()
    total = np.zeros((place.max() + 1, 3))
    for corner in range(3):
        np.add.at(total, place[face[:, corner]], area)
    normal = total[place]
    length = np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return Mesh(vertex=vertex, normal=normal / length, uv=uv, face=face)


def grid_mesh(
    grid: Float[np.ndarray, "k m 3"],
    swatch: int,
    across: np.ndarray | None = None,
    down: np.ndarray | None = None,
) -> Mesh:
    """A grid of points as a smooth surface.

    Rows run upwards and columns to the right for someone who looks at its outside. Decorated, it
    shows all of the decoration, its last row the top; `across` (0..1, per column) and `down`
    (0 top .. 1 bottom, per point) override this.
    """
    rows, columns = grid.shape[:2]
    uv = swatch_uv(swatch, (rows, columns))
    if swatch == DECORATED:
        if down is None:
            down = np.broadcast_to(np.linspace(1, 0, rows)[:, None], (rows, columns))
        if across is None:
            across = np.linspace(0, 1, columns)
        uv = np.stack([np.broadcast_to(across, (rows, columns)), decoration_v(down)], 2)
    vertex = grid.reshape(-1, 3).astype(np.float64)
    return smooth_mesh(vertex, uv.reshape(-1, 2), grid_faces(rows, columns))


def interpolate_knots(
    knots: Sequence[Sequence[Number]], rows: int
) -> Float[np.ndarray, "rows columns"]:
    """Smooth rows through the knots, evenly apart in their first column, which increases.

    The curve does not overshoot the knots.
    """
    from scipy.interpolate import PchipInterpolator

    table = np.array(knots, np.float64)
    first = np.linspace(table[0, 0], table[-1, 0], rows)
    return np.column_stack([first, PchipInterpolator(table[:, 0], table[:, 1:])(first)])


def stacked_rings(
    levels: Float[np.ndarray, "k 4"],
    swatch: int,
    segments: int = 20,
    power: Number = 2,
    closed_top: bool = False,
) -> Mesh:
    """Rings stacked upwards, each a superellipse of the given power.

    A level is (z, centre y, half-width x, half-depth y). `closed_top` adds a point in the middle of
    the last ring.
    """
    angle = 2 * np.pi * np.linspace(0, 1, segments + 1) - 1.5 * np.pi
    cos, sin = np.cos(angle), np.sin(angle)
    reach = (np.abs(cos) ** power + np.abs(sin) ** power) ** (-1 / power)
    z, centre_y, half_x, half_y = levels.T[:, :, None]
    x = half_x * reach * cos
    y = centre_y + half_y * reach * sin
    grid = np.stack([x, y, np.broadcast_to(z, x.shape)], 2)
    if closed_top:
        tip = np.broadcast_to([0.0, levels[-1, 1], levels[-1, 0]], (1, segments + 1, 3))
        grid = np.concatenate([grid, tip])
    steps = np.linalg.norm(np.diff(grid[0], axis=0), axis=1)
    along = np.concatenate([[0], np.cumsum(steps)])
    return grid_mesh(grid, swatch, across=along / max(along[-1], 1e-9))


def flat_disc(
    centre: tuple[Number, Number, Number],
    half: tuple[Number, Number],
    swatch: int,
    segments: int = 14,
) -> Mesh:
    """A horizontal ellipse that faces down."""
    angle = np.linspace(0, 2 * np.pi, segments + 1) * -1
    middle = np.array(centre, np.float64)
    rim = np.stack([half[0] * np.cos(angle), half[1] * np.sin(angle), 0 * angle], 1) + middle
    return grid_mesh(np.stack([rim, np.broadcast_to(middle, rim.shape)]), swatch)


def capsules_along(
    path: Float[np.ndarray, "k 3"], radius: Number, count: int = 2
) -> tuple[Solid, ...]:
    """Capsules that follow a path: the collision solids of a bar."""
    stops = path[np.linspace(0, len(path) - 1, count + 1).round().astype(int)]
    capsules = []
    for i in range(count):
        x, y, z = ((stops[i] + stops[i + 1]) / 2).tolist()
        dx, dy, dz = (stops[i + 1] - stops[i]).tolist()
        half_length = float(np.hypot(dx, np.hypot(dy, dz))) / 2
        euler = (0, np.arctan2(np.hypot(dx, dy), dz), np.arctan2(dy, dx))
        capsules.append(Solid("capsule", (radius, half_length), (x, y, z), euler=euler))
    return tuple(capsules)
