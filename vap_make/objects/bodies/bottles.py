"""Bottles and vases. Lengths are metres."""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.turned import (
    Profile,
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
