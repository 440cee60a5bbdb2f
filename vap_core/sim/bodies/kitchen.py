"""Soft and disposable kitchen things: knitted scrubbers and paper cups. Lengths in metres."""

from typing import Literal

import numpy as np

from vap_core.sim.bodies.plants import flat_leaf
from vap_core.sim.shapes import DECORATED, Mesh, Solid, foot, join, lathe, pillar, tube
from vap_core.sim.textures import ACCENT, BASE, INK, LIGHT
from vap_core.values import value

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
    """A knitted scrubber that stands on its flattened tip, with a crown of leaves and a loop to hang it by; `rows` of stitches bulge by `bump`."""

    outline: Literal["strawberry", "apple", "acorn", "pear", "drum", "ball"] = "strawberry"
    radius: float = 0.0215
    body: float = 0.048
    rows: int = 8
    bump: float = 0.022
    leaves: int = 6
    leaf: float = 0.020
    loop: float = 0.0085

    def mesh(self) -> Mesh:
        from scipy.interpolate import PchipInterpolator

        share, up = np.array(OUTLINES[self.outline]).T
        t = np.linspace(0, 1, 2 * self.rows + 1)
        wave = self.bump * np.where(np.arange(len(t)) % 2, 1.0, -1.0)
        wall = list(zip((self.radius * (PchipInterpolator(up / up[-1], share)(t) + wave)).tolist(), (self.body * t).tolist(), strict=True))
        low, high = wall[0][0], wall[-1][0]
        parts = [lathe([(0, 0), (low, 0)], BASE, 20), lathe(wall, DECORATED, 20), lathe([(high, self.body), (0, self.body + 0.001)], ACCENT, 20)]
        for k in range(self.leaves):
            parts.append(flat_leaf(self.leaf, 0.62 * self.leaf, 2 * np.pi * (k + 0.5) / self.leaves, ACCENT).moved((0, 0, self.body + 0.0008)))
        t = np.linspace(-0.42 * np.pi, 1.42 * np.pi, 11)
        ring = np.stack([0.72 * self.loop * np.cos(t), 0 * t, self.body + self.loop * (1 + np.sin(t))], 1)
        return join([*parts, tube(ring, 0.0017, INK if self.leaves == 0 else ACCENT, 6)])

    def solids(self) -> tuple[Solid, ...]:
        share, up = np.array(OUTLINES[self.outline]).T
        cuts = np.linspace(0.04, 1, 6)
        middle = self.radius * np.interp((cuts[1:] + cuts[:-1]) / 2, up, share)
        stack = [pillar(float(r), float(a) * self.body, float(b) * self.body) for r, a, b in zip(middle, cuts[:-1], cuts[1:], strict=True)]
        loop = Solid("box", (0.8 * self.loop, 0.0017, self.loop), (0, 0, self.body + self.loop))
        return foot(1.3 * OUTLINES[self.outline][0][0] * self.radius), *stack, loop

    def aspect(self) -> float:
        return 2 * np.pi * 0.85 * self.radius / (1.15 * self.body)


@value
class PaperCup:
    """A disposable cup with a rolled rim and a sleeve that wears the decoration; `lid` covers it."""

    low: float = 0.0180
    high: float = 0.0215
    height: float = 0.076
    sleeve: tuple[float, float] = (0.26, 0.70)
    rim: Literal["base", "ink", "accent", "light"] = "light"
    lid: bool = False

    def mesh(self) -> Mesh:
        h, n, inside = self.height, 28, 0.45 * self.height
        rim = {"base": BASE, "ink": INK, "accent": ACCENT, "light": LIGHT}[self.rim]
        top = h - (0.009 if self.lid else 0.0016)

        def on(z: float, proud: float = 0.0) -> tuple[float, float]:
            """The point of the wall at that height."""
            return self.low + (self.high - self.low) * z / h + proud, z

        a, b = (share * h for share in self.sleeve)
        hem, edge = on(a, 0.0008), on(b, 0.0008)
        parts = [
            lathe([(0, 0.002), (self.low - 0.001, 0.002), (self.low - 0.001, 0), (self.low, 0)], BASE, n),
            lathe([(self.low, 0), on(top)], BASE, n),
            lathe([on(a), hem], INK, n), lathe([hem, edge], DECORATED, n), lathe([edge, on(b)], INK, n),
        ]  # fmt: skip
        if self.lid:
            r, step = self.high + 0.001, top + 0.004
            parts += [
                lathe([on(top), (r, top), (r, step)], rim, n), lathe([(r, step), (0.9 * r, step)], rim, n),
                lathe([(0.9 * r, step), (0.86 * r, h)], rim, n), lathe([(0.86 * r, h), (0.78 * r, h), (0.74 * r, h - 0.002), (0, h - 0.002)], rim, n),
            ]  # fmt: skip
        else:
            turns = np.linspace(-0.5 * np.pi, 1.5 * np.pi, 7)
            parts += [
                lathe([(self.high + 0.0016 * float(np.cos(t)), top + 0.0016 * float(np.sin(t))) for t in turns], rim, n),
                lathe([(self.high, top), on(inside)], LIGHT, n), lathe([on(inside), (0, inside)], LIGHT, n),
            ]  # fmt: skip
        return join(parts)

    def solids(self) -> tuple[Solid, ...]:
        cuts = np.linspace(0, self.height, 4)
        middle = self.low + (self.high - self.low) * (cuts[1:] + cuts[:-1]) / 2 / self.height
        stack = [pillar(float(r), max(0.001, float(a)), float(b)) for r, a, b in zip(middle, cuts[:-1], cuts[1:], strict=True)]
        return foot(self.low), *stack

    def aspect(self) -> float:
        a, b = self.sleeve
        return np.pi * (self.low + self.high) / ((b - a) * self.height)
