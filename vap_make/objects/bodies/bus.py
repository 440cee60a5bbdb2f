"""Toy buses. Lengths are metres; the nose points towards +x, the door side faces -y."""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.flat_parts import frustum, panel, sharp_box
from vap_make.objects.bodies.turned import closed_cylinder
from vap_make.objects.shapes import (
    SIDES,
    Mesh,
    Solid,
    join_meshes,
    rotation_matrix,
)
from vap_make.objects.textures import (
    BASE,
    DARK,
    DECORATED,
    GLASS,
    METAL,
    SWATCHES,
    WARM,
)

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
