"""Bodies that are machined rather than thrown: camera, shaver and can. Lengths in metres; see `bodies`."""

from typing import Literal

import numpy as np

from vap_core.sim.shapes import DECORATED, Mesh, Solid, barrel, block, ellipsoid, foot, join, lathe, pillar, tube, turn
from vap_core.sim.textures import ACCENT, BASE, DARK, GLASS, INK, LIGHT, METAL, WARM
from vap_core.values import value


@value
class CameraBody:
    width: float = 0.068
    height: float = 0.054
    lens: float = 0.0165
    bump: Literal["prism", "finder", "flash", "none"] = "prism"
    strap: bool = False

    def mesh(self) -> Mesh:
        w, h = self.width / 2, self.height
        y, half = 0.005, 0.0145
        cross, high = (w, half, 8.0), 0.74 * h
        parts = [
            lathe([(0, 0), (1, 0)], BASE, 32, cross), lathe([(1, 0), (1, high)], DECORATED, 32, cross, 2),
            lathe([(1, high), (1, h)], ACCENT, 32, cross),
            lathe([(1, h), (0, h)], ACCENT, 32, cross),
        ]  # fmt: skip
        forward, z = turn(x=np.pi / 2), 0.45 * h
        ring = join([barrel(self.lens, 0.006, METAL, 20), barrel(0.86 * self.lens, 0.0105, DARK, 20)])
        glass = ellipsoid((0.55 * self.lens, 0.55 * self.lens, 0.0012), GLASS, 14, 4)
        out = join([part.moved((0, y, 0)) for part in parts])
        parts = [out, ring.moved((0, y - half, z), forward), glass.moved((0, y - half - 0.0105, z), forward)]
        match self.bump:
            case "prism":
                parts.append(block((0.013, 0.012), 0.011, ACCENT).moved((0, y, h)))
                parts.append(block((0.009, 0.0006), 0.0055, DARK).moved((0, y - 0.0122, h + 0.003)))
            case "finder":
                parts.append(block((0.009, 0.010), 0.009, DARK).moved((-0.6 * w, y, h)))
                parts.append(block((0.006, 0.0006), 0.005, LIGHT).moved((-0.6 * w, y - 0.0103, h + 0.002)))
            case "flash":
                parts.append(block((0.014, 0.006), 0.014, DARK).moved((0.42 * w, y, h)))
                parts.append(block((0.011, 0.0006), 0.008, LIGHT).moved((0.42 * w, y - 0.0064, h + 0.004)))
        parts.append(barrel(0.0055, 0.005, METAL, 12, top=DARK).moved((0.68 * w * (-1 if self.bump == "flash" else 1), y, h)))
        parts.append(block((0.005, 0.0006), 0.005, WARM).moved((0.7 * w, y - half - 0.0004, 0.8 * h)))
        if self.strap:
            t = np.linspace(0, np.pi, 9)
            arch = np.stack([w * np.cos(t), np.full_like(t, y), 0.8 * h + 0.03 * np.sin(t)], 1)
            parts.append(tube(arch, 0.0016, INK, 5))
        return join(parts)

    def solids(self) -> tuple[Solid, ...]:
        w, h = self.width / 2, self.height
        lens = Solid("cylinder", (self.lens, 0.006), (0, -0.0140, 0.45 * h), "y")
        return Solid("box", (w, 0.0145, h / 2), (0, 0.005, h / 2)), lens

    def aspect(self) -> float:
        return 2 * (self.width / 2 + 0.0145) / (0.74 * self.height)


@value
class Shaver:
    radius: float = 0.0185
    height: float = 0.112
    head: Literal["foil", "wide", "rotary"] = "foil"
    waist: float = 0.0025
    switch: Literal["round", "bar"] = "round"

    def mesh(self) -> Mesh:
        r, h = self.radius, self.height
        top = 0.74 * h
        wall = [(r - self.waist * float(np.sin(np.pi * t)) ** 2, 0.002 + (top - 0.002) * float(t)) for t in np.linspace(0, 1, 7)]
        parts = [lathe([(0, 0), (r - 0.002, 0)], DARK), lathe([(r - 0.002, 0), (r, 0.002)], DARK), lathe(wall, DECORATED)]
        parts += [lathe([(r, top), (0.7 * r, top + 0.006)], ACCENT), lathe([(0.7 * r, top + 0.006), (0.65 * r, top + 0.012)], DARK)]
        deck, tall = top + 0.012, h - top - 0.012
        match self.head:
            case "foil" | "wide":
                x = 0.020 if self.head == "foil" else 0.026
                parts.append(block((x, 0.0135), 0.55 * tall, ACCENT).moved((0, 0, deck)))
                for y in (-0.0068, 0.0068):
                    bar = ellipsoid((x - 0.002, 0.0052, 0.45 * tall), METAL, 14, 6)
                    parts.append(bar.moved((0, y, deck + 0.55 * tall)))
            case "rotary":
                parts.append(lathe([(0.012, deck), (0.022, deck + 0.5 * tall), (0.021, deck + 0.72 * tall)], ACCENT))
                parts.append(lathe([(0.021, deck + 0.72 * tall), (0, deck + 0.72 * tall)], DARK))
                for a in np.pi / 6 + 2 * np.pi / 3 * np.arange(3):
                    parts.append(barrel(0.0085, 0.28 * tall, METAL, 14).moved((0.0105 * np.cos(a), 0.0105 * np.sin(a), deck + 0.72 * tall)))
        front = -r + 0.6 * self.waist
        if self.switch == "round":
            parts.append(ellipsoid((0.0062, 0.003, 0.0062), METAL, 12, 4).moved((0, front, 0.52 * h)))
        else:
            parts.append(block((0.0042, 0.002), 0.026, METAL).moved((0, front, 0.36 * h)))
        return join(parts)

    def solids(self) -> tuple[Solid, ...]:
        top = 0.74 * self.height
        middle = pillar(self.radius - 0.5 * self.waist, 0.001, top + 0.012)
        half = {"foil": 0.020, "wide": 0.026, "rotary": 0.021}[self.head]
        deep = 0.0125 if self.head != "rotary" else 0.018
        tall = (self.height - top - 0.012) / 2
        return foot(self.radius), middle, Solid("box", (half, deep, tall), (0, 0, self.height - tall))

    def aspect(self) -> float:
        return 2 * np.pi * self.radius / (0.74 * self.height)


@value
class Can:
    radius: float = 0.0215
    height: float = 0.082

    def mesh(self) -> Mesh:
        r, h, e = self.radius, self.height, 0.005
        return join([
            lathe([(0, 0), (0.8 * r, 0)], METAL), lathe([(0.8 * r, 0), (r, e)], METAL), lathe([(r, e), (r, h - 2 * e)], DECORATED),
            lathe([(r, h - 2 * e), (0.82 * r, h)], METAL), lathe([(0.82 * r, h), (0.77 * r, h - 0.002), (0, h - 0.002)], METAL),
            block((0.004, 0.008), 0.0015, DARK).moved((0, -0.003, h - 0.002)),
        ])  # fmt: skip

    def solids(self) -> tuple[Solid, ...]:
        return foot(0.8 * self.radius), pillar(self.radius, 0.001, self.height)

    def aspect(self) -> float:
        return 2 * np.pi * self.radius / (self.height - 0.015)
