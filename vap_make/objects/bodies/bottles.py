"""Bottles and vases. Lengths are metres."""

from itertools import pairwise
from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.parts import (
    Profile,
    arc_profile,
    closed_cylinder,
    ellipsoid,
    handle_bar,
    lathe,
    smooth_profile,
)
from vap_make.objects.shapes import (
    Mesh,
    Number,
    Solid,
    foot_box,
    join_meshes,
    rotation_matrix,
    stacked_cylinders,
    upright_cylinder,
)
from vap_make.objects.textures import ACCENT, BASE, DARK, DECORATED, INK


@value
class Bottle:
    """A bottle with a cap.

    `shoulder` is the share of the height where its wall ends, `neck` the radius there above,
    `waist` how much narrower the wall is in its middle.
    """

    radius: float = 0.020
    height: float = 0.115
    shoulder: float = 0.70
    neck: float = 0.0085
    cap: Literal["screw", "sport", "ball"] = "screw"
    waist: float = 0.0

    def mesh(self) -> Mesh:
        r, neck = self.radius, self.neck
        top, cap_z = self.shoulder * self.height, self.height - 0.018
        shoulder: Profile = [
            (r, top),
            (0.8 * r, top + 0.35 * (cap_z - top)),
            (neck, cap_z - 0.003),
            (neck, cap_z),
        ]
        return join_meshes(
            [
                lathe([(0, 0), (r - 0.002, 0)], BASE),
                lathe([(r - 0.002, 0), (r, 0.002)], BASE),
                lathe(self._wall(top), DECORATED),
                lathe(smooth_profile(shoulder, 6), BASE, 20),
                *self._cap(cap_z),
            ]
        )

    def _wall(self, top: Number) -> Profile:
        knots = 2
        if self.waist:
            knots = 7
        wall: Profile = []
        for t in np.linspace(0, 1, knots):
            radius = self.radius - self.waist * np.sin(np.pi * t) ** 2
            wall.append((radius, 0.002 + (top - 0.002) * t))
        return wall

    def _cap(self, z: Number) -> list[Mesh]:
        neck = self.neck
        match self.cap:
            case "screw":
                return [closed_cylinder(neck + 0.0025, 0.018, INK, 16).moved((0, 0, z))]
            case "sport":
                return [
                    closed_cylinder(neck + 0.005, 0.007, INK, 16).moved((0, 0, z)),
                    closed_cylinder(0.0045, 0.011, ACCENT, 12).moved((0, 0, z + 0.007)),
                ]
            case "ball":
                ball = ellipsoid((0.0105, 0.0105, 0.009), INK, 14)
                return [ball.moved((0, 0, self.height - 0.009))]

    def solids(self) -> tuple[Solid, ...]:
        top = self.shoulder * self.height + 0.004
        return (
            foot_box(self.radius),
            upright_cylinder(self.radius, 0.001, top),
            upright_cylinder(self.neck + 0.002, top, self.height),
        )

    def aspect(self) -> float:
        return 2 * np.pi * self.radius / (self.shoulder * self.height)


@value
class Vase:
    """A vase; `knots` are (radius, share of the height), base to lip."""

    height: float = 0.110
    knots: tuple[tuple[Number, Number], ...] = (
        (0.0155, 0.0),
        (0.0215, 0.5),
        (0.0195, 0.7),
        (0.0095, 0.88),
        (0.0135, 1.0),
    )
    handles: bool = False

    def mesh(self) -> Mesh:
        outline: Profile = []
        for radius, share in self.knots:
            outline.append((radius, self.height * share))
        wall = smooth_profile(outline, 14)
        low, lip = self.knots[0][0], self.knots[-1][0]
        inside: Profile = [
            (lip - 0.002, self.height),
            (0.7 * lip, 0.9 * self.height),
            (0, 0.88 * self.height),
        ]
        parts = [
            lathe([(0, 0), (low, 0)], BASE, 22),
            lathe(wall, DECORATED, 22),
            lathe([wall[-1], (lip - 0.002, self.height)], ACCENT, 22),
            lathe(inside, DARK, 22),
        ]
        if self.handles:
            bar = handle_bar(
                kind="round",
                radius=0.0105,
                low=0.72 * self.height,
                high=0.93 * self.height,
                reach=0.0125,
                thickness=0.0022,
                swatch=ACCENT,
            )
            parts += [bar, bar.moved(rotation=rotation_matrix(z=np.pi))]
        return join_meshes(parts)

    def solids(self) -> tuple[Solid, ...]:
        radius, share = np.array(self.knots).T
        cuts = np.array([0.009, 0.25, 0.45, 0.6, 0.75, 0.87, 1.0])
        radii = np.interp((cuts[1:] + cuts[:-1]) / 2, share, radius)
        return foot_box(self.knots[0][0]), *stacked_cylinders(radii, cuts * self.height)

    def aspect(self) -> float:
        return 2 * np.pi * 0.017 / (1.03 * self.height)


