"""Pen holders with pens in them. Lengths are metres."""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.cups import hollow_vessel
from vap_make.objects.bodies.turned import tube
from vap_make.objects.shapes import (
    Mesh,
    Number,
    Solid,
    foot_box,
    join_meshes,
    upright_cylinder,
)
from vap_make.objects.textures import ACCENT, DARK, INK, LIGHT, METAL, SWATCHES, WARM

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
