"""The last that shoes and slippers are built over, with their soles, openings and solids.

Lengths are metres. A last lies along x, heel at -x, toe at +x; a place along it is given as a share
of its length from the heel.
"""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.parts import grid_mesh, interpolate_knots, tube
from vap_make.objects.shapes import SIDES, Mesh, Number, Solid, join_meshes
from vap_make.objects.textures import ACCENT, BASE, DARK, DECORATED, INK

Knots = tuple[tuple[Number, Number], ...]
WIDTH_KNOTS: Knots = ((0, 0.80), (0.3, 0.76), (0.68, 1.0), (1, 0.96))
"""(Share of the length, share of the width)."""
SOLE_LEVELS = ((-0.06, 0), (0.0, 0.3), (0.0, 0.55), (0.0, 0.8), (-0.02, 1.0), (-0.12, 1.06))


@value
class Last:
    """The form of a foot, made of superellipse sections.

    `top` lists (share of the length from the heel, share of the height) of the top line; the sole
    ends at height `low`.
    """

    length: float
    width: float
    height: float
    low: float
    top: Knots
    power: Number = 2.8

    def half_width(self, s: np.ndarray) -> np.ndarray:
        """Half-width at share s: round at both ends, widest at the ball of the foot."""
        bulge = interpolate_knots(WIDTH_KNOTS, 41)
        t = np.clip(2 * s - 1, -1, 1)
        q = np.where(t > 0, 2.5, 3.2)
        widest = self.width / 2 * np.interp(s, bulge[:, 0], bulge[:, 1])
        return widest * (1 - np.abs(t) ** q) ** (1 / q)

    def top_line(self, s: np.ndarray) -> np.ndarray:
        """Height of the top line at share s, metres."""
        line = interpolate_knots(self.top, 41)
        return self.height * np.interp(s, line[:, 0], line[:, 1])

    def surface(self, s: np.ndarray, lift: np.ndarray, raised: Number = 0) -> np.ndarray:
        """Points of the hull, raised by `raised` metres.

        `lift` runs from -1 (sole, near side y < 0) over 0 (top line) to 1 (sole, far side).
        """
        angle = np.pi / 2 * (1 - np.abs(lift))
        side = np.sign(lift)
        width, rise = self.half_width(s), self.top_line(s) - self.low
        slope = (self.top_line(s + 0.01) - self.top_line(s - 0.01)) / (0.02 * self.length)
        y = side * width * np.cos(angle) ** (2 / self.power)
        z = self.low + rise * np.sin(angle) ** (2 / self.power)
        directions = (-slope * np.sin(angle), side * np.cos(angle), np.sin(angle))
        outward = np.stack(np.broadcast_arrays(*directions), -1)
        outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
        points = np.stack(np.broadcast_arrays(self.length * (s - 0.5), y, z), -1)
        return points + raised * outward

    def top_point(self, s: Number, lift: Number = 0.0, raised: Number = 0) -> np.ndarray:
        """One point of the hull."""
        return self.surface(np.array([s]), np.array([lift]), raised)[0]

    def hull_mesh(self, swatch: int, rows: int = 6) -> Mesh:
        """The whole hull; decorated, either side shows the whole decoration."""
        columns = 13
        s = (1 - np.cos(np.linspace(0.0, np.pi, columns))) / 2
        down = np.broadcast_to(np.linspace(1, 0, rows)[:, None], (rows, columns))
        near = self.surface(s[None], np.linspace(-1, 0, rows)[:, None])
        far = self.surface(s[None, ::-1], np.linspace(1, 0, rows)[:, None])
        return join_meshes([grid_mesh(near, swatch, down=down), grid_mesh(far, swatch, down=down)])

    def patch(
        self,
        shares: tuple[Number, Number],
        lifts: tuple[Number, Number],
        swatch: int,
        raised: Number,
        size: tuple[int, int],
        slant: Number = 0,
    ) -> Mesh:
        """A piece of material on the hull between two shares of the length and two lifts.

        `size` are its columns and rows; `slant` moves its upper edge along the length.
        """
        (start, stop), (low, high), (columns, rows) = shares, lifts, size
        lift = np.linspace(low, high, rows)[:, None]
        shift = slant * np.linspace(0, 1, rows)[:, None]
        s = np.linspace(start, stop, columns)[None] + shift
        if low > high:
            s = s[:, ::-1]
        return grid_mesh(self.surface(s, lift, raised), swatch)

    def sole(self, swatch: int, stripe: int, flare: Number = 1.05) -> Mesh:
        """A slab under the hull with a stripe around it."""
        s = (1 - np.cos(np.linspace(0, np.pi, 9))) / 2
        x, half_width = self.length * (s - 0.5), self.half_width(s)
        outline_x = np.concatenate([x, x[::-1]])
        outline_y = np.concatenate([-half_width, half_width[::-1]])
        rim = np.stack([outline_x, outline_y], 1)
        rim = np.concatenate([rim, rim[:1]])

        def ring(scale: Number, z: Number) -> np.ndarray:
            grow = np.array([1 + (scale - 1) * self.width / self.length, scale])
            return np.column_stack([rim * grow, np.full(len(rim), z)])

        rings = []
        for change, z in SOLE_LEVELS:
            rings.append(ring(flare + change, z * self.low))
        wall = np.stack(rings)
        ground = np.stack([ring(0, 0), ring(flare - 0.06, 0)])
        return join_meshes(
            [
                grid_mesh(wall[:3], swatch),
                grid_mesh(wall[2:4], stripe),
                grid_mesh(wall[3:], swatch),
                grid_mesh(ground, swatch),
            ]
        )

    def opening(
        self, start: Number, stop: Number, share: Number, trim: int, inside: int, thickness: Number
    ) -> list[Mesh]:
        """The opening for the foot between two shares of the length, `share` of the width wide.

        It has a lining (swatch `inside`), the dark way to the toe, and a padded ring (`trim`).
        """
        t = np.linspace(0, 2 * np.pi, 15)
        s = (start + stop) / 2 + (stop - start) / 2 * np.sin(t)
        y = -share * self.half_width(np.clip(s, 0.08, 1)) * np.cos(t)
        z = np.interp(s, (start, stop), self.top_line(np.array([start, stop], np.float64)))
        rim = np.stack([self.length * (s - 0.5), y, z], 1)
        centre = np.broadcast_to(rim[:-1].mean(0), rim.shape)
        lining = np.stack([rim, centre]) + np.array([0, 0, 0.0008])
        towards_toe = (0.55 * lining[1] + 0.45 * rim[4]) * (1, 0, 1)
        shade = lining[0] * (0.62, 0.72, 0.62) + (1 - 0.62) * towards_toe
        shade = shade + np.array([0, 0, 0.0006])
        depth = np.stack([shade, np.broadcast_to(shade[:-1].mean(0), rim.shape)])
        return [
            grid_mesh(lining, inside),
            grid_mesh(depth, DARK),
            tube(rim, thickness, trim, sides=5, capped=False),
        ]

    def solids(self, cuts: Knots) -> tuple[Solid, ...]:
        """The collision solids: the sole's, then two blocks for every (start, stop) of `cuts`.

        The sole is a foot and two round ends. Of the two blocks the low one is wide, the high one
        is narrow and leans with the top line.
        """
        length, low = self.length, self.low
        toe = float(self.half_width(np.array([0.8]))[0])
        heel = float(self.half_width(np.array([0.2]))[0])
        half_height = low / 2 - 0.0002
        middle_z = low / 2 + 0.0002
        middle = (0.13 * length, 0.98 * self.width / 2, half_height)
        solids = [
            Solid("box", (0.32 * length, 0.97 * heel, low / 2), (-0.02 * length, 0, low / 2)),
            Solid("cylinder", (toe, half_height), (length / 2 - toe, 0, middle_z)),
            Solid("box", middle, (0.15 * length, 0, middle_z)),
            Solid("cylinder", (heel, half_height), (heel - length / 2, 0, middle_z)),
        ]
        for start, stop in cuts:
            solids += self._blocks(start, stop)
        return tuple(solids)

    def _blocks(self, start: Number, stop: Number) -> list[Solid]:
        length, low = self.length, self.low
        s = np.linspace(start, stop, 5)
        half_width, top = float(self.half_width(s).mean()), self.top_line(s).tolist()
        x, run = length * ((start + stop) / 2 - 0.5), length * (stop - start)
        lean, middle = float(np.arctan2(top[0] - top[-1], run)), (top[0] + top[-1]) / 2
        high = 0.55 * min(top[0], top[-1]) + 0.45 * low
        half_height = (middle - low) * np.cos(lean) / 2
        upper_z = middle - half_height * np.cos(lean) - 0.0005
        lower_half = (run / 2, 0.93 * half_width, (high - low) / 2)
        return [
            Solid("box", lower_half, (x, 0, (high + low) / 2)),
            Solid(
                kind="box",
                size=(run / 2, 0.70 * half_width, half_height),
                pos=(x - half_height * np.sin(lean), 0, upper_z),
                euler=(0, lean, 0),
            ),
        ]