BOARDS = 12
"""Boxes around a wall."""


def _wall_boards(
    lower: tuple[Number, Number],
    upper: tuple[Number, Number],
    thickness: Number,
    ratio: Number = 1.0,
    power: Number = 2.0,
) -> list[Solid]:
    """Boxes whose inner faces touch two rings (radius, z) from outside.

    Rings are superellipses with half-widths (radius, ratio * radius); the boards meet at the
    corners of that polygon at its wider end.
    """
    r0, z0 = 0.985 * lower[0], lower[1]
    r1, z1 = 0.985 * upper[0], upper[1]
    around = 2 * np.pi * np.arange(BOARDS) / BOARDS
    dual = power / (power - 1)
    reach = (np.abs(np.cos(around)) ** dual + np.abs(ratio * np.sin(around)) ** dual) ** (1 / dual)
    outer = max(r0, r1) * reach + thickness / 2
    step = 2 * np.pi / BOARDS
    left = (np.roll(outer, -1) - outer * np.cos(step)) / np.sin(step)
    right = -(np.roll(outer, 1) - outer * np.cos(step)) / np.sin(step)
    boards = []
    for angle, u, start, stop in zip(around, reach, right, left, strict=True):
        lean = np.arctan2((r1 - r0) * u, z1 - z0)
        radius = (r0 + r1) / 2 * u + np.cos(lean) * thickness / 2
        z = (z0 + z1) / 2 - np.sin(lean) * thickness / 2
        side = (start + stop) / 2
        x = radius * np.cos(angle) - side * np.sin(angle)
        y = radius * np.sin(angle) + side * np.cos(angle)
        half_width = (stop - start) / 2
        half_height = np.hypot((r1 - r0) * u, z1 - z0) / 2
        boards.append(
            Solid(
                kind="box",
                size=(float(thickness / 2), float(half_width), float(half_height)),
                pos=(float(x), float(y), float(z)),
                euler=(0, float(lean), float(angle)),
            )
        )
    return boards


def _floor_boxes(
    radius: Number, top: Number, ratio: Number = 1.0, power: Number = 2.0
) -> list[Solid]:
    """A floor from z = 0 to `top` inside a superellipse.

    One box stands on the table, two narrower ones are half a millimetre above it.
    """
    even, far = 0.5 ** (1 / power), 0.95
    near = (1 - far**power) ** (1 / power)
    boxes = []
    for share_x, share_y, low in ((even, even, 0.0), (far, near, 0.0005), (near, far, 0.0005)):
        half = (share_x * radius, share_y * ratio * radius, (top - low) / 2)
        boxes.append(Solid("box", half, (0, 0, (top + low) / 2)))
    return boxes


