"""Cameras, shavers and drink cans. Lengths are metres; fronts face -y."""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.parts import (
    Profile,
    closed_cylinder,
    ellipsoid,
    frustum,
    lathe,
    panel,
    rounded_block,
    sharp_box,
    tube,
)
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
from vap_make.objects.textures import (
    ACCENT,
    BASE,
    DARK,
    DECORATED,
    GLASS,
    INK,
    LIGHT,
    METAL,
    SWATCHES,
    WARM,
)

CAMERA_Y, CAMERA_HALF_DEPTH = 0.005, 0.0145
"""Where the middle of a camera's case is, and half the case's depth."""


@value
class CameraBody:
    """A photo camera: `lens` is its lens's radius, `bump` what stands on its top."""

    width: float = 0.068
    height: float = 0.054
    lens: float = 0.0165
    bump: Literal["prism", "finder", "flash", "none"] = "prism"
    strap: bool = False

    def mesh(self) -> Mesh:
        half_width, h, y = self.width / 2, self.height, CAMERA_Y
        button = closed_cylinder(0.0055, 0.005, METAL, 12, top=DARK)
        button_side = 1
        if self.bump == "flash":
            button_side = -1
        lamp = rounded_block((0.005, 0.0006), 0.005, WARM)
        parts = [
            self._case(),
            *self._lens(),
            *self._bump(),
            button.moved((0.68 * half_width * button_side, y, h)),
            lamp.moved((0.7 * half_width, y - CAMERA_HALF_DEPTH - 0.0004, 0.8 * h)),
        ]
        if self.strap:
            t = np.linspace(0, np.pi, 9)
            x, z = half_width * np.cos(t), 0.8 * h + 0.03 * np.sin(t)
            parts.append(tube(np.stack([x, np.full_like(t, y), z], 1), 0.0016, INK, sides=5))
        return join_meshes(parts)

    def _case(self) -> Mesh:
        h = self.height
        section, wall_top = (self.width / 2, CAMERA_HALF_DEPTH, 8.0), 0.74 * h
        case = join_meshes(
            [
                lathe([(0, 0), (1, 0)], BASE, 32, section),
                lathe([(1, 0), (1, wall_top)], DECORATED, 32, section, wraps=2),
                lathe([(1, wall_top), (1, h)], ACCENT, 32, section),
                lathe([(1, h), (0, h)], ACCENT, 32, section),
            ]
        )
        return case.moved((0, CAMERA_Y, 0))

    def _lens(self) -> list[Mesh]:
        forward, z = rotation_matrix(x=np.pi / 2), 0.45 * self.height
        front = CAMERA_Y - CAMERA_HALF_DEPTH
        barrel = join_meshes(
            [
                closed_cylinder(self.lens, 0.006, METAL, 20),
                closed_cylinder(0.86 * self.lens, 0.0105, DARK, 20),
            ]
        )
        half = (0.55 * self.lens, 0.55 * self.lens, 0.0012)
        glass = ellipsoid(half, GLASS, segments=14, rows=4)
        return [
            barrel.moved((0, front, z), forward),
            glass.moved((0, front - 0.0105, z), forward),
        ]

    def _bump(self) -> list[Mesh]:
        half_width, h, y = self.width / 2, self.height, CAMERA_Y
        match self.bump:
            case "prism":
                housing = rounded_block((0.013, 0.012), 0.011, ACCENT)
                window = rounded_block((0.009, 0.0006), 0.0055, DARK)
                return [housing.moved((0, y, h)), window.moved((0, y - 0.0122, h + 0.003))]
            case "finder":
                x = -0.6 * half_width
                housing = rounded_block((0.009, 0.010), 0.009, DARK)
                window = rounded_block((0.006, 0.0006), 0.005, LIGHT)
                return [housing.moved((x, y, h)), window.moved((x, y - 0.0103, h + 0.002))]
            case "flash":
                x = 0.42 * half_width
                housing = rounded_block((0.014, 0.006), 0.014, DARK)
                window = rounded_block((0.011, 0.0006), 0.008, LIGHT)
                return [housing.moved((x, y, h)), window.moved((x, y - 0.0064, h + 0.004))]
            case "none":
                return []

    def solids(self) -> tuple[Solid, ...]:
        h = self.height
        case = Solid("box", (self.width / 2, CAMERA_HALF_DEPTH, h / 2), (0, CAMERA_Y, h / 2))
        lens = Solid("cylinder", (self.lens, 0.006), (0, -0.0140, 0.45 * h), axis="y")
        return case, lens

    def aspect(self) -> float:
        return 2 * (self.width / 2 + CAMERA_HALF_DEPTH) / (0.74 * self.height)


