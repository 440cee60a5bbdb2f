"""Closed surfaces of simple forms, as corners of triangles: what made-up designs are built from.

Lengths are metres, z is up. Every form closes itself, and its triangles face outwards.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from vap_core.simulation.assets.shapes import area_vectors

Corners = Float[np.ndarray, "f 3 3"]
Number = float | int
Point = Sequence[Number]
AROUND, ALONG = 20, 10
"""Corners around a form, and rings from one end to the other."""


def lathe(profile: Sequence[tuple[Number, Number]], sides: int = 2 * AROUND) -> Corners:
    """A profile of (radius, z) turned around the z axis; it begins and ends on the axis.

    Few sides make a prism.
    """
    radius, z = np.array(profile, np.float64).T
    turn = _turn(sides, start=np.pi / sides)
    grid = np.stack(
        [
            radius[:, None] * np.cos(turn),
            radius[:, None] * np.sin(turn),
            np.broadcast_to(z[:, None], (len(z), len(turn))),
        ],
        axis=-1,
    )
    return _closed(grid)


def hollow(
    outside: Sequence[tuple[Number, Number]], wall: float, sides: int = 2 * AROUND
) -> Corners:
    """A vessel: an outer profile from its foot to its rim, and a wall of that thickness."""
    foot = outside[0][1]
    inside = []
    for radius, z in reversed(outside):
        if z >= foot + 2 * wall:
            inside.append((max(radius - wall, wall / 2), z))
    bottom = (inside[-1][0], foot + 2 * wall)
    profile = [(0.0, foot), *outside, *inside, bottom, (0.0, foot + 2 * wall)]
    return lathe(profile, sides)


def blob(centre: Point, radii: Point, boxy: float = 1.0) -> Corners:
    """An ellipsoid; `boxy` above 1 makes it ever more like a box with round edges."""
    across = _turn(AROUND)
    up = np.linspace(-np.pi / 2, np.pi / 2, ALONG + 1)[:, None]
    unit = np.stack(
        [
            _bulge(np.cos(up), boxy) * _bulge(np.cos(across), boxy),
            _bulge(np.cos(up), boxy) * _bulge(np.sin(across), boxy),
            np.broadcast_to(_bulge(np.sin(up), boxy), (len(up), len(across))),
        ],
        axis=-1,
    )
    unit[[0, -1], :, :2] = 0.0
    return _closed(unit * np.array(radii) + np.array(centre))


def tube(path: Sequence[Point], radius: float, flat: float = 1.0) -> Corners:
    """A round bar along a path in a vertical plane; `flat` is its width over its height."""
    points = np.array(path, np.float64)
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, _least_axis(points))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(along, side)
    turn = _turn(AROUND // 2)
    rings = (
        points[:, None]
        + radius * np.cos(turn)[:, None] * side[:, None]
        + flat * radius * np.sin(turn)[:, None] * other[:, None]
    )
    first = np.broadcast_to(points[0], rings[:1].shape)
    last = np.broadcast_to(points[-1], rings[:1].shape)
    return _closed(np.concatenate([first, rings, last]))


def ring(centre: Point, radii: tuple[float, float], bar: float, corners: int = 16) -> list[Point]:
    """The path of half a ring beside the z axis, from its top to its foot, in the x-z plane.

    Few `corners` make it angular. `bar` is how far both ends reach into the body.
    """
    turn = np.linspace(np.pi / 2, -np.pi / 2, corners)
    path = [(centre[0] - bar, centre[1], centre[2] + radii[1])]
    for angle in turn:
        x = centre[0] + radii[0] * float(np.cos(angle))
        path.append((x, centre[1], centre[2] + radii[1] * float(np.sin(angle))))
    return [*path, (centre[0] - bar, centre[1], centre[2] - radii[1])]


def _turn(sides: int, start: float = 0.0) -> Float[np.ndarray, " n"]:
    """Angles once around; the last is the first."""
    turn = start + 2 * np.pi * np.arange(sides + 1) / sides
    turn[-1] = start
    return turn


def _bulge(share: np.ndarray, boxy: float) -> np.ndarray:
    return np.sign(share) * np.abs(share) ** (1 / boxy)


def _least_axis(points: np.ndarray) -> np.ndarray:
    """The axis along which a path extends least."""
    axis = np.zeros(3)
    axis[int(np.ptp(points, axis=0).argmin())] = 1.0
    return axis


def _closed(grid: Float[np.ndarray, "r n 3"]) -> Corners:
    """The triangles of a grid whose first and last ring are points; those that vanish left out."""
    a, b = grid[:-1, :-1], grid[:-1, 1:]
    c, d = grid[1:, 1:], grid[1:, :-1]
    first = np.stack([a, b, c], axis=2).reshape(-1, 3, 3)
    second = np.stack([a, c, d], axis=2).reshape(-1, 3, 3)
    corner = np.concatenate([first, second])
    corner = corner[np.linalg.norm(area_vectors(corner), axis=1) > 1e-12]
    volume = (corner[:, 0] * area_vectors(corner)).sum()
    if volume < 0:
        corner = corner[:, ::-1]
    return np.ascontiguousarray(corner)
