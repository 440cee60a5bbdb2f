"""Flat-sided parts with sharp edges: polygons, boxes, roofs and panels.

Lengths are metres. `swatch` is a number of `textures`, or `DECORATED` for the decoration.
"""

import numpy as np
from jaxtyping import Float

from vap_core.simulation.assets.shapes import area_vectors
from vap_make.objects.shapes import Mesh, Number, join_meshes
from vap_make.objects.textures import BASE, DECORATED, DECORATION_SHARE, swatch_uv

HalfSizes = tuple[Number, Number]
"""Half-widths along x and y."""
TOP_V, BOTTOM_V = 0.004, DECORATION_SHARE - 0.008
"""Image y of the decoration's upper and lower edge."""


def flat_polygon(
    corners: Float[np.ndarray, "k 3"], swatch: int, uv: np.ndarray | None = None
) -> Mesh:
    """A flat convex polygon; its corners run counter-clockwise seen from outside."""
    count = len(corners)
    second_edge = corners[2] - corners[1]
    if count > 3:
        second_edge = corners[-1] - corners[1]
    normal = np.cross(corners[2] - corners[0], second_edge)
    normal = normal / max(float(np.linalg.norm(normal)), 1e-15)
    if uv is None:
        uv = swatch_uv(swatch, (count,))
    first = np.zeros(count - 2, int)
    face = np.stack([first, np.arange(1, count - 1), np.arange(2, count)], 1)
    alive = np.linalg.norm(area_vectors(corners[face]), axis=1) > 1e-10
    return Mesh(
        vertex=np.asarray(corners, np.float64),
        normal=np.broadcast_to(normal, (count, 3)),
        uv=np.asarray(uv, np.float64),
        face=face[alive],
    )


def frustum(low: HalfSizes, high: HalfSizes, bottom: Number, top: Number, swatch: int) -> Mesh:
    """A box with half-widths `low` at z = `bottom` and `high` at z = `top`.

    Decorated, its sides show the decoration once, the front its middle.
    """
    corner = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
    lower = np.column_stack([corner * low, np.full(4, bottom)])
    upper = np.column_stack([corner * high, np.full(4, top)])
    turnings = np.cumsum([0, low[0], 2 * low[1], 2 * low[0], 2 * low[1], low[0]], dtype=np.float64)
    u = turnings / turnings[-1]
    parts = []
    for i in range(4):
        j = (i + 1) % 4
        uv = None
        if swatch == DECORATED:
            left, right = u[i], u[i + 1]
            if i == 0:
                left = -u[1]
            uv = np.array([(left, BOTTOM_V), (right, BOTTOM_V), (right, TOP_V), (left, TOP_V)])
        parts.append(flat_polygon(np.stack([lower[i], lower[j], upper[j], upper[i]]), swatch, uv))
    end_swatch = swatch
    if swatch == DECORATED:
        end_swatch = BASE
    parts += [flat_polygon(upper, end_swatch), flat_polygon(lower[::-1], end_swatch)]
    return join_meshes(parts)


def sharp_box(half: HalfSizes, bottom: Number, top: Number, swatch: int) -> Mesh:
    """An upright box around the z axis from z = `bottom` to z = `top`."""
    return frustum(low=half, high=half, bottom=bottom, top=top, swatch=swatch)


def panel(width: Number, height: Number, swatch: int, thickness: Number = 0.0008) -> Mesh:
    """A thin plate against a wall, centred on the origin.

    It faces -y, its back is at y = 0 and left open.
    """
    x, z = width / 2, height / 2
    back = np.array([(-x, 0, -z), (x, 0, -z), (x, 0, z), (-x, 0, z)], np.float64)
    front = back - (0, thickness, 0)
    parts = [flat_polygon(front, swatch)]
    for i in range(4):
        j = (i + 1) % 4
        parts.append(flat_polygon(np.stack([back[i], back[j], front[j], front[i]]), swatch))
    return join_meshes(parts)
