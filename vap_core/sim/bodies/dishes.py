"""Open receptacles: plates, bowls and baskets in which things really lie. Lengths in metres.

Their collision solids are a flat floor of boxes and a ring of turned boxes for the wall.
"""

from itertools import pairwise
from typing import Literal

import numpy as np

from vap_core.sim.shapes import DECORATED, Mesh, Profile, Solid, join, lathe
from vap_core.sim.textures import BASE, INK
from vap_core.values import value


def _walls(inner: Profile, thick: float, deep: float = 1.0, power: float = 2.0, n: int = 12) -> list[Solid]:
    """n boards, `thick` metres, whose inner faces touch the two rings (radius, z) of `inner` from outside.

    Rings are superellipses with half-widths (radius, deep * radius); the boards meet at the corners of that polygon at its upper end.
    """
    (r0, z0), (r1, z1) = ((0.985 * r, z) for r, z in inner)
    around = 2 * np.pi * np.arange(n) / n
    dual = power / (power - 1)
    reach = (np.abs(np.cos(around)) ** dual + np.abs(deep * np.sin(around)) ** dual) ** (1 / dual)
    outer = max(r0, r1) * reach + thick / 2
    step = 2 * np.pi / n
    left = (np.roll(outer, -1) - outer * np.cos(step)) / np.sin(step)
    right = -(np.roll(outer, 1) - outer * np.cos(step)) / np.sin(step)
    boards = []
    for a, u, lo, hi in zip(around, reach, right, left, strict=True):
        lean = np.arctan2((r1 - r0) * u, z1 - z0)
        r, z = (r0 + r1) / 2 * u + np.cos(lean) * thick / 2, (z0 + z1) / 2 - np.sin(lean) * thick / 2
        side = (lo + hi) / 2
        pos = r * np.cos(a) - side * np.sin(a), r * np.sin(a) + side * np.cos(a), z
        half = thick / 2, (hi - lo) / 2, np.hypot((r1 - r0) * u, z1 - z0) / 2
        boards.append(Solid("box", (float(half[0]), float(half[1]), float(half[2])), (float(pos[0]), float(pos[1]), float(pos[2])),
                            turn=(0, float(lean), float(a))))  # fmt: skip
    return boards


def _floor(radius: float, top: float, deep: float = 1.0, power: float = 2.0) -> list[Solid]:
    """A floor from z = 0 to `top`: an oblong that stands on the table, and two narrower ones half a millimetre above it."""
    even, far = 0.5 ** (1 / power), 0.95
    near = (1 - far**power) ** (1 / power)
    sides = [(even, even, 0.0), (far, near, 0.0005), (near, far, 0.0005)]
    return [Solid("box", (a * radius, b * deep * radius, (top - low) / 2), (0, 0, (top + low) / 2)) for a, b, low in sides]


@value
class Dish:
    """A round plate or bowl: its wall rises from a flat floor, `belly` metres wider than straight at half its height."""

    radius: float = 0.075
    height: float = 0.012
    floor: float = 0.050
    thick: float = 0.004
    belly: float = 0.0
    painted: Literal["inside", "outside"] = "inside"

    def inside(self) -> Profile:
        """(radius, z) of the inner face, floor to rim."""
        rows = np.linspace(0, 1, 6 if self.belly else 2)
        lip, rise = self.radius - self.thick, self.height - self.thick
        return [(float(self.floor + (lip - self.floor) * t + self.belly * np.sin(np.pi * t)), float(self.thick + rise * t)) for t in rows]

    def mesh(self) -> Mesh:
        n, wall, rim = 36, self.inside(), self.radius
        foot = self.floor + 0.3 * self.thick
        outer = [(r + self.thick, z - (0.6 if z < 0.5 * self.height else 0.4) * self.thick) for r, z in wall[1:-1]]
        top = self.height - 0.5 * self.thick
        inner, outside = (DECORATED, BASE) if self.painted == "inside" else (BASE, DECORATED)
        return join([
            lathe([(0, 0), (foot, 0)], BASE, n),
            lathe([(foot, 0), *outer, (rim, top)], outside, n),
            lathe([(rim, top), (rim - 0.2 * self.thick, self.height), (rim - self.thick, self.height)], INK, n),
            lathe(wall[::-1], inner, n),
            lathe([(self.floor, self.thick), (0, self.thick)], BASE, n),
        ])  # fmt: skip

    def solids(self) -> tuple[Solid, ...]:
        wall = self.inside()
        knots = [wall[0], wall[len(wall) // 3], wall[-1]] if self.belly else wall
        boards = [board for pair in pairwise(knots) for board in _walls(list(pair), 0.8 * self.thick)]
        return *_floor(self.floor, self.thick), *boards

    def aspect(self) -> float:
        lip = self.radius - self.thick
        return float(np.pi * (lip + self.floor) / np.hypot(lip - self.floor, self.height))


@value
class Basket:
    """A woven tray with a rolled rim: half-sizes at its rim; `flare` is how much narrower it stands; `power` squares its corners."""

    half: tuple[float, float] = (0.075, 0.060)
    height: float = 0.048
    flare: float = 0.008
    wall: float = 0.005
    floor: float = 0.004
    power: float = 6.0

    def mesh(self) -> Mesh:
        n, h, w = 48, self.height, self.wall
        rim = 0.7 * w
        low = self.half[0] - self.flare
        cross = (1, self.half[1] / self.half[0], self.power)
        turns = np.linspace(-0.35 * np.pi, 1.35 * np.pi, 7)
        edge = self.half[0] - 1.3 * rim + w / 4
        inside = edge - w / 2
        return join([
            lathe([(0, 0), (low, 0)], BASE, n, cross),
            lathe([(low, 0), (edge, h - rim)], DECORATED, n, cross),
            lathe([(edge - w / 4 + 1.3 * rim * float(np.cos(t)), h - rim + rim * float(np.sin(t))) for t in turns], INK, n, cross),
            lathe([(inside, h - rim), (low - w, self.floor)], DECORATED, n, cross),
            lathe([(low - w, self.floor), (0, self.floor)], DECORATED, n, cross),
        ])  # fmt: skip

    def solids(self) -> tuple[Solid, ...]:
        low = self.half[0] - self.flare - self.wall
        deep = self.half[1] / self.half[0]
        inner = [(low, self.floor), (self.half[0] - 1.5 * self.wall, self.height)]
        return *_floor(low, self.floor, deep, self.power), *_walls(inner, self.wall, deep, self.power)

    def aspect(self) -> float:
        return 3.7 * (self.half[0] + self.half[1]) / self.height
