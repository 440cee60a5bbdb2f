"""Surfaces that are not turned on a lathe: stacked rings, ribs along a body, sheets, and the normals of whatever was bent.

Lengths are metres. As in `shapes`, decorated surfaces map to the upper part of the atlas and plain ones to a swatch.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from vap_core.sim.shapes import DECORATED, Mesh, Number, Solid, tube
from vap_core.sim.textures import DECOR


def smoothed(vertex: Float[np.ndarray, "n 3"], uv: Float[np.ndarray, "n 2"], face: np.ndarray) -> Mesh:
    """The triangles with area-weighted normals, shared by vertices within a micrometre; collapsed triangles are left out."""
    a, b, c = (vertex[face[:, j]] for j in range(3))
    area = np.cross(b - a, c - a)
    alive = np.linalg.norm(area, axis=1) > 1e-10
    face, area = face[alive], area[alive]
    _, place = np.unique(np.rint(vertex / 1e-6).astype(np.int64), axis=0, return_inverse=True)
    place = place.ravel()
    total = np.zeros((place.max() + 1, 3))
    for j in range(3):
        np.add.at(total, place[face[:, j]], area)
    normal = total[place]
    return Mesh(vertex, normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12), uv, face)


def reshaped(mesh: Mesh, move: Callable[[np.ndarray], np.ndarray]) -> Mesh:
    """The mesh with every vertex moved, and normals to fit."""
    return smoothed(np.asarray(move(mesh.vertex), np.float64), mesh.uv, mesh.face)


def sheet(grid: Float[np.ndarray, "k m 3"], paint: int, across: np.ndarray | None = None, down: np.ndarray | None = None) -> Mesh:
    """A grid of points as triangles: rows run upwards and columns to the right for someone who looks at its outside.

    Decorated, it shows all of the decoration, its last row the top; `across` (0..1, per column) and `down` (0 top .. 1 bottom, per point) override.
    """
    k, m = grid.shape[:2]
    i = (np.arange(k - 1)[:, None] * m + np.arange(m - 1)).ravel()
    face = np.concatenate([np.stack([i, i + 1, i + m + 1], 1), np.stack([i, i + m + 1, i + m], 1)])
    uv = np.broadcast_to([(paint + 0.5) / 8, (1 + DECOR) / 2], (k, m, 2))
    if paint == DECORATED:
        v = np.broadcast_to(np.linspace(1, 0, k)[:, None], (k, m)) if down is None else down
        u = np.linspace(0, 1, m) if across is None else across
        uv = np.stack([np.broadcast_to(u, (k, m)), 0.004 + (DECOR - 0.012) * v], 2)
    return smoothed(grid.reshape(-1, 3).astype(np.float64), uv.reshape(-1, 2), face)


def curve(knots: Sequence[Sequence[Number]], rows: int) -> Float[np.ndarray, "rows c"]:
    """Smooth rows through the knots, evenly apart in their first column, which increases; no overshoot."""
    from scipy.interpolate import PchipInterpolator

    table = np.array(knots, np.float64)
    first = np.linspace(table[0, 0], table[-1, 0], rows)
    return np.column_stack([first, PchipInterpolator(table[:, 0], table[:, 1:])(first)])


def rings(levels: Float[np.ndarray, "k 4"], paint: int, n: int = 20, power: Number = 2, shut: bool = False) -> Mesh:
    """Rings (z, centre y, half-width x, half-depth y) stacked upwards, each a superellipse; `shut` closes the top with a point."""
    phi = 2 * np.pi * np.linspace(0, 1, n + 1) - 1.5 * np.pi
    c, s = np.cos(phi), np.sin(phi)
    reach = (np.abs(c) ** power + np.abs(s) ** power) ** (-1 / power)
    z, y, wide, deep = (levels[:, j, None] for j in range(4))
    grid = np.stack([wide * reach * c, y + deep * reach * s, np.broadcast_to(z, (len(levels), n + 1))], 2)
    if shut:
        tip = np.broadcast_to([0.0, levels[-1, 1], levels[-1, 0]], (1, n + 1, 3))
        grid = np.concatenate([grid, tip])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(grid[0], axis=0), axis=1))])
    return sheet(grid, paint, along / max(along[-1], 1e-9))


def disc(centre: tuple[Number, Number, Number], half: tuple[Number, Number], paint: int, n: int = 14, down: bool = False) -> Mesh:
    """A flat ellipse, face up (or down)."""
    phi = np.linspace(0, 2 * np.pi, n + 1) * (-1 if down else 1)
    rim = np.stack([half[0] * np.cos(phi), half[1] * np.sin(phi), 0 * phi], 1) + np.array(centre, np.float64)
    return sheet(np.stack([rim, np.broadcast_to(np.array(centre, np.float64), rim.shape)]), paint)


def loop(path: Float[np.ndarray, "k 3"], radius: float, paint: int, sides: int = 5) -> Mesh:
    """A round bar along a closed path whose last point is its first."""
    return tube(path, radius, paint, sides, closed=False)


def arc(start: Number, stop: Number, n: int, at: Callable[[np.ndarray], Sequence[np.ndarray]]) -> Float[np.ndarray, "n 3"]:
    """n points of the curve `at(t)`, t from `start` to `stop`."""
    t = np.linspace(float(start), float(stop), n)
    return np.stack([np.broadcast_to(v, t.shape) for v in at(t)], 1)


def limbs(path: Float[np.ndarray, "k 3"], radius: float, n: int = 2) -> tuple[Solid, ...]:
    """n capsules that follow a path, the collision solids of a bar."""
    stops = path[np.linspace(0, len(path) - 1, n + 1).round().astype(int)]
    parts = []
    for start, stop in pairwise(stops):
        x, y, z = ((start + stop) / 2).tolist()
        dx, dy, dz = (stop - start).tolist()
        parts.append(
            Solid(
                "capsule",
                (radius, float(np.hypot(dx, np.hypot(dy, dz))) / 2),
                (x, y, z),
                turn=(0, np.arctan2(np.hypot(dx, dy), dz), np.arctan2(dy, dx)),
            )
        )
    return tuple(parts)
