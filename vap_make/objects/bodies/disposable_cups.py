"""Disposable cups: straw cups with a lid and paper cups with a sleeve. Lengths are metres."""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.turned import arc_profile, lathe, tube
from vap_make.objects.shapes import (
    Mesh,
    Number,
    Solid,
    foot_box,
    join_meshes,
    stacked_cylinders,
    upright_cylinder,
)
from vap_make.objects.textures import ACCENT, BASE, DECORATED, INK, LIGHT, SWATCHES

PAPER_SEGMENTS = 28


@value
class StrawCup:
    """A cup with a lid and a straw, which may bend; `low` and `high` are radii at base and rim."""

    low: float = 0.0165
    high: float = 0.0215
    height: float = 0.080
    lid: Literal["flat", "dome", "step"] = "flat"
    bend: bool = True

    def mesh(self) -> Mesh:
        height, lid_radius = self.height, self.high + 0.0015
        return join_meshes(
            [
                lathe([(0, 0), (self.low, 0)], BASE),
                lathe([(self.low, 0), (self.high, height)], DECORATED),
                lathe([(self.high, height - 0.001), (lid_radius, height - 0.001)], INK),
                *self._lid(),
                self._straw(),
            ]
        )

    def _lid(self) -> list[Mesh]:
        h, r = self.height, self.high + 0.0015
        match self.lid:
            case "flat":
                return [
                    lathe([(r, h - 0.001), (r, h + 0.006)], INK),
                    lathe([(r, h + 0.006), (0, h + 0.006)], INK),
                ]
            case "dome":
                dome = arc_profile((0.0, h + 0.003), (r, 0.014), np.linspace(0, np.pi / 2, 6))
                return [
                    lathe([(r, h - 0.001), (r, h + 0.003)], INK),
                    lathe(dome, LIGHT),
                ]
            case "step":
                return [
                    lathe([(r, h - 0.001), (r, h + 0.004)], INK),
                    lathe([(r, h + 0.004), (0.7 * r, h + 0.004)], INK),
                    lathe([(0.7 * r, h + 0.004), (0.66 * r, h + 0.011)], INK),
                    lathe([(0.66 * r, h + 0.011), (0, h + 0.011)], INK),
                ]

    def _straw(self) -> Mesh:
        path = [[0.001, 0, self.height]]
        if self.bend:
            path += [[0.003, 0, 0.108], [0.0145, 0, 0.1155]]
        else:
            path += [[0.004, 0, 0.119]]
        return tube(np.array(path), 0.0028, ACCENT, sides=7)

    def solids(self) -> tuple[Solid, ...]:
        low, middle = (2 * self.low + self.high) / 3, 0.45 * self.height
        return (
            foot_box(self.low),
            upright_cylinder(low, 0.001, middle),
            upright_cylinder(self.high - 0.0008, middle, self.height + 0.006),
            upright_cylinder(0.004, self.height + 0.006, 0.117),
        )

    def aspect(self) -> float:
        return np.pi * (self.low + self.high) / self.height


@value
class PaperCup:
    """A cup with a rolled rim, or a lid, and a decorated sleeve.

    `low` and `high` are radii at base and rim; `sleeve` are shares of the height.
    """

    low: float = 0.0180
    high: float = 0.0215
    height: float = 0.076
    sleeve: tuple[float, float] = (0.26, 0.70)
    rim: Literal["base", "ink", "accent", "light"] = "light"
    lid: bool = False

    def _wall_point(self, z: Number, raised: Number = 0.0) -> tuple[float, float]:
        """(radius, z) of the wall at that height, raised by `raised` metres."""
        return self.low + (self.high - self.low) * z / self.height + raised, z

    def mesh(self) -> Mesh:
        n, low, rim = PAPER_SEGMENTS, self.low, SWATCHES[self.rim]
        bottom, top = self.sleeve[0] * self.height, self.sleeve[1] * self.height
        if self.lid:
            wall_top = self.height - 0.009
            cover = self._lid(wall_top, rim)
        else:
            wall_top = self.height - 0.0016
            cover = self._open_rim(wall_top, rim)
        hem, edge = self._wall_point(bottom, 0.0008), self._wall_point(top, 0.0008)
        foot = [(0, 0.002), (low - 0.001, 0.002), (low - 0.001, 0), (low, 0)]
        return join_meshes(
            [
                lathe(foot, BASE, n),
                lathe([(low, 0), self._wall_point(wall_top)], BASE, n),
                lathe([self._wall_point(bottom), hem], INK, n),
                lathe([hem, edge], DECORATED, n),
                lathe([edge, self._wall_point(top)], INK, n),
                *cover,
            ]
        )

    def _lid(self, wall_top: Number, rim: int) -> list[Mesh]:
        n, r, step, h = PAPER_SEGMENTS, self.high + 0.001, wall_top + 0.004, self.height
        deck = [(0.86 * r, h), (0.78 * r, h), (0.74 * r, h - 0.002), (0, h - 0.002)]
        return [
            lathe([self._wall_point(wall_top), (r, wall_top), (r, step)], rim, n),
            lathe([(r, step), (0.9 * r, step)], rim, n),
            lathe([(0.9 * r, step), (0.86 * r, h)], rim, n),
            lathe(deck, rim, n),
        ]

    def _open_rim(self, wall_top: Number, rim: int) -> list[Mesh]:
        """The rolled rim, the inner wall and the drink's surface."""
        n, surface = PAPER_SEGMENTS, 0.45 * self.height
        angles = np.linspace(-0.5 * np.pi, 1.5 * np.pi, 7)
        roll = arc_profile((self.high, wall_top), (0.0016, 0.0016), angles)
        return [
            lathe(roll, rim, n),
            lathe([(self.high, wall_top), self._wall_point(surface)], LIGHT, n),
            lathe([self._wall_point(surface), (0, surface)], LIGHT, n),
        ]

    def solids(self) -> tuple[Solid, ...]:
        levels = np.linspace(0, self.height, 4)
        radii = self.low + (self.high - self.low) * (levels[1:] + levels[:-1]) / 2 / self.height
        levels[0] = 0.001
        return foot_box(self.low), *stacked_cylinders(radii, levels)

    def aspect(self) -> float:
        bottom, top = self.sleeve
        return np.pi * (self.low + self.high) / ((top - bottom) * self.height)
