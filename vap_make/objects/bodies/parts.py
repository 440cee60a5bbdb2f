"""Surfaces turned around the z axis or swept along a path, and simple parts made of them.

Lengths are metres. `swatch` is a number of `textures`, or `DECORATED` for the decoration.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from vap_core.simulation.assets.shapes import area_vectors
from vap_make.objects.shapes import Mesh, Number, Solid, join_meshes
from vap_make.objects.textures import BASE, DECORATED, DECORATION_SHARE, decoration_v, swatch_uv

Profile = list[tuple[Number, Number]]
"""A run of (radius, z) points."""
CIRCLE = (1, 1, 2)


def lathe(
    profile: Profile,
    swatch: int,
    segments: int = 24,
    section: tuple[Number, Number, Number] = CIRCLE,
    wraps: int = 1,
) -> Mesh:
    """A smooth profile turned around z.

    The profile runs with the outside on its right: up the outer wall, down the inner. `section` is
    (x, y, p): the cross-section is the superellipse |x'/x|^p + |y'/y|^p = 1 scaled by the radius.
    The decoration goes `wraps` times around.
    """
    knots = np.array(profile, np.float64)
    tangent = np.gradient(knots, axis=0)
    angle = 2 * np.pi * np.linspace(0, 1, segments + 1) - 1.5 * np.pi
    half_x, half_y, power = section
    cos, sin = np.cos(angle), np.sin(angle)
    reach = (np.abs(cos / half_x) ** power + np.abs(sin / half_y) ** power) ** (-1 / power)
    ring = np.stack([reach * cos, reach * sin], 1)
    outward = np.stack(
        [
            np.sign(cos) * np.abs(ring[:, 0] / half_x) ** (power - 1) / half_x,
            np.sign(sin) * np.abs(ring[:, 1] / half_y) ** (power - 1) / half_y,
        ],
        1,
    )
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    shape = (len(knots), segments + 1)
    z = np.broadcast_to(knots[:, None, 1:], (*shape, 1))
    grid = np.concatenate([knots[:, None, :1] * ring[None], z], 2)
    scale = float(np.hypot(*ring.T).mean())
    normal_z = np.broadcast_to(-scale * tangent[:, None, :1], (*shape, 1))
    normal = np.concatenate([tangent[:, None, 1:] * outward[None], normal_z], 2)
    if swatch != DECORATED:
        return _mesh_of_grid(grid, normal, swatch_uv(swatch, shape))
    up = _path_length(knots * (scale, 1))
    around = _path_length(ring)
    v = decoration_v(1 - up / up[-1])
    return _mesh_of_grid(grid, normal, np.stack(np.meshgrid(wraps * around / around[-1], v), 2))


def _path_length(points: np.ndarray) -> np.ndarray:
    """Distance along the points from the first to each."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def _mesh_of_grid(grid: np.ndarray, normal: np.ndarray, uv: np.ndarray) -> Mesh:
    """A (k, m) grid of points as triangles, without those that have collapsed."""
    vertex = grid.reshape(-1, 3)
    face = grid_faces(*grid.shape[:2])
    alive = np.linalg.norm(area_vectors(vertex[face]), axis=1) > 1e-10
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return Mesh(
        vertex=vertex,
        normal=(normal / np.maximum(length, 1e-12)).reshape(-1, 3),
        uv=uv.reshape(-1, 2),
        face=face[alive],
    )


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Two triangles for every cell of a grid of points, numbered row by row."""
    i = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([i, i + 1, i + columns + 1], 1)
    upper = np.stack([i, i + columns + 1, i + columns], 1)
    return np.concatenate([lower, upper])


def tube(
    path: Float[np.ndarray, "k 3"],
    radius: Number,
    swatch: int,
    sides: int = 6,
    capped: bool = True,
) -> Mesh:
    """A round bar along a path; `capped`, its ends are closed by points.

    A closed path repeats its first point as its last and needs no caps.
    """
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    if abs(along[:, 1]).max() < 0.9:
        reference = np.array([0.0, 1.0, 0.0])
    else:
        reference = np.array([1.0, 0.0, 0.0])
    first = np.cross(along, reference)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(along, first)
    angle = np.linspace(0, 2 * np.pi, sides + 1)[None, :, None]
    normal = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]
    grid = path[:, None] + radius * normal
    if capped:
        ring = (1, sides + 1, 3)
        start, end = np.broadcast_to(path[0], ring), np.broadcast_to(path[-1], ring)
        grid = np.concatenate([start, grid, end])
        back, ahead = np.broadcast_to(-along[0], ring), np.broadcast_to(along[-1], ring)
        normal = np.concatenate([back, normal, ahead])
    return _mesh_of_grid(grid, normal, swatch_uv(swatch, grid.shape[:2]))


def arc_profile(
    centre: tuple[Number, Number], half: tuple[Number, Number], angles: Float[np.ndarray, " k"]
) -> Profile:
    """Points of an ellipse in the (radius, z) plane; angle 0 points outwards, pi / 2 up."""
    profile: Profile = []
    for angle in angles:
        radius = centre[0] + half[0] * float(np.cos(angle))
        profile.append((radius, centre[1] + half[1] * float(np.sin(angle))))
    return profile


def smooth_profile(knots: Profile, rows: int) -> Profile:
    """A smooth profile through the knots (radius over z), evenly apart in z."""
    from scipy.interpolate import PchipInterpolator

    radius, z = np.array(knots).T
    levels = np.linspace(z[0], z[-1], rows)
    radii = PchipInterpolator(z, radius)(levels)
    return list(zip(radii.tolist(), levels.tolist(), strict=True))


def ellipsoid(
    half: tuple[Number, Number, Number], swatch: int, segments: int = 12, rows: int = 6
) -> Mesh:
    """An ellipsoid around the origin with the given half-axes."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, rows + 1)
    profile = arc_profile((0.0, 0.0), (1.0, half[2]), angles)
    return lathe(profile, swatch, segments, section=(half[0], half[1], 2))


