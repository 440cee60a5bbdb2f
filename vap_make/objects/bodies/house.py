"""Miniature houses. Lengths are metres; the door faces -y."""

from itertools import pairwise
from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.flat_parts import HalfSizes, frustum, panel, sharp_box
from vap_make.objects.bodies.turned import ellipsoid
from vap_make.objects.shapes import Mesh, Number, Solid, join_meshes, rotation_matrix
from vap_make.objects.textures import (
    ACCENT,
    BASE,
    DARK,
    DECORATED,
    INK,
    LIGHT,
    SWATCHES,
    WARM,
)


@value
class House:
    """A house on a base plate.

    `wide`, `deep` and `eaves` measure its walls, `rise` its roof, `plate` the base plate's height;
    `windows` counts those of a storey's front; `roof_paint` names a swatch.
    """

    wide: float = 0.058
    deep: float = 0.046
    eaves: float = 0.036
    rise: float = 0.026
    roof: Literal["gable", "hip", "barn", "flat"] = "gable"
    roof_paint: Literal["base", "ink", "accent", "dark", "light", "warm"] = "base"
    windows: int = 2
    storeys: int = 1
    chimney: bool = True
    plate: float = 0.006

    def _roof_levels(self) -> list[tuple[HalfSizes, float]]:
        """Half-widths and their height z, upwards from the eaves."""
        x, y = self.wide / 2 + 0.003, self.deep / 2 + 0.004
        z, h = self.plate + self.eaves, self.rise
        match self.roof:
            case "gable":
                return [((x, y), z), ((x, 0.0), z + h)]
            case "hip":
                return [((x, y), z), ((0.3 * x, 0.0), z + h)]
            case "barn":
                return [((x, y), z), ((x, 0.62 * y), z + 0.62 * h), ((x, 0.0), z + h)]
            case "flat":
                return [
                    ((x, y), z),
                    ((x, y), z + 0.35 * h),
                    ((0.55 * x, 0.6 * y), z + 0.35 * h),
                    ((0.55 * x, 0.6 * y), z + h),
                ]

    def mesh(self) -> Mesh:
        x, y, top = self.wide / 2, self.deep / 2, self.plate + self.eaves
        parts = [
            sharp_box((x + 0.011, y + 0.010), 0, self.plate, ACCENT),
            sharp_box((x, y), self.plate, top, DECORATED),
            *self._window_meshes(),
            *self._door(),
        ]
        for (low, bottom), (high, upper) in pairwise(self._roof_levels()):
            parts.append(
                frustum(
                    low=low,
                    high=high,
                    bottom=bottom,
                    top=upper,
                    swatch=SWATCHES[self.roof_paint],
                )
            )
        if self.chimney:
            cap_z = top + 1.02 * self.rise
            stack = sharp_box((0.0045, 0.0045), top, cap_z, BASE)
            cap = sharp_box((0.0055, 0.0055), cap_z, cap_z + 0.0025, DARK)
            parts.append(stack.moved((0.55 * x, 0.35 * y, 0)))
            parts.append(cap.moved((0.55 * x, 0.35 * y, 0)))
        return join_meshes(parts)

    def _window_meshes(self) -> list[Mesh]:
        """On every storey a row of windows in front and behind, and one at either side."""
        x, y, storey_height = self.wide / 2, self.deep / 2, self.eaves / self.storeys
        window = self._window(storey_height)
        parts = []
        for storey in range(self.storeys):
            z = self.plate + (storey + 0.56) * storey_height
            row = (np.arange(self.windows) + 0.5 - self.windows / 2) * self.wide / self.windows
            walls = (  # yaw, distance from the axis, places along the wall
                (0.0, y, row),
                (np.pi, y, row),
                (np.pi / 2, x, [0.0]),
                (-np.pi / 2, x, [0.0]),
            )
            for yaw, distance, places in walls:
                for place in places:
                    if yaw == 0 and storey == 0 and self._is_at_door(place):
                        continue
                    hung = window.moved((float(place), -distance, z))
                    parts.append(hung.moved(rotation=rotation_matrix(z=yaw)))
        return parts

    def _is_at_door(self, place: Number) -> bool:
        """Whether a window there on the front's ground floor would overlap the door."""
        return bool(abs(place) < 0.009 and self.windows % 2)

    def _window(self, storey_height: Number) -> Mesh:
        """Frame, pane and cross bars."""
        width, height = min(0.013, 0.8 * self.wide / (self.windows + 1)), 0.5 * storey_height
        return join_meshes(
            [
                panel(width + 0.003, height + 0.003, LIGHT),
                panel(width, height, INK, 0.0014),
                panel(0.0012, height, LIGHT, 0.0018),
                panel(width, 0.0012, LIGHT, 0.0018),
            ]
        )

    def _door(self) -> list[Mesh]:
        y, height = self.deep / 2, 0.62 * (self.eaves / self.storeys)
        width = 0.010
        if self.windows % 2:
            width = 0.011
        door = panel(width, height, ACCENT, 0.0016)
        knob = ellipsoid((0.0009, 0.0009, 0.0009), WARM, segments=6, rows=3)
        return [
            door.moved((0, -y, self.plate + height / 2)),
            knob.moved((0.3 * width, -y - 0.0018, self.plate + 0.45 * height)),
        ]

    def solids(self) -> tuple[Solid, ...]:
        x, y, h = self.wide / 2, self.deep / 2, self.eaves
        half_rise = self.rise / 2 + 0.0015
        solids = [
            Solid("box", (x + 0.011, y + 0.010, self.plate / 2), (0, 0, self.plate / 2)),
            Solid("box", (x, y, h / 2), (0, 0, self.plate + h / 2)),
            *self._roof_solids(),
        ]
        if self.chimney:
            place = (0.55 * x, 0.35 * y, self.plate + h + half_rise)
            solids.append(Solid("box", (0.005, 0.005, half_rise), place))
        return tuple(solids)

    def _roof_solids(self) -> list[Solid]:
        """Five boxes stacked from the eaves to the ridge."""
        heights, half_x, half_y = [], [], []
        for i, ((x, y), level) in enumerate(self._roof_levels()):
            heights.append(level + 1e-6 * i)
            half_x.append(x)
            half_y.append(y)
        z = np.linspace(self._roof_levels()[0][1], self._roof_levels()[-1][1], 6)
        middle = (z[1:] + z[:-1]) / 2
        wide, deep = np.interp(middle, heights, half_x), np.interp(middle, heights, half_y)
        half_height = float(z[1] - z[0]) / 2
        stack = []
        for i in range(5):
            half = (float(wide[i]), float(deep[i]), half_height)
            stack.append(Solid("box", half, (0, 0, float(middle[i]))))
        return stack

    def aspect(self) -> float:
        return 2 * (self.wide + self.deep) / self.eaves
