"""Shoes and slippers, built over a last: a body along x, heel at -x, toe at +x, given by its outline and its top line. Lengths in metres."""

from typing import Literal

import numpy as np

from vap_core.sim.bodies.lofts import curve, loop, sheet
from vap_core.sim.shapes import DECORATED, Mesh, Number, Solid, ellipsoid, join, tube
from vap_core.sim.textures import ACCENT, BASE, DARK, INK, LIGHT
from vap_core.values import value

Knots = tuple[tuple[Number, Number], ...]
TRAINER: Knots = ((0, 0.90), (0.14, 0.88), (0.42, 1.0), (0.6, 0.80), (0.8, 0.60), (0.92, 0.52), (1, 0.40))
MULE: Knots = ((0, 0.40), (0.05, 0.43), (0.17, 0.57), (0.29, 0.70), (0.41, 0.84), (0.53, 0.97), (0.66, 0.99), (0.85, 0.80), (0.95, 0.60), (1, 0.45))
BOOTIE: Knots = ((0, 0.86), (0.2, 0.88), (0.45, 1.0), (0.62, 0.86), (0.85, 0.72), (0.95, 0.56), (1, 0.42))


@value
class Last:
    """A foot's hull of superellipse sections. `top` lists (share of the length from the heel, share of the height); the sole ends at `low`."""

    length: float
    width: float
    height: float
    low: float
    top: Knots
    power: Number = 2.8

    def half(self, s: np.ndarray) -> np.ndarray:
        """Half-width at share s of the length: round at both ends, widest at the ball of the foot."""
        bulge = curve(((0, 0.80), (0.3, 0.76), (0.68, 1.0), (1, 0.96)), 41)
        t = np.clip(2 * s - 1, -1, 1)
        q = np.where(t > 0, 2.5, 3.2)
        return self.width / 2 * np.interp(s, bulge[:, 0], bulge[:, 1]) * (1 - np.abs(t) ** q) ** (1 / q)

    def ridge(self, s: np.ndarray) -> np.ndarray:
        """Height of the top line, metres."""
        line = curve(self.top, 41)
        return self.height * np.interp(s, line[:, 0], line[:, 1])

    def at(self, s: np.ndarray, lift: np.ndarray, proud: Number = 0) -> np.ndarray:
        """Points at shares `s` of the length; `lift` runs from -1 (sole, near side y < 0) over 0 (top line) to 1 (sole, far side)."""
        a = np.pi / 2 * (1 - np.abs(lift))
        side = np.sign(lift)
        wide, tall = self.half(s), self.ridge(s) - self.low
        slope = (self.ridge(s + 0.01) - self.ridge(s - 0.01)) / (0.02 * self.length)
        y, z = side * wide * np.cos(a) ** (2 / self.power), self.low + tall * np.sin(a) ** (2 / self.power)
        out = np.stack(np.broadcast_arrays(-slope * np.sin(a), side * np.cos(a), np.sin(a)), -1)
        out /= np.linalg.norm(out, axis=-1, keepdims=True)
        return np.stack(np.broadcast_arrays(self.length * (s - 0.5), y, z), -1) + proud * out

    def skin(self, start: Number, stop: Number, paint: int, columns: int = 12, rows: int = 6) -> Mesh:
        """The hull from one share of the length to another; decorated, either side shows the whole decoration."""
        first, last = np.arccos(1 - 2 * np.array([start, stop], np.float64)).tolist()
        s = (1 - np.cos(np.linspace(first, last, columns))) / 2
        down = np.broadcast_to(np.linspace(1, 0, rows)[:, None], (rows, columns))
        sides = [self.at(s[None], np.linspace(-1, 0, rows)[:, None]), self.at(s[None, ::-1], np.linspace(1, 0, rows)[:, None])]
        return join([sheet(side, paint, down=down) for side in sides])

    def patch(self, start: Number, stop: Number, low: Number, high: Number, paint: int, proud: Number = 0.0006, slant: Number = 0,
              size: tuple[int, int] = (3, 4)) -> Mesh:  # fmt: skip
        """A piece of material on the hull; `slant` moves its upper edge along the length."""
        lift = np.linspace(low, high, size[1])[:, None]
        s = np.linspace(start, stop, size[0])[None] + slant * np.linspace(0, 1, size[1])[:, None]
        if low > 0 > high or low > high:
            s = s[:, ::-1]
        return sheet(self.at(s, lift, proud), paint)

    def sole(self, paint: int, stripe: int, flare: Number = 1.05, n: int = 9) -> Mesh:
        """A slab under the hull with a stripe around it."""
        s = (1 - np.cos(np.linspace(0, np.pi, n))) / 2
        x, w = self.length * (s - 0.5), self.half(s)
        rim = np.stack([np.concatenate([x, x[::-1]]), np.concatenate([-w, w[::-1]])], 1)
        rim = np.concatenate([rim, rim[:1]])

        def ring(scale: Number, z: Number) -> np.ndarray:
            grow = np.array([1 + (scale - 1) * self.width / self.length, scale])
            return np.column_stack([rim * grow, np.full(len(rim), z)])

        levels = ((flare - 0.06, 0), (flare, 0.3), (flare, 0.55), (flare, 0.8), (flare - 0.02, 1.0), (flare - 0.12, 1.06))
        rows = np.stack([ring(scale, z * self.low) for scale, z in levels])
        ground = np.stack([ring(0, 0), ring(flare - 0.06, 0)])
        return join([sheet(rows[:3], paint), sheet(rows[2:4], stripe), sheet(rows[3:], paint), sheet(ground, paint)])

    def mouth(self, start: Number, stop: Number, share: Number, trim: int, inside: int, thick: float) -> list[Mesh]:
        """The opening for the foot between two shares of the length: lining, the dark way to the toe, and a padded ring."""
        t = np.linspace(0, 2 * np.pi, 15)
        s = (start + stop) / 2 + (stop - start) / 2 * np.sin(t)
        y = -share * self.half(np.clip(s, 0.08, 1)) * np.cos(t)
        z = np.interp(s, (start, stop), self.ridge(np.array([start, stop], np.float64)))
        rim = np.stack([self.length * (s - 0.5), y, z], 1)
        floor = np.stack([rim, np.broadcast_to(rim[:-1].mean(0), rim.shape)]) + np.array([0, 0, 0.0008])
        shade = floor[0] * (0.62, 0.72, 0.62) + (1 - 0.62) * (0.55 * floor[1] + 0.45 * rim[4]) * (1, 0, 1) + np.array([0, 0, 0.0006])
        depth = sheet(np.stack([shade, np.broadcast_to(shade[:-1].mean(0), rim.shape)]), DARK)
        return [sheet(floor, inside), depth, loop(rim, thick, trim)]

    def solids(self, cuts: Knots) -> tuple[Solid, ...]:
        """A foot, the sole's round ends, then for every (start, stop) a wide low block and a narrow high one that leans with the top line."""
        length, low = self.length, self.low
        toe, heel = (float(self.half(np.array([s]))[0]) for s in (0.8, 0.2))
        parts = [
            Solid("box", (0.32 * length, 0.97 * heel, low / 2), (-0.02 * length, 0, low / 2)),
            Solid("cylinder", (toe, low / 2 - 0.0002), (length / 2 - toe, 0, low / 2 + 0.0002)),
            Solid("box", (0.13 * length, 0.98 * self.width / 2, low / 2 - 0.0002), (0.15 * length, 0, low / 2 + 0.0002)),
            Solid("cylinder", (heel, low / 2 - 0.0002), (heel - length / 2, 0, low / 2 + 0.0002)),
        ]
        for start, stop in cuts:
            s = np.linspace(start, stop, 5)
            w, (z0, *_, z1) = float(self.half(s).mean()), self.ridge(s).tolist()
            x, run = length * ((start + stop) / 2 - 0.5), length * (stop - start)
            lean, mid = float(np.arctan2(z0 - z1, run)), (z0 + z1) / 2
            high = 0.55 * min(z0, z1) + 0.45 * low
            parts.append(Solid("box", (run / 2, 0.93 * w, (high - low) / 2), (x, 0, (high + low) / 2)))
            half = (mid - low) * np.cos(lean) / 2
            parts.append(Solid("box", (run / 2, 0.70 * w, half), (x - half * np.sin(lean), 0, mid - half * np.cos(lean) - 0.0005), turn=(0, lean, 0)))
        return tuple(parts)