def closed_cylinder(
    radius: Number, height: Number, swatch: int, segments: int = 20, top: int | None = None
) -> Mesh:
    """A cylinder that stands on z = 0; `top` is the swatch of its upper face."""
    if top is None:
        top = swatch
    return join_meshes(
        [
            lathe([(0, 0), (radius, 0)], swatch, segments),
            lathe([(radius, 0), (radius, height)], swatch, segments),
            lathe([(radius, height), (0, height)], top, segments),
        ]
    )


def rounded_block(
    half: tuple[Number, Number],
    height: Number,
    swatch: int,
    power: Number = 8,
    segments: int = 16,
) -> Mesh:
    """A closed prism on z = 0 whose section is a rectangle with rounded corners.

    A higher `power` makes the corners sharper.
    """
    section = (*half, power)
    return join_meshes(
        [
            lathe([(0, 0), (1, 0)], swatch, segments, section),
            lathe([(1, 0), (1, height)], swatch, segments, section),
            lathe([(1, height), (0, height)], swatch, segments, section),
        ]
    )


def handle_bar(
    kind: str,
    radius: Number,
    low: Number,
    high: Number,
    reach: Number,
    thickness: Number,
    swatch: int,
) -> Mesh:
    """A bar from (radius, 0, low) out along +x by `reach` and back at `high`.

    `kind` is "round", "square" or "ear" (wider above); `thickness` is the bar's radius.
    """
    power = {"round": 1.0, "square": 0.45, "ear": 0.8}[kind]
    t = np.linspace(-np.pi / 2, np.pi / 2, 11)
    bend = np.ones_like(t)
    if kind == "ear":
        bend = 0.84 + 0.16 * np.sin(t)
    x = radius - 0.001 + reach * bend * np.abs(np.cos(t)) ** power
    z = (low + high) / 2 + (high - low) / 2 * np.sign(np.sin(t)) * np.abs(np.sin(t)) ** power
    return tube(np.stack([x, np.zeros_like(t), z], 1), thickness, swatch)


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
