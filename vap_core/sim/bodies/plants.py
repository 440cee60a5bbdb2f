"""Potted plants: rosettes, aloes, cacti and bushes. Lengths in metres; the pot wears the decoration, the plant its ink and accent."""

from typing import Literal

import numpy as np

from vap_core.sim.shapes import DECORATED, Mesh, Number, Solid, ellipsoid, foot, join, lathe, pillar, turn
from vap_core.sim.textures import ACCENT, BASE, DARK, INK
from vap_core.values import value


def _leaf(long: float, wide: float, thick: float, lean: Number, around: Number, curl: float, blunt: float, tip: int) -> Mesh:
    """A thick pointed leaf from the origin, `lean` radians off vertical towards `around`; `curl` bends its end up by curl * long metres."""
    cross = (wide / 2, thick / 2, 2)
    blade = join([lathe([(0.6, 0), (1, 0.5 * long), (blunt, 0.82 * long)], INK, 6, cross), lathe([(blunt, 0.82 * long), (0, long)], tip, 6, cross)])
    bend = blade.vertex + np.outer(curl * blade.vertex[:, 2] ** 2 / long, [0, 1, 0])
    slope = np.arctan(2 * curl * blade.vertex[:, 2] / long)
    y, z = blade.normal[:, 1], blade.normal[:, 2]
    normal = np.column_stack([blade.normal[:, 0], y * np.cos(slope) + z * np.sin(slope), z * np.cos(slope) - y * np.sin(slope)])
    return Mesh(bend, normal, blade.uv, blade.face).moved(turn=turn(x=lean)).moved(turn=turn(z=around + np.pi / 2))


def flat_leaf(long: float, wide: float, around: Number, paint: int) -> Mesh:
    """A thin leaf that grows outwards from the axis and droops at its end."""
    blade = lathe([(0.7, 0), (1, 0.45 * long), (0.75, 0.75 * long), (0, long)], paint, 6, (wide / 2, 0.0009, 2))
    bend = blade.vertex - np.outer(0.42 * blade.vertex[:, 2] ** 2 / long, [0, 1, 0])
    return Mesh(bend, blade.normal, blade.uv, blade.face).moved(turn=turn(x=1.45)).moved(turn=turn(z=around + np.pi / 2))