@value
class Shoe:
    """An athletic shoe; `height` is the top of its tongue."""

    length: float = 0.104
    width: float = 0.044
    height: float = 0.060
    sole: float = 0.0145
    closure: Literal["laces", "straps", "slip"] = "laces"
    side: Literal["bars", "wave", "patch", "none"] = "wave"
    toe: Literal["plain", "cap", "bumper"] = "plain"

    def _last(self) -> Last:
        return Last(self.length, self.width, self.height, self.sole, TRAINER)

    def mesh(self) -> Mesh:
        last = self._last()
        parts = [last.sole(ACCENT, BASE if self.toe == "bumper" else ACCENT), last.skin(0, 1, DECORATED, 13, 6)]
        parts += last.mouth(0.05, 0.45, 0.72, INK if self.closure == "slip" else BASE, DARK, 0.0034)
        if self.toe != "plain":
            paint = ACCENT if self.toe == "cap" else INK
            parts += [last.patch(0.82, 0.995, end, 0, paint, 0.0007, 0, (4, 4)) for end in (-1, 1)]
        parts += self._sides(last)
        match self.closure:
            case "laces":
                parts += [last.patch(0.45, 0.74, end * 0.36, 0, ACCENT, 0.0004, 0, (4, 3)) for end in (-1, 1)]
                for s in (0.48, 0.55, 0.62, 0.69):
                    parts.append(tube(last.at(np.full(5, s), np.linspace(-0.46, 0.46, 5), 0.001), 0.0017, INK, 5))
                knot = last.at(np.array([0.47]), np.array([0.0]), 0.0025)[0]
                for end in (-1, 1):
                    t = np.linspace(0, np.pi, 6)
                    out = end * (0.002 + 0.008 * np.sin(t / 1.3))
                    bow = knot + np.stack([0.009 - 0.006 * np.cos(t), out, 0.0025 * np.sin(t) - 0.004 * t / np.pi], 1)
                    parts.append(tube(bow, 0.0012, INK, 4))
            case "straps":
                for s in (0.47, 0.61):
                    parts += [last.patch(s, s + 0.085, end * 0.75, 0, INK, 0.0014, 0, (2, 4)) for end in (-1, 1)]
            case "slip":
                parts += [last.patch(0.34, 0.42, end * 0.95, end * 0.35, INK, 0.0006, 0, (2, 4)) for end in (-1, 1)]
        return join(parts)

    def _sides(self, last: Last) -> list[Mesh]:
        parts = []
        for end in (-1, 1):
            match self.side:
                case "bars":
                    parts += [last.patch(s, s + 0.05, end * 0.98, end * 0.5, ACCENT, 0.0006, 0.09, (2, 3)) for s in (0.42, 0.52, 0.62)]
                case "wave":
                    s = np.linspace(0.1, 0.68, 11)
                    rise = 0.56 + 0.2 * np.sin(np.pi * ((s - 0.1) / 0.58) ** 0.8)
                    thick = 0.015 + 0.11 * np.sin(np.pi * ((s - 0.1) / 0.58) ** 1.2)
                    rows = np.stack([end * (rise + thick), end * (rise - thick)])
                    wave = last.at(np.stack([s, s]), rows, 0.0007)
                    parts.append(sheet(wave if end < 0 else wave[:, ::-1], ACCENT))
                case "patch":
                    parts.append(last.patch(0.0, 0.17, end * 0.98, end * 0.45, INK, 0.0007, 0, (4, 3)))
        return parts

    def solids(self) -> tuple[Solid, ...]:
        return self._last().solids(((0.02, 0.42), (0.42, 0.62), (0.62, 0.8), (0.8, 0.93), (0.93, 0.99)))

    def aspect(self) -> float:
        return self.length / (0.5 * self.width + 0.55 * self.height)


