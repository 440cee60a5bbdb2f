"""Ceramic cups with a handle. Lengths are metres; the handle points along +x."""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.turned import handle_bar, lathe
from vap_make.objects.shapes import (
    Mesh,
    Number,
    Solid,
    foot_box,
    join_meshes,
    upright_cylinder,
)
from vap_make.objects.textures import BASE, DECORATED, LIGHT, SWATCHES


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