@value
class Plant:
    """A plant in a small pot. `spread` is the radius of its leaves; `leaves` how many stand in the outer ring; `blunt` 0 (needle) to 1 (round)."""

    kind: Literal["rosette", "aloe", "cactus", "bush"] = "rosette"
    pot: float = 0.0195
    pot_height: float = 0.036
    height: float = 0.060
    spread: float = 0.027
    leaves: int = 7
    blunt: float = 0.80
    tips: Literal["ink", "accent"] = "accent"
    rim: Literal["base", "accent", "none"] = "base"

    def _whorl(
        self, count: int, start: float, low: float, long: float, wide: float, thick: float, lean: float, curl: float, blunt: float
    ) -> list[Mesh]:
        """`count` leaves around the axis; `start` shifts the first by a share of the gap between two, `low` is the height they grow from."""
        tip = ACCENT if self.tips == "accent" else INK
        around = 2 * np.pi * (np.arange(count) + start) / count
        return [_leaf(long, wide, thick, lean, float(a), curl, blunt, tip).moved((0, 0, low)) for a in around]

    def _rosette(self) -> list[Mesh]:
        rise, long, n = self.height - self.pot_height, 1.12 * self.spread, self.leaves
        broad = min(2.9 * self.spread / n, 0.5 * long)
        parts = []
        for i, (count, lean, share, width) in enumerate(
            [(n, 1.30, 1.0, 1.25), (n, 0.98, 0.92, 1.2), (n - 2, 0.62, 0.84, 1.1), (n // 2, 0.22, 0.80, 0.8)]
        ):
            size, wide, low = min(long * share, 1.08 * rise / float(np.cos(lean))), broad * width, self.pot_height - 0.001 + 0.0012 * i
            parts += self._whorl(count, 0.5 * (i % 2), low, size, wide, 0.5 * wide, lean, 0.28, self.blunt)
        return parts

    def _aloe(self) -> list[Mesh]:
        rise, low = self.height - self.pot_height, self.pot_height - 0.001
        parts = []
        for i, (count, lean, share) in enumerate([(self.leaves, 0.72, 0.98), (self.leaves - 2, 0.40, 1.0), (3, 0.12, 0.97)]):
            size = min(share * rise / float(np.cos(lean)), 1.4 * self.spread)
            parts += self._whorl(count, 0.5 * (i % 2), low, size, 0.0085, 0.0055, lean, 0.1, 0.5 * self.blunt)
        return parts

    def _cactus(self) -> list[Mesh]:
        rise, low = self.height - self.pot_height, self.pot_height - 0.002
        t = np.linspace(0, np.pi / 2, 5)
        column = [(0.8, 0.0), (1.0, 0.35 * rise), *((float(np.cos(a)), float(0.6 * rise + 0.4 * rise * np.sin(a))) for a in t)]
        radius = 0.65 * self.spread
        trunk = lathe([(radius * r, z) for r, z in column], INK, 24)
        around = np.arctan2(trunk.vertex[:, 1], trunk.vertex[:, 0])
        rib = 1 + 0.13 * np.cos(self.leaves * around)
        vertex = trunk.vertex * np.stack([rib, rib, np.ones_like(rib)], 1)
        parts = [Mesh(vertex, trunk.normal, trunk.uv, trunk.face).moved((0, 0, low))]
        for side, at, size in ((1, 0.42, 0.40), (-1, 0.28, 0.32)):
            elbow = ellipsoid((0.36 * self.spread, 0.0048, 0.0048), INK, 8, 5).moved((side * 0.74 * self.spread, 0, low + at * rise))
            arm = ellipsoid((0.0050, 0.0050, size * rise / 1.7), INK, 8, 6).moved((side * 0.98 * self.spread, 0, low + (at + 0.5 * size) * rise))
            parts += [elbow, arm]
        return [*parts, ellipsoid((0.0055, 0.0055, 0.0035), ACCENT, 8, 4).moved((0, 0, low + rise))]

    def _bush(self) -> list[Mesh]:
        rise, low = self.height - self.pot_height, self.pot_height
        parts = [ellipsoid((0.62 * self.spread, 0.62 * self.spread, 0.42 * rise), INK, 10, 6).moved((0, 0, low + 0.55 * rise))]
        for k in range(self.leaves):
            a, up = 2.4 * k, 0.2 + 0.55 * k / self.leaves
            out = self.spread * (0.68 - 0.28 * up)
            half = 0.36 * self.spread, 0.36 * self.spread, 0.26 * rise
            parts.append(ellipsoid(half, (INK, INK, ACCENT)[k % 3], 8, 4).moved((out * np.cos(a), out * np.sin(a), low + up * rise)))
        return parts

    def mesh(self) -> Mesh:
        r, h = self.pot, self.pot_height
        lip = {"base": BASE, "accent": ACCENT, "none": BASE}[self.rim]
        proud = 0.0 if self.rim == "none" else 0.0016
        wall = [(0.80 * r, 0), (r - proud, h - 0.008)]
        parts = [lathe([(0, 0), (0.80 * r, 0)], BASE, 20), lathe(wall, DECORATED, 20), lathe([(r - proud, h - 0.008), (r, h - 0.008)], lip, 20),
                 lathe([(r, h - 0.008), (r, h)], lip, 20), lathe([(r, h), (r - 0.003, h)], lip, 20),
                 lathe([(r - 0.003, h), (r - 0.003, h - 0.003), (0, h - 0.003)], DARK, 20)]  # fmt: skip
        plant = {"rosette": self._rosette, "aloe": self._aloe, "cactus": self._cactus, "bush": self._bush}[self.kind]()
        return join([*parts, *plant])

    def solids(self) -> tuple[Solid, ...]:
        r, h, rise = self.pot, self.pot_height, self.height - self.pot_height
        pot = foot(0.80 * r), pillar(0.87 * r, 0.001, h / 2), pillar(0.97 * r, h / 2, h)
        if self.kind == "cactus":
            arms = Solid("box", (1.1 * self.spread, 0.005, 0.15 * rise), (0, 0, h + 0.45 * rise))
            return *pot, pillar(0.65 * self.spread, h, self.height), arms
        share = {"rosette": 0.85, "aloe": 0.62, "bush": 0.92}[self.kind]
        half = share * self.spread, share * self.spread, 0.5 * rise
        return *pot, Solid("ellipsoid", half, (0, 0, h + 0.5 * rise))

    def aspect(self) -> float:
        return 2 * np.pi * 0.88 * self.pot / (self.pot_height - 0.008)