@value
class Dish:
    """A round plate or bowl whose wall rises from a flat floor.

    At half its height the wall is `belly` metres wider than a straight one.
    """

    radius: float = 0.075
    height: float = 0.012
    floor: float = 0.050
    thick: float = 0.004
    belly: float = 0.0
    painted: Literal["inside", "outside"] = "inside"

    def _inner_wall(self) -> Profile:
        """(radius, z) of the inner face, floor to rim."""
        knots = 2
        if self.belly:
            knots = 6
        lip, rise = self.radius - self.thick, self.height - self.thick
        wall: Profile = []
        for t in np.linspace(0, 1, knots):
            radius = self.floor + (lip - self.floor) * t + self.belly * np.sin(np.pi * t)
            wall.append((float(radius), float(self.thick + rise * t)))
        return wall

    def _outer_wall(self) -> Profile:
        """(radius, z) of the outer face between the foot and the rim."""
        wall: Profile = []
        for radius, z in self._inner_wall()[1:-1]:
            drop = 0.4
            if z < 0.5 * self.height:
                drop = 0.6
            wall.append((radius + self.thick, z - drop * self.thick))
        return wall

    def mesh(self) -> Mesh:
        segments, rim = 36, self.radius
        foot = self.floor + 0.3 * self.thick
        top = self.height - 0.5 * self.thick
        inside, outside = DECORATED, BASE
        if self.painted == "outside":
            inside, outside = BASE, DECORATED
        lip: Profile = [
            (rim, top),
            (rim - 0.2 * self.thick, self.height),
            (rim - self.thick, self.height),
        ]
        return join_meshes(
            [
                lathe([(0, 0), (foot, 0)], BASE, segments),
                lathe([(foot, 0), *self._outer_wall(), (rim, top)], outside, segments),
                lathe(lip, INK, segments),
                lathe(self._inner_wall()[::-1], inside, segments),
                lathe([(self.floor, self.thick), (0, self.thick)], BASE, segments),
            ]
        )

    def solids(self) -> tuple[Solid, ...]:
        wall = self._inner_wall()
        if self.belly:
            wall = [wall[0], wall[len(wall) // 3], wall[-1]]
        boards: list[Solid] = []
        for lower, upper in pairwise(wall):
            boards += _wall_boards(lower, upper, 0.8 * self.thick)
        return *_floor_boxes(self.floor, self.thick), *boards

    def aspect(self) -> float:
        lip = self.radius - self.thick
        return float(np.pi * (lip + self.floor) / np.hypot(lip - self.floor, self.height))


@value
class Basket:
    """A woven tray with a rolled rim.

    `half` are its half-sizes at the rim; at its foot it is narrower by `flare`. A higher `power`
    makes its corners sharper.
    """

    half: tuple[float, float] = (0.075, 0.060)
    height: float = 0.048
    flare: float = 0.008
    wall: float = 0.005
    floor: float = 0.004
    power: float = 6.0

    def mesh(self) -> Mesh:
        segments, height, wall = 48, self.height, self.wall
        rim = 0.7 * wall
        low = self.half[0] - self.flare
        section = (1, self.half[1] / self.half[0], self.power)
        edge = self.half[0] - 1.3 * rim + wall / 4
        inside = edge - wall / 2
        rim_angles = np.linspace(-0.35 * np.pi, 1.35 * np.pi, 7)
        roll = arc_profile((edge - wall / 4, height - rim), (1.3 * rim, rim), rim_angles)
        floor = self.floor
        return join_meshes(
            [
                lathe([(0, 0), (low, 0)], BASE, segments, section),
                lathe([(low, 0), (edge, height - rim)], DECORATED, segments, section),
                lathe(roll, INK, segments, section),
                lathe([(inside, height - rim), (low - wall, floor)], DECORATED, segments, section),
                lathe([(low - wall, floor), (0, floor)], DECORATED, segments, section),
            ]
        )

    def solids(self) -> tuple[Solid, ...]:
        low = self.half[0] - self.flare - self.wall
        ratio = self.half[1] / self.half[0]
        boards = _wall_boards(
            lower=(low, self.floor),
            upper=(self.half[0] - 1.5 * self.wall, self.height),
            thickness=self.wall,
            ratio=ratio,
            power=self.power,
        )
        return *_floor_boxes(low, self.floor, ratio, self.power), *boards

    def aspect(self) -> float:
        return 3.7 * (self.half[0] + self.half[1]) / self.height
