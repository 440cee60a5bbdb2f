"""Potted plants: rosettes, aloes, cacti and bushes.

Lengths are metres; the pot shows the decoration, the plant the texture's ink and accent.
"""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.leaves import thick_leaf
from vap_make.objects.bodies.turned import Profile, arc_profile, ellipsoid, lathe
from vap_make.objects.shapes import (
    Mesh,
    Number,
    Solid,
    foot_box,
    join_meshes,
    upright_cylinder,
)
from vap_make.objects.textures import ACCENT, BASE, DARK, DECORATED, INK, SWATCHES


@value
class Plant:
    """A plant in a small pot.

    `pot` is the pot's radius, `height` the whole plant's, `spread` the radius of its leaves;
    `leaves` counts those in the outer ring; `blunt` is 0 (needle) to 1 (round).
    """

    kind: Literal["rosette", "aloe", "cactus", "bush"] = "rosette"
    pot: float = 0.0195
    pot_height: float = 0.036
    height: float = 0.060
    spread: float = 0.027
    leaves: int = 7
    blunt: float = 0.80
    tips: Literal["ink", "accent"] = "accent"
    rim: Literal["base", "accent", "none"] = "base"

    def mesh(self) -> Mesh:
        match self.kind:
            case "rosette":
                plant = self._rosette()
            case "aloe":
                plant = self._aloe()
            case "cactus":
                plant = self._cactus()
            case "bush":
                plant = self._bush()
        return join_meshes([*self._pot(), *plant])

    def _pot(self) -> list[Mesh]:
        r, h = self.pot, self.pot_height
        lip, rim = BASE, 0.0
        if self.rim != "none":
            lip, rim = SWATCHES[self.rim], 0.0016
        return [
            lathe([(0, 0), (0.80 * r, 0)], BASE, 20),
            lathe([(0.80 * r, 0), (r - rim, h - 0.008)], DECORATED, 20),
            lathe([(r - rim, h - 0.008), (r, h - 0.008)], lip, 20),
            lathe([(r, h - 0.008), (r, h)], lip, 20),
            lathe([(r, h), (r - 0.003, h)], lip, 20),
            lathe([(r - 0.003, h), (r - 0.003, h - 0.003), (0, h - 0.003)], DARK, 20),
        ]

    def _whorl(
        self,
        count: int,
        start: Number,
        low: Number,
        length: Number,
        width: Number,
        thickness: Number,
        lean: Number,
        curl: Number,
        blunt: Number,
    ) -> list[Mesh]:
        """`count` leaves around the axis, which grow from height `low`.

        `start` shifts the first by a share of the gap between two.
        """
        whorl = []
        for angle in 2 * np.pi * (np.arange(count) + start) / count:
            leaf = thick_leaf(
                length=length,
                width=width,
                thickness=thickness,
                lean=lean,
                around=float(angle),
                curl=curl,
                blunt=blunt,
                tip=SWATCHES[self.tips],
            )
            whorl.append(leaf.moved((0, 0, low)))
        return whorl

    def _rosette(self) -> list[Mesh]:
        rise, length, n = self.height - self.pot_height, 1.12 * self.spread, self.leaves
        width = min(2.9 * self.spread / n, 0.5 * length)
        whorls = (  # leaves, lean, shares of the length and of the width
            (n, 1.30, 1.0, 1.25),
            (n, 0.98, 0.92, 1.2),
            (n - 2, 0.62, 0.84, 1.1),
            (n // 2, 0.22, 0.80, 0.8),
        )
        parts = []
        for i, (count, lean, length_share, width_share) in enumerate(whorls):
            parts += self._whorl(
                count=count,
                start=0.5 * (i % 2),
                low=self.pot_height - 0.001 + 0.0012 * i,
                length=min(length * length_share, 1.08 * rise / float(np.cos(lean))),
                width=width * width_share,
                thickness=0.5 * (width * width_share),
                lean=lean,
                curl=0.28,
                blunt=self.blunt,
            )
        return parts

    def _aloe(self) -> list[Mesh]:
        rise = self.height - self.pot_height
        whorls = (  # leaves, lean, share of the height
            (self.leaves, 0.72, 0.98),
            (self.leaves - 2, 0.40, 1.0),
            (3, 0.12, 0.97),
        )
        parts = []
        for i, (count, lean, share) in enumerate(whorls):
            parts += self._whorl(
                count=count,
                start=0.5 * (i % 2),
                low=self.pot_height - 0.001,
                length=min(share * rise / float(np.cos(lean)), 1.4 * self.spread),
                width=0.0085,
                thickness=0.0055,
                lean=lean,
                curl=0.1,
                blunt=0.5 * self.blunt,
            )
        return parts

    def _cactus(self) -> list[Mesh]:
        """A ribbed trunk, two arms and a flower."""
        rise, low = self.height - self.pot_height, self.pot_height - 0.002
        parts = [self._cactus_trunk(rise).moved((0, 0, low))]
        for side, elbow_share, length_share in ((1, 0.42, 0.40), (-1, 0.28, 0.32)):
            elbow = ellipsoid((0.36 * self.spread, 0.0048, 0.0048), INK, segments=8, rows=5)
            arm = ellipsoid((0.0050, 0.0050, length_share * rise / 1.7), INK, segments=8, rows=6)
            elbow_z = low + elbow_share * rise
            arm_z = low + (elbow_share + 0.5 * length_share) * rise
            parts.append(elbow.moved((side * 0.74 * self.spread, 0, elbow_z)))
            parts.append(arm.moved((side * 0.98 * self.spread, 0, arm_z)))
        flower = ellipsoid((0.0055, 0.0055, 0.0035), ACCENT, segments=8, rows=4)
        parts.append(flower.moved((0, 0, low + rise)))
        return parts

    def _cactus_trunk(self, rise: Number) -> Mesh:
        dome = arc_profile((0.0, 0.6 * rise), (1.0, 0.4 * rise), np.linspace(0, np.pi / 2, 5))
        radius = 0.65 * self.spread
        outline: Profile = []
        for share, z in [(0.8, 0.0), (1.0, 0.35 * rise), *dome]:
            outline.append((radius * share, z))
        trunk = lathe(outline, INK, 24)
        around = np.arctan2(trunk.vertex[:, 1], trunk.vertex[:, 0])
        rib = 1 + 0.13 * np.cos(self.leaves * around)
        vertex = trunk.vertex * np.stack([rib, rib, np.ones_like(rib)], 1)
        return Mesh(vertex=vertex, normal=trunk.normal, uv=trunk.uv, face=trunk.face)

    def _bush(self) -> list[Mesh]:
        rise, low = self.height - self.pot_height, self.pot_height
        core = (0.62 * self.spread, 0.62 * self.spread, 0.42 * rise)
        parts = [ellipsoid(core, INK, segments=10, rows=6).moved((0, 0, low + 0.55 * rise))]
        tuft = (0.36 * self.spread, 0.36 * self.spread, 0.26 * rise)
        for k in range(self.leaves):
            angle, up = 2.4 * k, 0.2 + 0.55 * k / self.leaves
            out = self.spread * (0.68 - 0.28 * up)
            place = (out * np.cos(angle), out * np.sin(angle), low + up * rise)
            swatch = (INK, INK, ACCENT)[k % 3]
            parts.append(ellipsoid(tuft, swatch, segments=8, rows=4).moved(place))
        return parts

    def solids(self) -> tuple[Solid, ...]:
        r, h, rise = self.pot, self.pot_height, self.height - self.pot_height
        pot = (
            foot_box(0.80 * r),
            upright_cylinder(0.87 * r, 0.001, h / 2),
            upright_cylinder(0.97 * r, h / 2, h),
        )
        if self.kind == "cactus":
            trunk = upright_cylinder(0.65 * self.spread, h, self.height)
            arms = Solid("box", (1.1 * self.spread, 0.005, 0.15 * rise), (0, 0, h + 0.45 * rise))
            return *pot, trunk, arms
        share = {"rosette": 0.85, "aloe": 0.62, "bush": 0.92}[self.kind]
        half = share * self.spread, share * self.spread, 0.5 * rise
        return *pot, Solid("ellipsoid", half, (0, 0, h + 0.5 * rise))

    def aspect(self) -> float:
        return 2 * np.pi * 0.88 * self.pot / (self.pot_height - 0.008)
