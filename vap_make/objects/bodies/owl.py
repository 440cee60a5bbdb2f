"""Owl figurines. Lengths are metres; the face looks towards -y."""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.turned import ellipsoid, lathe, smooth_profile
from vap_make.objects.shapes import (
    SIDES,
    Mesh,
    Number,
    Solid,
    foot_box,
    join_meshes,
    rotation_matrix,
    upright_cylinder,
)
from vap_make.objects.textures import ACCENT, BASE, DARK, DECORATED, INK, LIGHT, WARM


@value
class Owl:
    """A sitting owl: `belly` is its largest radius, `eye` that of its eyes."""

    height: float = 0.078
    belly: float = 0.0215
    ears: Literal["tuft", "wide", "none"] = "tuft"
    eye: float = 0.0072
    wings: Literal["folded", "spread"] = "folded"

    def _head_share(self) -> float:
        """Share of the height below the ears."""
        if self.ears == "none":
            return 1.0
        return 0.91

    def mesh(self) -> Mesh:
        h, r, f = self.height, self.belly, self._head_share()
        wall = smooth_profile([(0.8 * r, 0), (r, 0.3 * h * f), (0.88 * r, 0.6 * h * f)], 6)
        head = smooth_profile(
            [(0.88 * r, 0.6 * h * f), (0.93 * r, 0.74 * h * f), (0.62 * r, 0.93 * h * f)], 5
        )
        eye_y, eye_z = -0.76 * r, 0.755 * h * f
        parts = [
            lathe([(0, 0), (0.8 * r, 0)], BASE, 20),
            lathe(wall, DECORATED),
            lathe(head, INK),
            lathe([head[-1], (0.3 * r, 0.985 * h * f), (0, h * f)], INK),
        ]
        for side in SIDES:
            parts += self._eye(side, eye_y, eye_z)
            foot = ellipsoid((0.0055, 0.0055, 0.003), WARM, segments=8, rows=4)
            parts.append(foot.moved((0.42 * side * r, -0.8 * r, 0.003)))
            parts.append(self._wing(side))
            if self.ears != "none":
                parts.append(self._ear(side))
        beak = lathe([(0.0042, 0), (0, 0.009)], WARM, 8)
        parts.append(beak.moved((0, eye_y - 0.001, eye_z - 0.004), rotation_matrix(x=2.2)))
        return join_meshes(parts)

    def _eye(self, side: int, y: Number, z: Number) -> list[Mesh]:
        """Ring, white and pupil."""
        x, outward = side * 0.37 * self.belly, rotation_matrix(z=0.4 * side)
        ring = ellipsoid((1.28 * self.eye, 0.004, 1.28 * self.eye), ACCENT, segments=14, rows=4)
        white = ellipsoid((self.eye, 0.004, self.eye), LIGHT, segments=14, rows=4)
        pupil = ellipsoid((0.5 * self.eye, 0.003, 0.5 * self.eye), DARK, segments=10, rows=4)
        return [
            ring.moved((x, y + 0.0012, z), outward),
            white.moved((x, y - 0.0008, z), outward),
            pupil.moved((x + 0.0013 * side, y - 0.0031, z), outward),
        ]

    def _wing(self, side: int) -> Mesh:
        lean = 0.3
        if self.wings == "folded":
            lean = 0.12
        wing = ellipsoid((0.0036, 0.0115, 0.26 * self.height), INK, segments=10, rows=6)
        place = (side * 0.87 * self.belly, 0.002, 0.36 * self.height)
        return wing.moved(place, rotation_matrix(y=-side * lean))

    def _ear(self, side: int) -> Mesh:
        lean, width = 0.5, 0.0085
        if self.ears == "tuft":
            lean, width = 0.22, 0.0058
        cone = lathe([(width, 0), (0, 0.17 * self.height)], INK, 8)
        place = (side * 0.45 * self.belly, 0, 0.86 * self.height)
        return cone.moved(place, rotation_matrix(y=side * lean))

    def solids(self) -> tuple[Solid, ...]:
        h, r = self.height, self.belly
        return (
            foot_box(0.8 * r),
            upright_cylinder(0.9 * r, 0.001, 0.15 * h),
            upright_cylinder(0.97 * r, 0.15 * h, 0.5 * h),
            upright_cylinder(0.87 * r, 0.5 * h, 0.86 * h),
        )

    def aspect(self) -> float:
        return 2 * np.pi * 0.93 * self.belly / (0.57 * self.height)
