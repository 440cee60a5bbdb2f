"""Parametric bodies: frozen parameters (metres) become one textured triangle mesh and a handful of collision solids.

Every body stands on z = 0, centred on the z axis, its front towards -y. Decorated walls map to the upper part of the texture
atlas, plain parts to a swatch (see `textures`).
"""

from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from vap_core.sim.textures import DECOR
from vap_core.values import value

DECORATED = -1
Number = float | int
Profile = list[tuple[Number, Number]]


@value
class Mesh:
    """Triangles, wound counter-clockwise seen from outside; one normal and one texture coordinate (image x, y in 0..1) a vertex."""

    vertex: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"]
    face: Int[np.ndarray, "f 3"]

    def moved(self, offset: tuple[Number, Number, Number] = (0, 0, 0), turn: np.ndarray | None = None) -> "Mesh":
        """Turned by the 3 x 3 rotation, then shifted by `offset` metres."""
        turn = np.eye(3) if turn is None else turn
        return Mesh(self.vertex @ turn.T + np.array(offset, np.float64), self.normal @ turn.T, self.uv, self.face)


@value
class Solid:
    """A collision primitive, metres: half-extents of a box or an ellipsoid, or (radius, half-length) of a cylinder or a capsule along `axis`.

    `turn` then rotates it: radians about x, y and z, in that order.
    """

    kind: Literal["box", "cylinder", "ellipsoid", "capsule"]
    size: tuple[Number, ...]
    pos: tuple[Number, Number, Number]
    axis: Literal["x", "y", "z"] = "z"
    turn: tuple[Number, Number, Number] = (0, 0, 0)

    @property
    def volume(self) -> float:
        """Cubic metres."""
        match self.kind:
            case "box":
                return float(8 * np.prod(self.size))
            case "ellipsoid":
                return float(4 / 3 * np.pi * np.prod(self.size))
            case "cylinder":
                return float(2 * np.pi * self.size[0] ** 2 * self.size[1])
            case "capsule":
                return float(np.pi * self.size[0] ** 2 * (2 * self.size[1] + 4 / 3 * self.size[0]))

    def rotation(self) -> np.ndarray:
        """Body from solid, 3 x 3, for a primitive that lies along its own z."""
        lay = {"x": turn(y=np.pi / 2), "y": turn(x=-np.pi / 2), "z": np.eye(3)}[self.axis]
        return turn(*self.turn) @ lay


@value
class Hull:
    """A convex collision solid of any form: its corners (metres) and its volume (cubic metres)."""

    vertex: Float[np.ndarray, "n 3"]
    volume: float


@runtime_checkable
class Shape(Protocol):
    """A body: its mesh, its collision solids and its decorated wall's circumference over its height."""

    def mesh(self) -> Mesh: ...

    def solids(self) -> "tuple[Solid, ...] | tuple[Hull, ...]": ...

    def aspect(self) -> float: ...


def join(parts: list[Mesh]) -> Mesh:
    start = np.cumsum([0, *(len(p.vertex) for p in parts)])
    face = np.concatenate([p.face + s for p, s in zip(parts, start, strict=False)])
    return Mesh(np.concatenate([p.vertex for p in parts]), np.concatenate([p.normal for p in parts]), np.concatenate([p.uv for p in parts]), face)


def _sheet(grid: np.ndarray, normal: np.ndarray, uv: np.ndarray) -> Mesh:
    """A (k, m) grid of points as triangles, without those that have collapsed."""
    k, m = grid.shape[:2]
    i = (np.arange(k - 1)[:, None] * m + np.arange(m - 1)).ravel()
    face = np.concatenate([np.stack([i, i + 1, i + m + 1], 1), np.stack([i, i + m + 1, i + m], 1)])
    vertex = grid.reshape(-1, 3)
    a, b, c = (vertex[face[:, j]] for j in range(3))
    alive = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-10
    size = np.linalg.norm(normal, axis=-1, keepdims=True)
    return Mesh(vertex, (normal / np.maximum(size, 1e-12)).reshape(-1, 3), uv.reshape(-1, 2), face[alive])


def _swatch(colour: int, shape: tuple[int, ...]) -> np.ndarray:
    return np.broadcast_to([(colour + 0.5) / 8, (1 + DECOR) / 2], (*shape, 2))


