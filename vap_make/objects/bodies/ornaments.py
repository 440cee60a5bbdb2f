"""Miniature houses. Lengths are metres; the door faces -y."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.parts import (
    HalfSizes,
    ellipsoid,
    flat_polygon,
    frustum,
    panel,
    sharp_box,
)
from vap_make.objects.shapes import SIDES, Mesh, Number, Solid, join_meshes, rotation_matrix
from vap_make.objects.textures import (
    ACCENT,
    BASE,
    DARK,
    DECORATED,
    GLASS,
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


HALF_DEPTH = 0.005
"""Of the frame."""
CANVAS_UV = ((0.0, 0.74), (1.0, 0.74), (1.0, 0.004), (0.0, 0.004))
COLOUR_FIELDS = (
    ((-0.5, 0.05, -0.06, 0.5), INK),
    ((0.0, 0.2, 0.5, 0.5), WARM),
    ((-0.5, -0.5, -0.2, 0.0), LIGHT),
    ((-0.14, -0.5, 0.5, -0.22), ACCENT),
    ((0.0, -0.16, 0.5, 0.14), LIGHT),
)
"""Scene "blocks": left, bottom, right and top of a field, and its swatch."""


@value
class Painting:
    """A framed picture that stands upright.

    `frame` is the frame's width, `foot` the foot's height; `frame_paint` names a swatch.
    """

    wide: float = 0.088
    high: float = 0.096
    frame: float = 0.009
    scene: Literal["hills", "sea", "flower", "blocks"] = "hills"
    frame_paint: Literal["base", "ink", "accent", "dark", "light", "warm"] = "warm"
    foot: float = 0.006

    def mesh(self) -> Mesh:
        x, z, h, f = self.wide / 2, self.foot, self.high, self.frame
        canvas = np.array(
            [
                (-x + f, 0.0, z + f),
                (x - f, 0.0, z + f),
                (x - f, 0.0, z + h - f),
                (-x + f, 0.0, z + h - f),
            ]
        )
        parts = [flat_polygon(canvas, DECORATED, np.array(CANVAS_UV))]
        for part in self._scene():
            parts.append(part.moved((0, -0.0005, z + h / 2)))
        back = sharp_box((x - f, 0.0008), z + f, z + h - f, LIGHT)
        return join_meshes(
            [*parts, *self._frame(), back.moved((0, 0.0015, 0)), *self._easel()],
        )

    def _cut_out(self, points: Sequence[tuple[Number, Number]], swatch: int, layer: int) -> Mesh:
        """A polygon before the canvas; points are shares of its size, from its centre."""
        wide, high = self.wide - 2 * self.frame, self.high - 2 * self.frame
        x, z = np.array(points).T
        corners = np.stack([wide * x, np.full_like(x, -0.0005 * layer), high * z], 1)
        return flat_polygon(corners, swatch)

    def _dot(self, centre: tuple[Number, Number], radius: Number, swatch: int, layer: int) -> Mesh:
        """A disc before the canvas; its radius is a share of the canvas's width."""
        wide, high = self.wide - 2 * self.frame, self.high - 2 * self.frame
        x, z = centre
        rim = []
        for angle in 2 * np.pi * np.arange(16) / 16:
            rise = radius * float(np.sin(angle)) * wide / high
            rim.append((x + radius * float(np.cos(angle)), z + rise))
        return self._cut_out(rim, swatch, layer)

    def _scene(self) -> list[Mesh]:
        match self.scene:
            case "hills":
                return self._hills()
            case "sea":
                return self._sea()
            case "flower":
                return self._flower()
            case "blocks":
                return self._blocks()

    def _hills(self) -> list[Mesh]:
        far = [(-0.1, -0.5), (0.5, -0.5), (0.5, -0.05), (0.3, 0.1)]
        peak = [(-0.5, -0.5), (0.32, -0.5), (-0.16, 0.24)]
        near = [(-0.5, -0.5), (0.5, -0.5), (0.5, -0.16), (0.1, -0.2), (-0.5, -0.34)]
        snow = [(-0.22, 0.14), (-0.09, 0.14), (-0.16, 0.24)]
        return [
            self._dot((0.24, 0.28), 0.12, WARM, layer=1),
            self._cut_out(far, GLASS, layer=1),
            self._cut_out(peak, INK, layer=2),
            self._cut_out(near, ACCENT, layer=3),
            self._cut_out(snow, LIGHT, layer=3),
        ]

    def _sea(self) -> list[Mesh]:
        water = [(-0.5, -0.5), (0.5, -0.5), (0.5, -0.08), (-0.5, -0.08)]
        hull = [(-0.16, -0.24), (0.14, -0.24), (0.22, -0.13), (-0.24, -0.13)]
        main_sail = [(0.02, -0.1), (0.22, -0.1), (0.02, 0.28)]
        jib = [(-0.02, -0.1), (-0.02, 0.2), (-0.18, -0.1)]
        return [
            self._dot((-0.28, 0.3), 0.1, WARM, layer=1),
            self._cut_out(water, INK, layer=1),
            self._cut_out(hull, DARK, layer=2),
            self._cut_out(main_sail, LIGHT, layer=3),
            self._cut_out(jib, ACCENT, layer=3),
        ]

    def _flower(self) -> list[Mesh]:
        stem = [(-0.02, -0.2), (0.02, -0.2), (0.02, 0.1), (-0.02, 0.1)]
        pot = [(-0.14, -0.44), (0.14, -0.44), (0.2, -0.16), (-0.2, -0.16)]
        parts = [self._cut_out(stem, DARK, layer=1), self._cut_out(pot, ACCENT, layer=2)]
        for angle in 2 * np.pi * np.arange(5) / 5 + 0.3:
            centre = (0.17 * float(np.cos(angle)), 0.16 + 0.15 * float(np.sin(angle)))
            parts.append(self._dot(centre, 0.12, INK, layer=2))
        return [*parts, self._dot((0, 0.16), 0.09, WARM, layer=3)]

    def _blocks(self) -> list[Mesh]:
        parts = []
        for (left, bottom, right, top), swatch in COLOUR_FIELDS:
            field = [(left, bottom), (right, bottom), (right, top), (left, top)]
            parts.append(self._cut_out(field, swatch, layer=1))
        return parts

    def _frame(self) -> list[Mesh]:
        """Four rails, each with a bead along its middle."""
        x, z, h, f = self.wide / 2, self.foot, self.high, self.frame
        swatch = SWATCHES[self.frame_paint]
        rail = sharp_box((f / 2, HALF_DEPTH), 0, h, swatch)
        bead = sharp_box((f / 5, HALF_DEPTH + 0.0015), 0.4 * f, h - 0.4 * f, swatch)
        rails, beads, upright = [], [], []
        for side in SIDES:
            place = (side * (x - f / 2), 0, z)
            upright += [rail.moved(place), bead.moved(place)]
        for low in (z, z + h - f):
            rails.append(sharp_box((x - f, HALF_DEPTH), low, low + f, swatch))
            half = (x - 0.5 * f, HALF_DEPTH + 0.0015)
            beads.append(sharp_box(half, low + 0.3 * f, low + 0.7 * f, swatch))
        return [*upright, *rails, *beads]

    def _easel(self) -> list[Mesh]:
        """On either side a foot, a stop before the frame and a brace behind it."""
        x, z, h = self.wide / 2, self.foot, self.high
        foot = sharp_box((0.006, 0.024), 0, z, DARK)
        stop = sharp_box((0.006, 0.003), z, z + 0.006, DARK)
        brace = frustum(
            low=(0.003, 0.009),
            high=(0.003, 0.002),
            bottom=z,
            top=z + 0.6 * h,
            swatch=DARK,
        )
        feet, stops, braces = [], [], []
        for side in SIDES:
            feet.append(foot.moved((side * 0.6 * x, 0.004, 0)))
            stops.append(stop.moved((side * 0.6 * x, -0.0085, 0)))
            braces.append(brace.moved((side * 0.6 * x, 0.014, 0)))
        return [*feet, *stops, *braces]

    def solids(self) -> tuple[Solid, ...]:
        x, z, h = self.wide / 2, self.foot, self.high
        feet, braces = [], []
        for side in SIDES:
            feet.append(Solid("box", (0.006, 0.024, z / 2), (side * 0.6 * x, 0.004, z / 2)))
            half = (0.003, 0.006, 0.28 * h)
            braces.append(Solid("box", half, (side * 0.6 * x, 0.011, z + 0.28 * h)))
        return *feet, Solid("box", (x, 0.006, h / 2), (0, 0, z + h / 2)), *braces

    def aspect(self) -> float:
        return self.wide / self.high