TRAINER_TOP: Knots = (
    (0, 0.90),
    (0.14, 0.88),
    (0.42, 1.0),
    (0.6, 0.80),
    (0.8, 0.60),
    (0.92, 0.52),
    (1, 0.40),
)
"""(Share of the length from the heel, share of the height)."""
SOLID_CUTS: Knots = ((0.02, 0.42), (0.42, 0.62), (0.62, 0.8), (0.8, 0.93), (0.93, 0.99))
LACES, STRAPS, BARS = (0.48, 0.55, 0.62, 0.69), (0.47, 0.61), (0.42, 0.52, 0.62)
"""Where they are, as shares of the length from the heel."""


@value
class Shoe:
    """An athletic shoe; `height` is the top of its tongue, `sole` the thickness of its sole."""

    length: float = 0.104
    width: float = 0.044
    height: float = 0.060
    sole: float = 0.0145
    closure: Literal["laces", "straps", "slip"] = "laces"
    side: Literal["bars", "wave", "patch", "none"] = "wave"
    toe: Literal["plain", "cap", "bumper"] = "plain"

    def _last(self) -> Last:
        return Last(
            length=self.length,
            width=self.width,
            height=self.height,
            low=self.sole,
            top=TRAINER_TOP,
        )

    def mesh(self) -> Mesh:
        last = self._last()
        stripe, trim = ACCENT, BASE
        if self.toe == "bumper":
            stripe = BASE
        if self.closure == "slip":
            trim = INK
        opening = last.opening(
            start=0.05,
            stop=0.45,
            share=0.72,
            trim=trim,
            inside=DARK,
            thickness=0.0034,
        )
        return join_meshes(
            [
                last.sole(ACCENT, stripe),
                last.hull_mesh(DECORATED),
                *opening,
                *self._toe_meshes(last),
                *self._side_meshes(last),
                *self._closure_meshes(last),
            ]
        )

    def _toe_meshes(self, last: Last) -> list[Mesh]:
        if self.toe == "plain":
            return []
        swatch = INK
        if self.toe == "cap":
            swatch = ACCENT
        parts = []
        for side in SIDES:
            parts.append(last.patch((0.82, 0.995), (side, 0), swatch, raised=0.0007, size=(4, 4)))
        return parts

    def _side_meshes(self, last: Last) -> list[Mesh]:
        parts: list[Mesh] = []
        for side in SIDES:
            match self.side:
                case "bars":
                    parts += self._bars(last, side)
                case "wave":
                    parts.append(self._wave(last, side))
                case "patch":
                    lifts = (side * 0.98, side * 0.45)
                    parts.append(last.patch((0.0, 0.17), lifts, INK, raised=0.0007, size=(4, 3)))
        return parts

    def _bars(self, last: Last, side: int) -> list[Mesh]:
        bars = []
        for s in BARS:
            bar = last.patch(
                shares=(s, s + 0.05),
                lifts=(side * 0.98, side * 0.5),
                swatch=ACCENT,
                raised=0.0006,
                size=(2, 3),
                slant=0.09,
            )
            bars.append(bar)
        return bars

    def _wave(self, last: Last, side: int) -> Mesh:
        s = np.linspace(0.1, 0.68, 11)
        rise = 0.56 + 0.2 * np.sin(np.pi * ((s - 0.1) / 0.58) ** 0.8)
        thick = 0.015 + 0.11 * np.sin(np.pi * ((s - 0.1) / 0.58) ** 1.2)
        lift = np.stack([side * (rise + thick), side * (rise - thick)])
        wave = last.surface(np.stack([s, s]), lift, 0.0007)
        if side > 0:
            wave = wave[:, ::-1]
        return grid_mesh(wave, ACCENT)

    def _closure_meshes(self, last: Last) -> list[Mesh]:
        match self.closure:
            case "laces":
                return self._laces(last)
            case "straps":
                return self._straps(last)
            case "slip":
                parts = []
                for side in SIDES:
                    lifts = (side * 0.95, side * 0.35)
                    parts.append(last.patch((0.34, 0.42), lifts, INK, raised=0.0006, size=(2, 4)))
                return parts

    def _laces(self, last: Last) -> list[Mesh]:
        """The tongue's two halves, laces across it, and a bow."""
        parts = []
        for side in SIDES:
            lifts = (side * 0.36, 0)
            parts.append(last.patch((0.45, 0.74), lifts, ACCENT, raised=0.0004, size=(4, 3)))
        for s in LACES:
            path = last.surface(np.full(5, s), np.linspace(-0.46, 0.46, 5), 0.001)
            parts.append(tube(path, 0.0017, INK, sides=5))
        knot = last.top_point(0.47, raised=0.0025)
        t = np.linspace(0, np.pi, 6)
        x, z = 0.009 - 0.006 * np.cos(t), 0.0025 * np.sin(t) - 0.004 * t / np.pi
        for side in SIDES:
            y = side * (0.002 + 0.008 * np.sin(t / 1.3))
            parts.append(tube(knot + np.stack([x, y, z], 1), 0.0012, INK, sides=4))
        return parts

    def _straps(self, last: Last) -> list[Mesh]:
        parts = []
        for s in STRAPS:
            for side in SIDES:
                shares, lifts = (s, s + 0.085), (side * 0.75, 0)
                parts.append(last.patch(shares, lifts, INK, raised=0.0014, size=(2, 4)))
        return parts

    def solids(self) -> tuple[Solid, ...]:
        return self._last().solids(SOLID_CUTS)

    def aspect(self) -> float:
        return self.length / (0.5 * self.width + 0.55 * self.height)