def lathe(profile: Profile, paint: int, n: int = 24, cross: tuple[Number, Number, Number] = (1, 1, 2), wraps: int = 1) -> Mesh:
    """Turn a smooth run of (radius, z) around z; walk it with the outside on the right (up the outer wall, down the inner).

    `cross` is (x, y, p): the section is the superellipse |x'/x|^p + |y'/y|^p = 1 scaled by the radius.
    The decoration goes `wraps` times around.
    """
    p = np.array(profile, np.float64)
    t = np.gradient(p, axis=0)
    u = np.linspace(0, 1, n + 1)
    phi = 2 * np.pi * u - 1.5 * np.pi
    x, y, power = cross
    c, s = np.cos(phi), np.sin(phi)
    reach = (np.abs(c / x) ** power + np.abs(s / y) ** power) ** (-1 / power)
    ring = np.stack([reach * c, reach * s], 1)
    out = np.stack([np.sign(c) * np.abs(ring[:, 0] / x) ** (power - 1) / x, np.sign(s) * np.abs(ring[:, 1] / y) ** (power - 1) / y], 1)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    k = len(p)
    grid = np.concatenate([p[:, None, :1] * ring[None], np.broadcast_to(p[:, None, 1:], (k, n + 1, 1))], 2)
    scale = float(np.hypot(*ring.T).mean())
    normal = np.concatenate([t[:, None, 1:] * out[None], np.broadcast_to(-scale * t[:, None, :1], (k, n + 1, 1))], 2)
    if paint != DECORATED:
        return _sheet(grid, normal, _swatch(paint, (k, n + 1)))
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(p * (scale, 1), axis=0), axis=1))])
    around = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
    v = 0.004 + (DECOR - 0.012) * (1 - along / along[-1])
    return _sheet(grid, normal, np.stack(np.meshgrid(wraps * around / around[-1], v), 2))


def tube(path: np.ndarray, radius: float, paint: int, sides: int = 6, closed: bool = True) -> Mesh:
    """A round bar along a (k, 3) path, ends closed by points."""
    d = np.gradient(path, axis=0)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    ref = np.array([0.0, 1.0, 0.0]) if abs(d[:, 1]).max() < 0.9 else np.array([1.0, 0.0, 0.0])
    a = np.cross(d, ref)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(d, a)
    phi = np.linspace(0, 2 * np.pi, sides + 1)[None, :, None]
    out = np.cos(phi) * a[:, None] + np.sin(phi) * b[:, None]
    grid = path[:, None] + radius * out
    if closed:
        ends = [np.broadcast_to(path[i], (1, sides + 1, 3)) for i in (0, -1)]
        grid = np.concatenate([ends[0], grid, ends[1]])
        out = np.concatenate([np.broadcast_to(-d[0], (1, sides + 1, 3)), out, np.broadcast_to(d[-1], (1, sides + 1, 3))])
    return _sheet(grid, out, _swatch(paint, grid.shape[:2]))


def ellipsoid(half: tuple[Number, Number, Number], paint: int, n: int = 12, rows: int = 6) -> Mesh:
    t = np.linspace(-np.pi / 2, np.pi / 2, rows + 1)
    return lathe([(float(np.cos(a)), half[2] * float(np.sin(a))) for a in t], paint, n, (half[0], half[1], 2))


def turn(x: Number = 0, y: Number = 0, z: Number = 0) -> np.ndarray:
    """Rotation about x, then y, then z, radians."""
    (cx, sx), (cy, sy), (cz, sz) = ((np.cos(a), np.sin(a)) for a in (x, y, z))
    rx, ry, rz = [[1, 0, 0], [0, cx, -sx], [0, sx, cx]], [[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]], [[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]
    return np.array(rz) @ np.array(ry) @ np.array(rx)


def barrel(radius: float, height: float, paint: int, n: int = 20, top: int | None = None) -> Mesh:
    """A closed cylinder standing on z = 0."""
    return join([lathe([(0, 0), (radius, 0)], paint, n), lathe([(radius, 0), (radius, height)], paint, n),
                 lathe([(radius, height), (0, height)], paint if top is None else top, n)])  # fmt: skip


def block(half: tuple[Number, Number], height: float, paint: int, power: float = 8, n: int = 16) -> Mesh:
    """A closed prism on z = 0 with a rounded rectangular section."""
    cross = (*half, power)
    return join([lathe([(0, 0), (1, 0)], paint, n, cross), lathe([(1, 0), (1, height)], paint, n, cross),
                 lathe([(1, height), (0, height)], paint, n, cross)])  # fmt: skip


def handle(kind: str, radius: float, low: float, high: float, reach: float, thick: float, paint: int) -> Mesh:
    """A bar from (radius, 0, low) out along +x and back at `high`."""
    power = {"round": 1.0, "square": 0.45, "ear": 0.8}[kind]
    t = np.linspace(-np.pi / 2, np.pi / 2, 11)
    bend = 0.84 + 0.16 * np.sin(t) if kind == "ear" else np.ones_like(t)
    x = radius - 0.001 + reach * bend * np.abs(np.cos(t)) ** power
    z = (low + high) / 2 + (high - low) / 2 * np.sign(np.sin(t)) * np.abs(np.sin(t)) ** power
    return tube(np.stack([x, np.zeros_like(t), z], 1), thick, paint)


def foot(radius: Number) -> Solid:
    """A square foot inside the circle: boxes rest on four contacts, cylinders on fewer."""
    return Solid("box", (0.74 * radius, 0.74 * radius, 0.002), (0, 0, 0.002))


def pillar(radius: float, low: float, high: float) -> Solid:
    return Solid("cylinder", (radius, (high - low) / 2), (0, 0, (high + low) / 2))
