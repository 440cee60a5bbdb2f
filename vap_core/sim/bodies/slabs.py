"""Flat-sided parts with sharp edges: boards, boxes and roofs. Lengths in metres; paints as in `shapes`."""

import numpy as np

from vap_core.sim.shapes import DECORATED, Mesh, Number, join
from vap_core.sim.textures import BASE, DECOR

Half = tuple[Number, Number]


def facet(corners: np.ndarray, paint: int, uv: np.ndarray | None = None) -> Mesh:
    """A flat convex polygon: (k, 3) corners, counter-clockwise seen from outside."""
    k = len(corners)
    normal = np.cross(corners[2] - corners[0], corners[-1] - corners[1] if k > 3 else corners[2] - corners[1])
    normal = normal / max(float(np.linalg.norm(normal)), 1e-15)
    uv = np.broadcast_to([(paint + 0.5) / 8, (1 + DECOR) / 2], (k, 2)) if uv is None else uv
    face = np.stack([np.zeros(k - 2, int), np.arange(1, k - 1), np.arange(2, k)], 1)
    a, b, c = (corners[face[:, j]] for j in range(3))
    alive = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-10
    return Mesh(np.asarray(corners, np.float64), np.broadcast_to(normal, (k, 3)), np.asarray(uv, np.float64), face[alive])


def frustum(low: Half, high: Half, bottom: Number, top: Number, paint: int, lid: int | None = None) -> Mesh:
    """A box with half-widths `low` at z = `bottom` and `high` at z = `top`; decorated, its sides show the decoration once, the front its middle."""
    corner = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
    ring = [np.column_stack([corner * half, np.full(4, z)]) for half, z in ((low, bottom), (high, top))]
    turnings = np.cumsum([0, low[0], 2 * low[1], 2 * low[0], 2 * low[1], low[0]], dtype=np.float64)
    u = turnings / turnings[-1]
    sides = []
    for i in range(4):
        j = (i + 1) % 4
        points = np.stack([ring[0][i], ring[0][j], ring[1][j], ring[1][i]])
        left, right = (-u[1], u[1]) if i == 0 else (u[i], u[i + 1])
        spots = np.array([(left, DECOR - 0.008), (right, DECOR - 0.008), (right, 0.004), (left, 0.004)])
        sides.append(facet(points, paint, spots if paint == DECORATED else None))
    plain = BASE if paint == DECORATED else paint
    return join([*sides, facet(ring[1], plain if lid is None else lid), facet(ring[0][::-1], plain)])


def box(half: Half, bottom: Number, top: Number, paint: int) -> Mesh:
    return frustum(half, half, bottom, top, paint)


def panel(wide: Number, high: Number, paint: int, thick: Number = 0.0008) -> Mesh:
    """A thin plate against a wall: it faces -y, its back at y = 0, centred on the origin; without a back."""
    x, z = wide / 2, high / 2
    points = np.array([(-x, 0, -z), (x, 0, -z), (x, 0, z), (-x, 0, z)], np.float64)
    front = points - (0, thick, 0)
    rim = [facet(np.stack([points[i], points[(i + 1) % 4], front[(i + 1) % 4], front[i]]), paint) for i in range(4)]
    return join([facet(front, paint), *rim])
