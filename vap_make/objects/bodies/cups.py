"""Ceramic cups with a handle. Lengths are metres; the handle points along +x."""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.parts import arc_profile, handle_bar, lathe, tube
from vap_make.objects.shapes import (
    Mesh,
    Number,
    Solid,
    foot_box,
    join_meshes,
    stacked_cylinders,
    upright_cylinder,
)
from vap_make.objects.textures import (
    ACCENT,
    BASE,
    DARK,
    DECORATED,
    INK,
    LIGHT,
    METAL,
    SWATCHES,
    WARM,
)


def hollow_vessel(
    low: Number,
    high: Number,
    height: Number,
    wall: Number,
    depth: Number,
    rim: int,
    inside: int,
    segments: int = 24,
) -> list[Mesh]:
    """Base, decorated outer wall, rim and inner wall of a vessel.

    `low` and `high` are radii at its base and rim; `rim` and `inside` are swatches.
    """
    edge = min(0.0025, 0.1 * low)
    floor = height - depth
    return [
        lathe([(0, 0), (low - edge, 0)], BASE, segments),
        lathe([(low - edge, 0), (low, edge)], BASE, segments),
        lathe([(low, edge), (high, height)], DECORATED, segments),
        lathe(
            [(high, height), (high - wall / 2, height + wall / 2), (high - wall, height)],
            rim,
            segments,
        ),
        lathe([(high - wall, height), (low - wall, floor)], inside, segments),
        lathe([(low - wall, floor), (0, floor)], inside, segments),
    ]


@value
class Cup:
    """A cup: `low` and `high` are its radii at base and rim, `reach` how far the handle goes."""

    low: float = 0.0195
    high: float = 0.0215
    height: float = 0.072
    grip: Literal["round", "square", "ear"] = "round"
    reach: float = 0.017
    rim: Literal["base", "ink", "accent"] = "base"

    def mesh(self) -> Mesh:
        rim = SWATCHES[self.rim]
        vessel = hollow_vessel(
            low=self.low,
            high=self.high,
            height=self.height - 0.0012,
            wall=0.0024,
            depth=0.8 * self.height,
            rim=rim,
            inside=LIGHT,
            segments=28,
        )
        bar = handle_bar(
            kind=self.grip,
            radius=(self.low + self.high) / 2,
            low=0.24 * self.height,
            high=0.8 * self.height,
            reach=self.reach,
            thickness=0.0033,
            swatch=rim,
        )
        return join_meshes([*vessel, bar])

    def solids(self) -> tuple[Solid, ...]:
        radius = (self.low + self.high) / 2
        handle = Solid(
            kind="box",
            size=(self.reach / 2, 0.003, 0.26 * self.height),
            pos=(radius + self.reach / 2, 0, 0.52 * self.height),
        )
        return foot_box(self.low), upright_cylinder(radius, 0.001, self.height), handle

    def aspect(self) -> float:
        return np.pi * (self.low + self.high) / self.height


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


PEN_SWATCHES = (WARM, ACCENT, DARK, INK, METAL)
NIB_SWATCHES = (DARK, LIGHT)
ROUND = 24
"""As many sides as its wall has segments: not pressed flat."""


def _press_into_prism(part: Mesh, sides: int, half: Number) -> Mesh:
    """A round part pressed into a regular polygon, `half` metres from its axis to each side.

    One side faces -y.
    """
    reach = np.hypot(part.vertex[:, 0], part.vertex[:, 1])
    angle = np.arctan2(part.vertex[:, 1], part.vertex[:, 0])
    step = 2 * np.pi / sides
    side = np.round((angle + np.pi / 2) / step) * step - np.pi / 2
    scale = half / np.maximum(reach.max(), 1e-9) / np.cos(angle - side)
    vertex = part.vertex * np.stack([scale, scale, np.ones_like(scale)], 1)
    level = np.hypot(part.normal[:, 0], part.normal[:, 1])
    sign = np.sign((part.normal[:, :2] * part.vertex[:, :2]).sum(1))
    of_side = np.stack([np.cos(side), np.sin(side)], 1)
    of_circle = np.stack([np.cos(angle), np.sin(angle)], 1)
    flat = 0.6 * of_side + 0.4 * of_circle
    normal = np.column_stack([flat * (level * sign)[:, None], part.normal[:, 2]])
    length = np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return Mesh(vertex=vertex, normal=normal / length, uv=part.uv, face=part.face)


@value
class PenHolder:
    """A round, square or hexagonal holder; `radius` goes to its wall or to its sides."""

    radius: float = 0.0205
    height: float = 0.080
    sides: Literal[4, 6, 24] = 24
    pens: int = 4
    rim: Literal["base", "ink", "accent"] = "accent"

    def _half(self) -> float:
        """From the axis to a side."""
        if self.sides == 4:
            return self.radius * 0.97
        return self.radius

    def mesh(self) -> Mesh:
        height = self.height
        parts = []
        for part in hollow_vessel(
            low=self.radius,
            high=self.radius,
            height=height - 0.0015,
            wall=0.003,
            depth=0.55 * height,
            rim=SWATCHES[self.rim],
            inside=DARK,
        ):
            if self.sides == ROUND:
                parts.append(part)
            else:
                parts.append(_press_into_prism(part, self.sides, self._half()))
        for i in range(self.pens):
            parts += self._pen(i)
        return join_meshes(parts)

    def _pen(self, i: int) -> list[Mesh]:
        """Pen number i, which leans outwards: its shaft and its nib."""
        angle = 2 * np.pi * i / self.pens + 0.7
        inner, outer = 0.35 * self.radius, 0.68 * self.radius
        foot = np.array([inner * np.cos(angle), inner * np.sin(angle), 0.5 * self.height])
        tip = np.array([outer * np.cos(angle), outer * np.sin(angle), 0.113 - 0.006 * (i % 3)])
        nib = tip + 0.09 * (tip - foot)
        return [
            tube(np.stack([foot, tip]), 0.0029, PEN_SWATCHES[i % 5]),
            tube(np.stack([tip, nib]), 0.0015, NIB_SWATCHES[i % 2], sides=5),
        ]

    def solids(self) -> tuple[Solid, ...]:
        half = self._half()
        if self.sides == 4:
            half_height = self.height / 2
            body = Solid("box", (half, half, half_height - 0.0005), (0, 0, half_height + 0.0005))
        else:
            body = upright_cylinder(half, 0.001, self.height)
        return foot_box(half), body, upright_cylinder(0.6 * half, self.height, 0.112)

    def aspect(self) -> float:
        return 2 * np.pi * self.radius / self.height
