"""Leaves of plants and crowns. Lengths are metres."""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.parts import Profile, arc_profile, ellipsoid, lathe, tube
from vap_make.objects.shapes import (
    Mesh,
    Number,
    Solid,
    foot_box,
    join_meshes,
    rotation_matrix,
    stacked_cylinders,
    upright_cylinder,
)
from vap_make.objects.textures import ACCENT, BASE, DARK, DECORATED, INK, SWATCHES


def thick_leaf(
    length: Number,
    width: Number,
    thickness: Number,
    lean: Number,
    around: Number,
    curl: Number,
    blunt: Number,
    tip: int,
) -> Mesh:
    """A thick pointed leaf from the origin, `lean` radians off vertical towards `around`.

    `curl` bends its end up by curl * length metres; `blunt` is 0 (needle) to 1 (round); `tip` is
    the swatch of its end.
    """
    section = (width / 2, thickness / 2, 2)
    shoulder = (blunt, 0.82 * length)
    blade = join_meshes(
        [
            lathe([(0.6, 0), (1, 0.5 * length), shoulder], INK, 6, section),
            lathe([shoulder, (0, length)], tip, 6, section),
        ]
    )
    height = blade.vertex[:, 2]
    vertex = blade.vertex + np.outer(curl * height**2 / length, [0, 1, 0])
    slope = np.arctan(2 * curl * height / length)
    x, y, z = blade.normal.T
    normal = np.column_stack(
        [x, y * np.cos(slope) + z * np.sin(slope), z * np.cos(slope) - y * np.sin(slope)]
    )
    curled = Mesh(vertex=vertex, normal=normal, uv=blade.uv, face=blade.face)
    return _lean_outwards(curled, lean, around)


def flat_leaf(length: Number, width: Number, around: Number, swatch: int) -> Mesh:
    """A thin leaf that grows outwards from the axis and droops at its end."""
    outline = [(0.7, 0), (1, 0.45 * length), (0.75, 0.75 * length), (0, length)]
    blade = lathe(outline, swatch, 6, section=(width / 2, 0.0009, 2))
    vertex = blade.vertex - np.outer(0.42 * blade.vertex[:, 2] ** 2 / length, [0, 1, 0])
    drooping = Mesh(vertex=vertex, normal=blade.normal, uv=blade.uv, face=blade.face)
    return _lean_outwards(drooping, 1.45, around)


def _lean_outwards(leaf: Mesh, lean: Number, around: Number) -> Mesh:
    leaning = leaf.moved(rotation=rotation_matrix(x=lean))
    return leaning.moved(rotation=rotation_matrix(z=around + np.pi / 2))


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


OUTLINES: dict[str, tuple[tuple[float, float], ...]] = {
    "strawberry": ((0.50, 0.0), (0.72, 0.16), (0.97, 0.55), (1.0, 0.70), (0.86, 0.90), (0.50, 1.0)),
    "apple": ((0.66, 0.0), (0.92, 0.18), (1.0, 0.50), (0.95, 0.78), (0.70, 0.95), (0.30, 0.97)),
    "acorn": ((0.58, 0.0), (0.84, 0.20), (0.98, 0.45), (1.0, 0.62), (0.72, 0.86), (0.34, 1.0)),
    "pear": ((0.72, 0.0), (1.0, 0.26), (0.95, 0.50), (0.78, 0.74), (0.60, 0.92), (0.28, 1.0)),
    "drum": ((0.80, 0.0), (1.0, 0.12), (1.0, 0.50), (1.0, 0.84), (0.80, 0.97), (0.28, 1.0)),
    "ball": ((0.66, 0.0), (0.90, 0.22), (1.0, 0.52), (0.88, 0.80), (0.58, 0.95), (0.28, 1.0)),
}
"""(share of the radius, share of the height) from the flat underside to the crown."""


@value
class Scrubber:
    """A knitted scrubber on its flattened tip, with a crown of leaves and a loop to hang it by.

    `body` is the height without the loop; its `rows` of stitches bulge by `bump` of the radius;
    `leaf` is a leaf's length, `loop` the loop's radius.
    """

    outline: Literal["strawberry", "apple", "acorn", "pear", "drum", "ball"] = "strawberry"
    radius: float = 0.0215
    body: float = 0.048
    rows: int = 8
    bump: float = 0.022
    leaves: int = 6
    leaf: float = 0.020
    loop: float = 0.0085

    def mesh(self) -> Mesh:
        wall = self._wall()
        low, high = wall[0][0], wall[-1][0]
        parts = [
            lathe([(0, 0), (low, 0)], BASE, 20),
            lathe(wall, DECORATED, 20),
            lathe([(high, self.body), (0, self.body + 0.001)], ACCENT, 20),
        ]
        for k in range(self.leaves):
            around = 2 * np.pi * (k + 0.5) / self.leaves
            leaf = flat_leaf(self.leaf, 0.62 * self.leaf, around, ACCENT)
            parts.append(leaf.moved((0, 0, self.body + 0.0008)))
        return join_meshes([*parts, self._loop()])

    def _wall(self) -> Profile:
        from scipy.interpolate import PchipInterpolator

        share, up = np.array(OUTLINES[self.outline]).T
        t = np.linspace(0, 1, 2 * self.rows + 1)
        wave = self.bump * np.where(np.arange(len(t)) % 2, 1.0, -1.0)
        radii = self.radius * (PchipInterpolator(up / up[-1], share)(t) + wave)
        return list(zip(radii.tolist(), (self.body * t).tolist(), strict=True))

    def _loop(self) -> Mesh:
        t = np.linspace(-0.42 * np.pi, 1.42 * np.pi, 11)
        x, z = 0.72 * self.loop * np.cos(t), self.body + self.loop * (1 + np.sin(t))
        swatch = ACCENT
        if self.leaves == 0:
            swatch = INK
        return tube(np.stack([x, 0 * t, z], 1), 0.0017, swatch)

    def solids(self) -> tuple[Solid, ...]:
        share, up = np.array(OUTLINES[self.outline]).T
        cuts = np.linspace(0.04, 1, 6)
        radii = self.radius * np.interp((cuts[1:] + cuts[:-1]) / 2, up, share)
        loop = Solid("box", (0.8 * self.loop, 0.0017, self.loop), (0, 0, self.body + self.loop))
        foot = foot_box(1.3 * OUTLINES[self.outline][0][0] * self.radius)
        return foot, *stacked_cylinders(radii, cuts * self.body), loop

    def aspect(self) -> float:
        return 2 * np.pi * 0.85 * self.radius / (1.15 * self.body)
