"""Athletic shoes. Lengths are metres; the heel is at -x, the toe at +x."""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.lofts import grid_mesh
from vap_make.objects.bodies.shoe_last import Knots, Last
from vap_make.objects.bodies.turned import tube
from vap_make.objects.shapes import SIDES, Mesh, Solid, join_meshes
from vap_make.objects.textures import ACCENT, BASE, DARK, DECORATED, INK

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
