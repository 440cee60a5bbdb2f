"""Toys and ornaments with flat sides: miniature houses, toy buses and framed pictures. Lengths in metres; the front looks towards -y."""

from itertools import pairwise
from typing import Literal

import numpy as np

from vap_core.sim.bodies.slabs import box, facet, frustum, panel
from vap_core.sim.shapes import DECORATED, Mesh, Number, Solid, barrel, ellipsoid, join, turn
from vap_core.sim.textures import ACCENT, BASE, DARK, GLASS, INK, LIGHT, METAL, WARM
from vap_core.values import value

Half = tuple[float, float]
PAINTS: dict[str, int] = {"base": BASE, "ink": INK, "accent": ACCENT, "dark": DARK, "light": LIGHT, "warm": WARM}


@value
class House:
    """A house on a base plate; `wide`, `deep` and `eaves` measure its walls, `roof_paint` names a colour of its texture."""

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

    def _roof(self) -> list[tuple[Half, float]]:
        """Half-widths over z, upwards from the eaves."""
        x, y, z, h = self.wide / 2 + 0.003, self.deep / 2 + 0.004, self.plate + self.eaves, self.rise
        match self.roof:
            case "gable":
                return [((x, y), z), ((x, 0.0), z + h)]
            case "hip":
                return [((x, y), z), ((0.3 * x, 0.0), z + h)]
            case "barn":
                return [((x, y), z), ((x, 0.62 * y), z + 0.62 * h), ((x, 0.0), z + h)]
            case "flat":
                return [((x, y), z), ((x, y), z + 0.35 * h), ((0.55 * x, 0.6 * y), z + 0.35 * h), ((0.55 * x, 0.6 * y), z + h)]

    def _windows(self) -> list[Mesh]:
        x, y, floor = self.wide / 2, self.deep / 2, self.eaves / self.storeys
        wide = min(0.013, 0.8 * self.wide / (self.windows + 1))
        high = 0.5 * floor
        pane = join([panel(wide + 0.003, high + 0.003, LIGHT), panel(wide, high, INK, 0.0014), panel(0.0012, high, LIGHT, 0.0018),
                     panel(wide, 0.0012, LIGHT, 0.0018)])  # fmt: skip
        parts = []
        for storey in range(self.storeys):
            z = self.plate + (storey + 0.56) * floor
            spots = (np.arange(self.windows) + 0.5 - self.windows / 2) * self.wide / self.windows
            for around, out, places in ((0.0, y, spots), (np.pi, y, spots), (np.pi / 2, x, [0.0]), (-np.pi / 2, x, [0.0])):
                for s in places:
                    if around == 0 and storey == 0 and abs(s) < 0.009 and self.windows % 2:
                        continue
                    parts.append(pane.moved((float(s), -out, z)).moved(turn=turn(z=around)))
        door = 0.62 * floor
        wide = 0.011 if self.windows % 2 else 0.010
        parts.append(panel(wide, door, ACCENT, 0.0016).moved((0, -y, self.plate + door / 2)))
        parts.append(ellipsoid((0.0009, 0.0009, 0.0009), WARM, 6, 3).moved((0.3 * wide, -y - 0.0018, self.plate + 0.45 * door)))
        return parts

    def mesh(self) -> Mesh:
        x, y, top = self.wide / 2, self.deep / 2, self.plate + self.eaves
        roof, paint = self._roof(), PAINTS[self.roof_paint]
        parts = [box((x + 0.011, y + 0.010), 0, self.plate, ACCENT), box((x, y), self.plate, top, DECORATED), *self._windows()]
        parts += [frustum(low, high, a, b, paint) for (low, a), (high, b) in pairwise(roof)]
        if self.chimney:
            parts.append(box((0.0045, 0.0045), top, top + 1.02 * self.rise, BASE).moved((0.55 * x, 0.35 * y, 0)))
            parts.append(box((0.0055, 0.0055), top + 1.02 * self.rise, top + 1.02 * self.rise + 0.0025, DARK).moved((0.55 * x, 0.35 * y, 0)))
        return join(parts)

    def solids(self) -> tuple[Solid, ...]:
        x, y, h = self.wide / 2, self.deep / 2, self.eaves
        roof = self._roof()
        z = np.linspace(roof[0][1], roof[-1][1], 6)
        heights = [b + 1e-6 * i for i, (_, b) in enumerate(roof)]
        middle = (z[1:] + z[:-1]) / 2
        wide, deep = (np.interp(middle, heights, [half[k] for half, _ in roof]) for k in (0, 1))
        step = float(z[1] - z[0]) / 2
        stack = [Solid("box", (float(a), float(b), step), (0, 0, float(m))) for a, b, m in zip(wide, deep, middle, strict=True)]
        plate = Solid("box", (x + 0.011, y + 0.010, self.plate / 2), (0, 0, self.plate / 2))
        walls, top = Solid("box", (x, y, h / 2), (0, 0, self.plate + h / 2)), self.rise / 2 + 0.0015
        chimney = Solid("box", (0.005, 0.005, top), (0.55 * x, 0.35 * y, self.plate + h + top))
        return plate, walls, *stack, *([chimney] if self.chimney else [])

    def aspect(self) -> float:
        return 2 * (self.wide + self.deep) / self.eaves