@value
class Shaver:
    """An upright electric shaver; its wall is narrower by `waist` in its middle."""

    radius: float = 0.0185
    height: float = 0.112
    head: Literal["foil", "wide", "rotary"] = "foil"
    waist: float = 0.0025
    switch: Literal["round", "bar"] = "round"

    def mesh(self) -> Mesh:
        r, top = self.radius, 0.74 * self.height
        return join_meshes(
            [
                lathe([(0, 0), (r - 0.002, 0)], DARK),
                lathe([(r - 0.002, 0), (r, 0.002)], DARK),
                lathe(self._wall(top), DECORATED),
                lathe([(r, top), (0.7 * r, top + 0.006)], ACCENT),
                lathe([(0.7 * r, top + 0.006), (0.65 * r, top + 0.012)], DARK),
                *self._head(top + 0.012, self.height - top - 0.012),
                self._switch(),
            ]
        )

    def _wall(self, top: Number) -> Profile:
        wall: Profile = []
        for t in np.linspace(0, 1, 7):
            radius = self.radius - self.waist * float(np.sin(np.pi * t)) ** 2
            wall.append((radius, 0.002 + (top - 0.002) * float(t)))
        return wall

    def _head(self, z: Number, tall: Number) -> list[Mesh]:
        """The head from height z on, `tall` metres high."""
        if self.head == "rotary":
            return self._rotary_head(z, tall)
        half_width = 0.026
        if self.head == "foil":
            half_width = 0.020
        parts = [rounded_block((half_width, 0.0135), 0.55 * tall, ACCENT).moved((0, 0, z))]
        for y in (-0.0068, 0.0068):
            half = (half_width - 0.002, 0.0052, 0.45 * tall)
            foil = ellipsoid(half, METAL, segments=14, rows=6)
            parts.append(foil.moved((0, y, z + 0.55 * tall)))
        return parts

    def _rotary_head(self, z: Number, tall: Number) -> list[Mesh]:
        deck = z + 0.72 * tall
        parts = [
            lathe([(0.012, z), (0.022, z + 0.5 * tall), (0.021, deck)], ACCENT),
            lathe([(0.021, deck), (0, deck)], DARK),
        ]
        for angle in np.pi / 6 + 2 * np.pi / 3 * np.arange(3):
            cutter = closed_cylinder(0.0085, 0.28 * tall, METAL, 14)
            parts.append(cutter.moved((0.0105 * np.cos(angle), 0.0105 * np.sin(angle), deck)))
        return parts

    def _switch(self) -> Mesh:
        front = -self.radius + 0.6 * self.waist
        if self.switch == "round":
            button = ellipsoid((0.0062, 0.003, 0.0062), METAL, segments=12, rows=4)
            return button.moved((0, front, 0.52 * self.height))
        slider = rounded_block((0.0042, 0.002), 0.026, METAL)
        return slider.moved((0, front, 0.36 * self.height))

    def solids(self) -> tuple[Solid, ...]:
        top = 0.74 * self.height
        half_width = {"foil": 0.020, "wide": 0.026, "rotary": 0.021}[self.head]
        half_depth = 0.0125
        if self.head == "rotary":
            half_depth = 0.018
        half_height = (self.height - top - 0.012) / 2
        head_z = self.height - half_height
        return (
            foot_box(self.radius),
            upright_cylinder(self.radius - 0.5 * self.waist, 0.001, top + 0.012),
            Solid("box", (half_width, half_depth, half_height), (0, 0, head_z)),
        )

    def aspect(self) -> float:
        return 2 * np.pi * self.radius / (0.74 * self.height)


@value
class Can:
    """A drink can."""

    radius: float = 0.0215
    height: float = 0.082

    def mesh(self) -> Mesh:
        r, h, edge = self.radius, self.height, 0.005
        tab = rounded_block((0.004, 0.008), 0.0015, DARK)
        return join_meshes(
            [
                lathe([(0, 0), (0.8 * r, 0)], METAL),
                lathe([(0.8 * r, 0), (r, edge)], METAL),
                lathe([(r, edge), (r, h - 2 * edge)], DECORATED),
                lathe([(r, h - 2 * edge), (0.82 * r, h)], METAL),
                lathe([(0.82 * r, h), (0.77 * r, h - 0.002), (0, h - 0.002)], METAL),
                tab.moved((0, -0.003, h - 0.002)),
            ]
        )

    def solids(self) -> tuple[Solid, ...]:
        return foot_box(0.8 * self.radius), upright_cylinder(self.radius, 0.001, self.height)

    def aspect(self) -> float:
        return 2 * np.pi * self.radius / (self.height - 0.015)


CHASSIS_Z = 0.009
WHEEL_RADIUS = 0.0115
AXLES = (-0.58, 0.58)
"""Shares of half the length."""


