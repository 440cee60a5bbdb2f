"""Scrubbers knitted as fruit. Lengths are metres."""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.leaves import flat_leaf
from vap_make.objects.bodies.turned import Profile, lathe, tube
from vap_make.objects.shapes import (
    Mesh,
    Solid,
    foot_box,
    join_meshes,
    stacked_cylinders,
)
from vap_make.objects.textures import ACCENT, BASE, DECORATED, INK

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