@value
class Bus:
    """A toy bus on four wheels; its nose looks towards +x, its door side towards -y."""

    long: float = 0.088
    wide: float = 0.040
    height: float = 0.064
    decks: int = 1
    nose: float = 0.0
    stripe: Literal["base", "ink", "accent", "dark", "light", "warm"] = "light"

    def mesh(self) -> Mesh:
        x, y, h = self.long / 2, self.wide / 2, self.height
        low, belt = 0.009, 0.42 * h if self.decks == 1 else 0.30 * h
        cabin, shift = x - self.nose / 2, -self.nose / 2
        parts = [box((x, y), low, belt, DECORATED), frustum((cabin, y), (cabin - 0.003, y - 0.002), belt, h - 0.004, BASE).moved((shift, 0, 0)),
                 frustum((cabin - 0.003, y - 0.002), (cabin - 0.008, y - 0.007), h - 0.004, h, PAINTS[self.stripe]).moved((shift, 0, 0)),
                 box((x + 0.0015, y + 0.001), low, low + 0.004, DARK)]  # fmt: skip
        tall = (h - 0.004 - belt) / self.decks
        count = 4 if self.decks > 1 or self.nose == 0 else 3
        pitch = (2 * cabin - 0.010) / count
        lean = np.arctan2(0.002, h - belt)
        for deck in range(self.decks):
            z = belt + (deck + 0.48) * tall
            for side in (0.0, np.pi):
                for i in range(count):
                    s = shift * np.cos(side) + (i + 0.5 - count / 2) * pitch
                    glass = panel(0.78 * pitch, 0.62 * tall, GLASS, 0.0016).moved((s, -y + 0.0005 + 0.001 * deck, z), turn(x=-lean))
                    parts.append(glass.moved(turn=turn(z=side)))
            for side, out in ((np.pi / 2, cabin + shift), (-np.pi / 2, cabin - shift)):
                screen = panel(1.5 * y, 0.64 * tall, GLASS, 0.0026)
                parts.append(screen.moved((0, -out + 0.0006 + 0.001 * deck, z)).moved(turn=turn(z=side)))
        forward = turn(z=np.pi / 2)
        for s in (-1, 1):
            lamp = join([panel(0.008, 0.007, METAL, 0.002), panel(0.006, 0.005, WARM, 0.003)])
            parts.append(lamp.moved((0.65 * s * y, -x, low + 0.009)).moved(turn=forward))
        wheel = join([barrel(0.0115, 0.007, DARK, 16), barrel(0.0055, 0.0078, METAL, 10)])
        for s, side in ((-0.58, 1), (0.58, 1), (-0.58, -1), (0.58, -1)):
            parts.append(wheel.moved((s * x, -side * (y - 0.005), 0.0115), turn(x=side * np.pi / 2)))
        return join(parts)

    def solids(self) -> tuple[Solid, ...]:
        x, y, h = self.long / 2, self.wide / 2, self.height
        belt = 0.42 * h if self.decks == 1 else 0.30 * h
        cabin = Solid("box", (x - self.nose / 2 - 0.002, y - 0.001, (h - belt) / 2), (-self.nose / 2, 0, (h + belt) / 2))
        axles = [Solid("box", (0.0085, y + 0.0025, 0.0115), (s * x, 0, 0.0115)) for s in (-0.58, 0.58)]
        return Solid("box", (x, y, (belt - 0.009) / 2), (0, 0, (belt + 0.009) / 2)), cabin, *axles

    def aspect(self) -> float:
        return 2 * (self.long + self.wide) / (0.42 * self.height - 0.009)