@value
class Bus:
    """A toy bus on four wheels; `nose` is how far its bonnet stands out before the cabin."""

    long: float = 0.088
    wide: float = 0.040
    height: float = 0.064
    decks: int = 1
    nose: float = 0.0
    stripe: Literal["base", "ink", "accent", "dark", "light", "warm"] = "light"

    def _belt(self) -> float:
        """Height of the windows' lower edge."""
        if self.decks == 1:
            return 0.42 * self.height
        return 0.30 * self.height

    def mesh(self) -> Mesh:
        parts = [*self._body()]
        for deck in range(self.decks):
            parts += self._deck_windows(deck)
        return join_meshes([*parts, *self._headlights(), *self._wheels()])

    def _body(self) -> list[Mesh]:
        """Lower body, cabin, roof and bumper."""
        x, y, h, belt = self.long / 2, self.wide / 2, self.height, self._belt()
        half_cabin, cabin_x = x - self.nose / 2, -self.nose / 2
        cabin = frustum(
            low=(half_cabin, y),
            high=(half_cabin - 0.003, y - 0.002),
            bottom=belt,
            top=h - 0.004,
            swatch=BASE,
        )
        roof = frustum(
            low=(half_cabin - 0.003, y - 0.002),
            high=(half_cabin - 0.008, y - 0.007),
            bottom=h - 0.004,
            top=h,
            swatch=SWATCHES[self.stripe],
        )
        return [
            sharp_box((x, y), CHASSIS_Z, belt, DECORATED),
            cabin.moved((cabin_x, 0, 0)),
            roof.moved((cabin_x, 0, 0)),
            sharp_box((x + 0.0015, y + 0.001), CHASSIS_Z, CHASSIS_Z + 0.004, DARK),
        ]

    def _deck_windows(self, deck: int) -> list[Mesh]:
        """Windows of one deck: a row on either side, and the front and rear screens."""
        y, belt = self.wide / 2, self._belt()
        half_cabin, cabin_x = self.long / 2 - self.nose / 2, -self.nose / 2
        tall = (self.height - 0.004 - belt) / self.decks
        z = belt + (deck + 0.48) * tall
        count = 3
        if self.decks > 1 or self.nose == 0:
            count = 4
        pitch = (2 * half_cabin - 0.010) / count
        lean = rotation_matrix(x=-np.arctan2(0.002, self.height - belt))
        parts = []
        for yaw in (0.0, np.pi):
            for i in range(count):
                along = cabin_x * np.cos(yaw) + (i + 0.5 - count / 2) * pitch
                window = panel(0.78 * pitch, 0.62 * tall, GLASS, 0.0016)
                hung = window.moved((along, -y + 0.0005 + 0.001 * deck, z), lean)
                parts.append(hung.moved(rotation=rotation_matrix(z=yaw)))
        for yaw, out in ((np.pi / 2, half_cabin + cabin_x), (-np.pi / 2, half_cabin - cabin_x)):
            screen = panel(1.5 * y, 0.64 * tall, GLASS, 0.0026)
            hung = screen.moved((0, -out + 0.0006 + 0.001 * deck, z))
            parts.append(hung.moved(rotation=rotation_matrix(z=yaw)))
        return parts

    def _headlights(self) -> list[Mesh]:
        x, y = self.long / 2, self.wide / 2
        lamp = join_meshes(
            [panel(0.008, 0.007, METAL, 0.002), panel(0.006, 0.005, WARM, 0.003)],
        )
        lamps = []
        for side in SIDES:
            hung = lamp.moved((0.65 * side * y, -x, CHASSIS_Z + 0.009))
            lamps.append(hung.moved(rotation=rotation_matrix(z=np.pi / 2)))
        return lamps

    def _wheels(self) -> list[Mesh]:
        x, y = self.long / 2, self.wide / 2
        wheel = join_meshes(
            [
                closed_cylinder(WHEEL_RADIUS, 0.007, DARK, 16),
                closed_cylinder(0.0055, 0.0078, METAL, 10),
            ]
        )
        wheels = []
        for side in (1, -1):
            for axle in AXLES:
                place = (axle * x, -side * (y - 0.005), WHEEL_RADIUS)
                wheels.append(wheel.moved(place, rotation_matrix(x=side * np.pi / 2)))
        return wheels

    def solids(self) -> tuple[Solid, ...]:
        x, y, h, belt = self.long / 2, self.wide / 2, self.height, self._belt()
        solids = [
            Solid("box", (x, y, (belt - CHASSIS_Z) / 2), (0, 0, (belt + CHASSIS_Z) / 2)),
            Solid(
                kind="box",
                size=(x - self.nose / 2 - 0.002, y - 0.001, (h - belt) / 2),
                pos=(-self.nose / 2, 0, (h + belt) / 2),
            ),
        ]
        for axle in AXLES:
            half = (0.0085, y + 0.0025, WHEEL_RADIUS)
            solids.append(Solid("box", half, (axle * x, 0, WHEEL_RADIUS)))
        return tuple(solids)

    def aspect(self) -> float:
        return 2 * (self.long + self.wide) / (0.42 * self.height - CHASSIS_Z)
