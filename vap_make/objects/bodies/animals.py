"""Parts placed on the front (-y) of an ellipsoid, as eyes and noses of animals are."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from vap_core.base.types import value
from vap_make.objects.bodies.parts import (
    Profile,
    capsules_along,
    ellipsoid,
    flat_disc,
    interpolate_knots,
    lathe,
    smooth_profile,
    stacked_rings,
    tube,
)
from vap_make.objects.shapes import (
    SIDES,
    Mesh,
    Number,
    Solid,
    Vector,
    foot_box,
    join_meshes,
    rotation_matrix,
    upright_cylinder,
)
from vap_make.objects.textures import ACCENT, BASE, DARK, DECORATED, INK, LIGHT, WARM


@value
class EllipsoidFront:
    """The front half of an ellipsoid: its half-axes and its centre, metres."""

    half: Vector
    centre: Vector

    def place(self, x: Number, z: Number, raised: Number = 0) -> tuple[np.ndarray, np.ndarray]:
        """The surface point at (x, z) from the centre, and the rotation of -y to its normal.

        The point is raised by `raised` metres.
        """
        half = self.half
        y = -half[1] * np.sqrt(max(0.0, 1 - (x / half[0]) ** 2 - (z / half[2]) ** 2))
        outward = np.array([x, y, z]) / np.array(half, np.float64) ** 2
        outward /= np.linalg.norm(outward)
        point = np.array([x, y, z]) + np.array(self.centre) + raised * outward
        facing = rotation_matrix(x=-np.arcsin(outward[2]), z=np.arctan2(outward[0], -outward[1]))
        return point, facing

    def lens(
        self,
        x: Number,
        z: Number,
        size: Vector,
        swatch: int,
        raised: Number = 0,
        segments: int = 10,
    ) -> Mesh:
        """An ellipsoid (half-width, half-thickness, half-height) on the surface."""
        point, facing = self.place(x, z, raised)
        return ellipsoid(size, swatch, segments, rows=4).moved(point, facing)


TAIL_RADIUS = 0.0042
ROUND_EAR = ((1, 0), (0.9, 0.4), (0.58, 0.78), (0, 1))
"""(share of the half-width, share of the height)."""


@value
class Cat:
    """A cat that sits on its haunches, about half as wide as tall."""

    height: float = 0.076
    girth: float = 0.0185
    ears: Literal["round", "pointed", "folded"] = "round"
    tail: Literal["curl", "up", "wrap"] = "curl"
    face: Literal["plain", "muzzle", "mask"] = "plain"
    collar: bool = False

    def _head(self) -> EllipsoidFront:
        h = self.height
        return EllipsoidFront(
            half=(0.225 * h, 0.19 * h, 0.18 * h), centre=(0.0, -0.0045, 0.715 * h)
        )

    def mesh(self) -> Mesh:
        head = self._head()
        parts = [*self._torso(), ellipsoid(head.half, BASE, 12, rows=6).moved(head.centre)]
        for side in SIDES:
            parts += self._legs(side)
            parts += self._ear(side)
            parts += self._eye(side)
            parts += self._whiskers(side)
        parts += self._muzzle()
        if self.collar:
            parts += self._collar()
        parts.append(tube(self._tail_path(), TAIL_RADIUS, BASE, sides=5))
        return join_meshes(parts)

    def _torso(self) -> list[Mesh]:
        h, w = self.height, self.girth
        knots = [
            (0, 0.002, 0.92 * w, 1.0 * w),
            (0.16 * h, 0.002, w, 1.05 * w),
            (0.36 * h, 0, 0.82 * w, 0.82 * w),
            (0.60 * h, -0.002, 0.55 * w, 0.5 * w),
        ]
        return [
            stacked_rings(interpolate_knots(knots, 7), DECORATED, 15),
            flat_disc((0, 0.002, 0), (0.92 * w, w), BASE, 10),
        ]

    def _legs(self, side: int) -> list[Mesh]:
        """Haunch, front leg and paw."""
        h, w = self.height, self.girth
        haunch = ellipsoid((0.42 * w, 0.62 * w, 0.17 * h), BASE, segments=8, rows=4)
        leg = ellipsoid((0.27 * w, 0.27 * w, 0.21 * h), BASE, segments=6, rows=4)
        paw = ellipsoid((0.33 * w, 0.42 * w, 0.055 * h), BASE, segments=7, rows=3)
        return [
            haunch.moved((side * 0.8 * w, 0.0035, 0.17 * h)),
            leg.moved((side * 0.36 * w, -0.74 * w, 0.23 * h)),
            paw.moved((side * 0.38 * w, -0.98 * w, 0.055 * h)),
        ]

    def _eye(self, side: int) -> list[Mesh]:
        h, head = self.height, self._head()
        z = 0.12 * head.half[2]
        iris = head.lens(
            x=0.38 * side * head.half[0],
            z=z,
            size=(0.054 * h, 0.0016, 0.048 * h),
            swatch=ACCENT,
            segments=9,
        )
        pupil = head.lens(
            x=0.36 * side * head.half[0],
            z=z,
            size=(0.018 * h, 0.0012, 0.042 * h),
            swatch=DARK,
            raised=0.0010,
            segments=5,
        )
        return [iris, pupil]

    def _whiskers(self, side: int) -> list[Mesh]:
        h, head = self.height, self._head()
        parts = []
        for dz in (-0.5, -0.22):
            root, _ = head.place(0.42 * side * head.half[0], -0.42 * head.half[2])
            rise = (0.05 * (dz + 0.36) / 0.14 - 0.02) * h
            tip = root + np.array([side * 0.2 * h, 0.0005, rise])
            parts.append(tube(np.stack([root, tip]), 0.00055, LIGHT, sides=3))
        return parts

    def _muzzle(self) -> list[Mesh]:
        h, head = self.height, self._head()
        parts = []
        nose_swatch = INK
        if self.face != "plain":
            nose_swatch = DARK
            cheek_swatch = LIGHT
            if self.face == "muzzle":
                cheek_swatch = INK
            for side in SIDES:
                cheek = head.lens(
                    x=side * 0.17 * head.half[0],
                    z=-0.42 * head.half[2],
                    size=(0.07 * h, 0.0035, 0.055 * h),
                    swatch=cheek_swatch,
                    segments=8,
                )
                parts.append(cheek)
        nose = head.lens(
            x=0,
            z=-0.2 * head.half[2],
            size=(0.032 * h, 0.003, 0.022 * h),
            swatch=nose_swatch,
            raised=0.002,
            segments=6,
        )
        return [*parts, nose]

    def _collar(self) -> list[Mesh]:
        h, w = self.height, self.girth
        t = np.linspace(0, 2 * np.pi, 12)
        x, y = 0.62 * w * np.cos(t), 0.57 * w * np.sin(t) - 0.0018
        ring = np.stack([x, y, np.full_like(t, 0.565 * h)], 1)
        bell = ellipsoid((0.0032, 0.0026, 0.0032), LIGHT, segments=8, rows=4)
        return [
            tube(ring, 0.0019, ACCENT, sides=4, capped=False),
            bell.moved((0, -0.78 * w, 0.53 * h)),
        ]

    def _ear(self, side: int) -> list[Mesh]:
        h, head = self.height, self._head()
        x = side * 0.62 * head.half[0]
        y = head.centre[1] - 0.0005
        z = head.centre[2] + 0.62 * head.half[2]
        lean = rotation_matrix(y=0.32 * side)
        match self.ears:
            case "round":
                outer: Profile = []
                inner: Profile = []
                for share, up in ROUND_EAR:
                    outer.append((share, 0.165 * h * up))
                    inner.append((share, 0.11 * h * up))
                shell = lathe(outer, BASE, 8, section=(0.088 * h, 0.006, 2))
                lining = lathe(inner, INK, 6, section=(0.054 * h, 0.004, 2))
                return [
                    shell.moved((x, y, z - 0.02 * h), lean),
                    lining.moved((x, y - 0.0036, z + 0.005 * h), lean),
                ]
            case "pointed":
                shell = lathe([(1, 0), (0, 0.175 * h)], BASE, 8, section=(0.08 * h, 0.006, 2))
                lining = lathe([(1, 0), (0, 0.12 * h)], INK, 8, section=(0.05 * h, 0.0035, 2))
                return [
                    shell.moved((x, y, z - 0.01 * h), lean),
                    lining.moved((x, y - 0.0037, z + 0.02 * h), lean),
                ]
            case "folded":
                flap = ellipsoid((0.07 * h, 0.007, 0.04 * h), INK, segments=8, rows=4)
                place = (1.1 * x, y - 0.004, z + 0.01 * h)
                return [flap.moved(place, rotation_matrix(y=0.7 * side))]

    def _tail_path(self) -> Float[np.ndarray, "k 3"]:
        h, w = self.height, self.girth
        t = np.linspace(0.0, 1.0, 10)
        match self.tail:
            case "curl":
                x = w * (0.45 + 1.15 * np.sin(2.2 * t)) - 0.006 * t**3
                y = 0.9 * w - 0.3 * w * t
                z = 0.0045 + 0.62 * h * t**1.3 - 0.14 * h * np.maximum(0, t - 0.75) * 4 * t
            case "up":
                x = 0.3 * w * np.sin(2 * np.pi * t)
                y = w * (0.8 + 0.7 * np.sin(2.0 * t))
                z = 0.006 + 0.7 * h * t
            case "wrap":
                x = 1.28 * w * np.cos(2.9 * t - 1.45)
                y = 1.2 * w * np.sin(1.45 - 2.9 * t) - 0.002
                z = np.full_like(t, 0.0046)
        return np.stack([x, y, z], 1)

    def solids(self) -> tuple[Solid, ...]:
        h, w = self.height, self.girth
        head = self._head()
        legs, paws, ears = [], [], []
        leg, paw = (0.27 * w, 0.27 * w, 0.21 * h), (0.33 * w, 0.42 * w, 0.055 * h)
        ear_y, ear_z = head.centre[1], head.centre[2] + 0.85 * head.half[2]
        for side in SIDES:
            legs.append(Solid("ellipsoid", leg, (side * 0.36 * w, -0.74 * w, 0.23 * h)))
            paws.append(Solid("ellipsoid", paw, (side * 0.38 * w, -0.98 * w, 0.055 * h)))
            ears.append(
                Solid(
                    kind="ellipsoid",
                    size=(0.07 * h, 0.0045, 0.09 * h),
                    pos=(side * 0.64 * head.half[0], ear_y, ear_z),
                    euler=(0, 0.32 * side, 0),
                )
            )
        return (
            Solid("box", (0.8 * w, 0.78 * w, 0.003), (0, 0.001, 0.003)),
            Solid("ellipsoid", (1.12 * w, 1.05 * w, 0.2 * h), (0, 0.002, 0.2 * h)),
            Solid("ellipsoid", (0.72 * w, 0.8 * w, 0.31 * h), (0, -0.002, 0.35 * h)),
            *legs,
            *paws,
            Solid("ellipsoid", head.half, head.centre),
            *capsules_along(self._tail_path()[1:], TAIL_RADIUS, 3),
            *ears,
        )

    def aspect(self) -> float:
        return 2 * np.pi * 0.85 * self.girth / (0.6 * self.height)


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