@value
class Painting:
    """A framed picture that stands upright on a small easel foot."""

    wide: float = 0.088
    high: float = 0.096
    frame: float = 0.009
    scene: Literal["hills", "sea", "flower", "blocks"] = "hills"
    frame_paint: Literal["base", "ink", "accent", "dark", "light", "warm"] = "warm"
    foot: float = 0.006

    def _scene(self) -> list[Mesh]:
        """Coloured cut-outs before the canvas, in shares of its width and height from its centre."""
        wide, high = self.wide - 2 * self.frame, self.high - 2 * self.frame

        def cut(points: list[tuple[Number, Number]], paint: int, layer: int) -> Mesh:
            x, z = np.array(points).T
            return facet(np.stack([wide * x, np.full_like(x, -0.0005 * layer), high * z], 1), paint)

        def dot(x: Number, z: Number, r: Number, paint: int, layer: int) -> Mesh:
            t = 2 * np.pi * np.arange(16) / 16
            return cut([(x + r * float(np.cos(a)), z + r * float(np.sin(a)) * wide / high) for a in t], paint, layer)

        match self.scene:
            case "hills":
                far = cut([(-0.1, -0.5), (0.5, -0.5), (0.5, -0.05), (0.3, 0.1)], GLASS, 1)
                peak = cut([(-0.5, -0.5), (0.32, -0.5), (-0.16, 0.24)], INK, 2)
                near = cut([(-0.5, -0.5), (0.5, -0.5), (0.5, -0.16), (0.1, -0.2), (-0.5, -0.34)], ACCENT, 3)
                return [dot(0.24, 0.28, 0.12, WARM, 1), far, peak, near, cut([(-0.22, 0.14), (-0.09, 0.14), (-0.16, 0.24)], LIGHT, 3)]
            case "sea":
                water = cut([(-0.5, -0.5), (0.5, -0.5), (0.5, -0.08), (-0.5, -0.08)], INK, 1)
                hull = cut([(-0.16, -0.24), (0.14, -0.24), (0.22, -0.13), (-0.24, -0.13)], DARK, 2)
                sails = [cut([(0.02, -0.1), (0.22, -0.1), (0.02, 0.28)], LIGHT, 3), cut([(-0.02, -0.1), (-0.02, 0.2), (-0.18, -0.1)], ACCENT, 3)]
                return [dot(-0.28, 0.3, 0.1, WARM, 1), water, hull, *sails]
            case "flower":
                petals = [dot(0.17 * float(np.cos(a)), 0.16 + 0.15 * float(np.sin(a)), 0.12, INK, 2) for a in 2 * np.pi * np.arange(5) / 5 + 0.3]
                stem = cut([(-0.02, -0.2), (0.02, -0.2), (0.02, 0.1), (-0.02, 0.1)], DARK, 1)
                pot = cut([(-0.14, -0.44), (0.14, -0.44), (0.2, -0.16), (-0.2, -0.16)], ACCENT, 2)
                return [stem, pot, *petals, dot(0, 0.16, 0.09, WARM, 3)]
            case "blocks":
                fields = [
                    ((-0.5, 0.05, -0.06, 0.5), INK), ((0.0, 0.2, 0.5, 0.5), WARM), ((-0.5, -0.5, -0.2, 0.0), LIGHT),
                    ((-0.14, -0.5, 0.5, -0.22), ACCENT), ((0.0, -0.16, 0.5, 0.14), LIGHT),
                ]  # fmt: skip
                return [cut([(a, b), (c, b), (c, d), (a, d)], paint, 1) for (a, b, c, d), paint in fields]

    def mesh(self) -> Mesh:
        x, h, f, paint = self.wide / 2, self.high, self.frame, PAINTS[self.frame_paint]
        z, y, thick = self.foot, 0.0, 0.005
        canvas = np.array([(-x + f, y, z + f), (x - f, y, z + f), (x - f, y, z + h - f), (-x + f, y, z + h - f)])
        spots = np.array([(0.0, 0.74), (1.0, 0.74), (1.0, 0.004), (0.0, 0.004)])
        rail = frustum((f / 2, thick), (f / 2, thick), 0, h, paint)
        bead = frustum((f / 5, thick + 0.0015), (f / 5, thick + 0.0015), 0.4 * f, h - 0.4 * f, paint)
        parts = [facet(canvas, DECORATED, spots), *(part.moved((0, -0.0005, z + h / 2)) for part in self._scene())]
        parts += [part.moved((s * (x - f / 2), 0, z)) for s in (-1, 1) for part in (rail, bead)]
        parts += [box((x - f, thick), at, at + f, paint) for at in (z, z + h - f)]
        parts += [box((x - 0.5 * f, thick + 0.0015), at + 0.3 * f, at + 0.7 * f, paint) for at in (z, z + h - f)]
        parts.append(box((x - f, 0.0008), z + f, z + h - f, LIGHT).moved((0, 0.0015, 0)))
        parts += [box((0.006, 0.024), 0, z, DARK).moved((s * 0.6 * x, 0.004, 0)) for s in (-1, 1)]
        parts += [box((0.006, 0.003), z, z + 0.006, DARK).moved((s * 0.6 * x, -0.0085, 0)) for s in (-1, 1)]
        brace = frustum((0.003, 0.009), (0.003, 0.002), z, z + 0.6 * h, DARK)
        parts += [brace.moved((s * 0.6 * x, 0.014, 0)) for s in (-1, 1)]
        return join(parts)

    def solids(self) -> tuple[Solid, ...]:
        x, z, h = self.wide / 2, self.foot, self.high
        feet = [Solid("box", (0.006, 0.024, z / 2), (s * 0.6 * x, 0.004, z / 2)) for s in (-1, 1)]
        braces = [Solid("box", (0.003, 0.006, 0.28 * h), (s * 0.6 * x, 0.011, z + 0.28 * h)) for s in (-1, 1)]
        return *feet, Solid("box", (x, 0.006, h / 2), (0, 0, z + h / 2)), *braces

    def aspect(self) -> float:
        return self.wide / self.high