@value
class Slipper:
    """A padded slipper with a closed toe: open at the heel (mule) or with a collar (bootie)."""

    length: float = 0.106
    width: float = 0.046
    height: float = 0.060
    sole: float = 0.009
    back: Literal["mule", "bootie"] = "mule"
    charm: Literal["none", "bow", "pompom", "ears", "band"] = "none"
    lining: Literal["light", "accent", "ink"] = "accent"

    def _last(self) -> Last:
        return Last(self.length, self.width, self.height, self.sole, MULE if self.back == "mule" else BOOTIE, 2.3)

    def mesh(self) -> Mesh:
        last = self._last()
        inside = {"light": LIGHT, "accent": ACCENT, "ink": INK}[self.lining]
        stop = 0.53 if self.back == "mule" else 0.46
        parts = [last.sole(INK, INK, 1.03), last.skin(0, 1, DECORATED, 13, 7), *last.mouth(0.05, stop, 0.78, INK, inside, 0.0036)]
        top = last.at(np.array([0.72]), np.array([0.0]))[0]
        x, z = float(top[0]), float(top[2])
        match self.charm:
            case "bow":
                for end in (-1, 1):
                    parts.append(ellipsoid((0.0035, 0.0075, 0.005), ACCENT, 9, 5).moved((x, end * 0.0075, z + 0.002)))
                parts.append(ellipsoid((0.0035, 0.003, 0.0035), INK, 8, 4).moved((x + 0.0005, 0, z + 0.0025)))
            case "pompom":
                parts.append(ellipsoid((0.0085, 0.0085, 0.0075), ACCENT, 12, 6).moved((x, 0, z + 0.002)))
            case "ears":
                for end in (-1, 1):
                    eye = last.at(np.array([0.87]), np.array([0.34 * end]))[0]
                    parts.append(ellipsoid((0.0035, 0.0075, 0.0115), BASE, 9, 5).moved((x - 0.008, end * 0.0115, z + 0.003)))
                    parts.append(ellipsoid((0.003, 0.0045, 0.0075), INK, 8, 4).moved((x - 0.0065, end * 0.0115, z + 0.003)))
                    parts.append(ellipsoid((0.003, 0.0032, 0.0034), DARK, 8, 4).moved((float(eye[0]), float(eye[1]), float(eye[2]))))
                snout = last.at(np.array([0.94]), np.array([0.0]))[0]
                parts.append(ellipsoid((0.004, 0.0045, 0.0035), INK, 9, 4).moved((float(snout[0]), 0, float(snout[2]))))
            case "band":
                parts += [last.patch(0.62, 0.76, end * 0.98, 0, ACCENT, 0.0008, 0, (2, 6)) for end in (-1, 1)]
        return join(parts)

    def solids(self) -> tuple[Solid, ...]:
        last = self._last()
        x, _, z = (float(v) for v in last.at(np.array([0.72]), np.array([0.0]))[0])
        match self.charm:
            case "ears":
                charm = [Solid("ellipsoid", (0.0035, 0.0075, 0.0115), (x - 0.008, end * 0.0115, z + 0.003)) for end in (-1, 1)]
            case "pompom":
                charm = [Solid("ellipsoid", (0.0085, 0.0085, 0.0075), (x, 0, z + 0.002))]
            case "bow":
                charm = [Solid("ellipsoid", (0.0035, 0.014, 0.005), (x, 0, z + 0.002))]
            case _:
                charm = []
        return *last.solids(((0.02, 0.27), (0.27, 0.52), (0.52, 0.78), (0.78, 0.93), (0.93, 0.99))), *charm

    def aspect(self) -> float:
        return self.length / (0.5 * self.width + 0.7 * self.height)
