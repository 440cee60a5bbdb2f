"""The bodies of the categories: each is a few lengths in metres that give a mesh, its collision solids and its wall's aspect.

At half to three quarters of its height every body is 34 to 44 mm wide across any yaw (the camera: along y), for two fingers from above.
"""

from typing import Literal

import numpy as np

from vap_core.sim.shapes import DECORATED, Mesh, Number, Profile, Solid, barrel, ellipsoid, foot, handle, join, lathe, pillar, tube, turn
from vap_core.sim.textures import ACCENT, BASE, DARK, INK, LIGHT, METAL, WARM
from vap_core.values import value


def _curve(knots: Profile, rows: int) -> Profile:
    """A smooth profile through the knots (radius over z)."""
    from scipy.interpolate import PchipInterpolator

    r, z = np.array(knots).T
    zs = np.linspace(z[0], z[-1], rows)
    return list(zip(PchipInterpolator(z, r)(zs).tolist(), zs.tolist(), strict=True))


def _hollow(low: float, high: float, height: float, wall: float, deep: float, rim: int, inside: int, n: int = 24) -> list[Mesh]:
    """Base, decorated outer wall, rim and inner wall of a vessel; radii at its base and rim."""
    edge = min(0.0025, 0.1 * low)
    return [
        lathe([(0, 0), (low - edge, 0)], BASE, n),
        lathe([(low - edge, 0), (low, edge)], BASE, n),
        lathe([(low, edge), (high, height)], DECORATED, n),
        lathe([(high, height), (high - wall / 2, height + wall / 2), (high - wall, height)], rim, n),
        lathe([(high - wall, height), (low - wall, height - deep)], inside, n),
        lathe([(low - wall, height - deep), (0, height - deep)], inside, n),
    ]


@value
class Cup:
    low: float = 0.0195
    high: float = 0.0215
    height: float = 0.072
    grip: Literal["round", "square", "ear"] = "round"
    reach: float = 0.017
    rim: Literal["base", "ink", "accent"] = "base"

    def mesh(self) -> Mesh:
        colour = {"base": BASE, "ink": INK, "accent": ACCENT}[self.rim]
        bar = handle(self.grip, (self.low + self.high) / 2, 0.24 * self.height, 0.8 * self.height, self.reach, 0.0033, colour)
        return join([*_hollow(self.low, self.high, self.height - 0.0012, 0.0024, 0.8 * self.height, colour, LIGHT, 28), bar])

    def solids(self) -> tuple[Solid, ...]:
        r = (self.low + self.high) / 2
        bar = Solid("box", (self.reach / 2, 0.003, 0.26 * self.height), (r + self.reach / 2, 0, 0.52 * self.height))
        return foot(self.low), pillar(r, 0.001, self.height), bar

    def aspect(self) -> float:
        return np.pi * (self.low + self.high) / self.height


@value
class Bottle:
    radius: float = 0.020
    height: float = 0.115
    shoulder: float = 0.70
    neck: float = 0.0085
    cap: Literal["screw", "sport", "ball"] = "screw"
    waist: float = 0.0

    def mesh(self) -> Mesh:
        r, h, n = self.radius, self.height, self.neck
        top, cap_z = self.shoulder * h, h - 0.018
        wall = [(r - self.waist * np.sin(np.pi * t) ** 2, 0.002 + (top - 0.002) * t) for t in np.linspace(0, 1, 7 if self.waist else 2)]
        parts = [
            lathe([(0, 0), (r - 0.002, 0)], BASE), lathe([(r - 0.002, 0), (r, 0.002)], BASE), lathe(wall, DECORATED),
            lathe(_curve([(r, top), (0.8 * r, top + 0.35 * (cap_z - top)), (n, cap_z - 0.003), (n, cap_z)], 6), BASE, 20),
        ]  # fmt: skip
        match self.cap:
            case "screw":
                parts.append(barrel(n + 0.0025, 0.018, INK, 16).moved((0, 0, cap_z)))
            case "sport":
                parts += [barrel(n + 0.005, 0.007, INK, 16).moved((0, 0, cap_z)), barrel(0.0045, 0.011, ACCENT, 12).moved((0, 0, cap_z + 0.007))]
            case "ball":
                parts.append(ellipsoid((0.0105, 0.0105, 0.009), INK, 14).moved((0, 0, h - 0.009)))
        return join(parts)

    def solids(self) -> tuple[Solid, ...]:
        top = self.shoulder * self.height + 0.004
        return foot(self.radius), pillar(self.radius, 0.001, top), pillar(self.neck + 0.002, top, self.height)

    def aspect(self) -> float:
        return 2 * np.pi * self.radius / (self.shoulder * self.height)


@value
class PenHolder:
    radius: float = 0.0205
    height: float = 0.080
    sides: Literal[4, 6, 24] = 24
    pens: int = 4
    rim: Literal["base", "ink", "accent"] = "accent"

    def mesh(self) -> Mesh:
        r, h = self.radius, self.height
        rim = {"base": BASE, "ink": INK, "accent": ACCENT}[self.rim]
        parts = _hollow(r, r, h - 0.0015, 0.003, 0.55 * h, rim, DARK, 24)
        if self.sides != 24:
            flat = r if self.sides == 6 else r * 0.97
            parts = [_prism(part, self.sides, flat) for part in parts]
        for i in range(self.pens):
            a = 2 * np.pi * i / self.pens + 0.7
            inner, outer = 0.35 * r, 0.68 * r
            foot_m = np.array([inner * np.cos(a), inner * np.sin(a), 0.5 * h])
            tip = np.array([outer * np.cos(a), outer * np.sin(a), 0.113 - 0.006 * (i % 3)])
            nib = tip + 0.09 * (tip - foot_m)
            paint = (WARM, ACCENT, DARK, INK, METAL)[i % 5]
            parts += [tube(np.stack([foot_m, tip]), 0.0029, paint), tube(np.stack([tip, nib]), 0.0015, (DARK, LIGHT)[i % 2], 5)]
        return join(parts)

    def solids(self) -> tuple[Solid, ...]:
        r = self.radius if self.sides != 4 else self.radius * 0.97
        body = pillar(r, 0.001, self.height) if self.sides != 4 else Solid("box", (r, r, self.height / 2 - 0.0005), (0, 0, self.height / 2 + 0.0005))
        return foot(r), body, pillar(0.6 * r, self.height, 0.112)

    def aspect(self) -> float:
        return 2 * np.pi * self.radius / self.height


def _prism(part: Mesh, sides: int, half: float) -> Mesh:
    """The round part pressed into a regular polygon with the given distance from centre to side."""
    reach = np.hypot(part.vertex[:, 0], part.vertex[:, 1])
    phi = np.arctan2(part.vertex[:, 1], part.vertex[:, 0])
    step = 2 * np.pi / sides
    side = np.round((phi + np.pi / 2) / step) * step - np.pi / 2
    scale = half / np.maximum(reach.max(), 1e-9) / np.cos(phi - side)
    vertex = part.vertex * np.stack([scale, scale, np.ones_like(scale)], 1)
    level = np.hypot(part.normal[:, 0], part.normal[:, 1])
    sign = np.sign((part.normal[:, :2] * part.vertex[:, :2]).sum(1))
    flat = 0.6 * np.stack([np.cos(side), np.sin(side)], 1) + 0.4 * np.stack([np.cos(phi), np.sin(phi)], 1)
    normal = np.column_stack([flat * (level * sign)[:, None], part.normal[:, 2]])
    return Mesh(vertex, normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12), part.uv, part.face)


@value
class StrawCup:
    low: float = 0.0165
    high: float = 0.0215
    height: float = 0.080
    lid: Literal["flat", "dome", "step"] = "flat"
    bend: bool = True

    def mesh(self) -> Mesh:
        h, r = self.height, self.high + 0.0015
        parts = [
            lathe([(0, 0), (self.low, 0)], BASE),
            lathe([(self.low, 0), (self.high, h)], DECORATED),
            lathe([(self.high, h - 0.001), (r, h - 0.001)], INK),
        ]
        match self.lid:
            case "flat":
                parts += [lathe([(r, h - 0.001), (r, h + 0.006)], INK), lathe([(r, h + 0.006), (0, h + 0.006)], INK)]
            case "dome":
                arc = [(r * np.cos(t), h + 0.003 + 0.014 * np.sin(t)) for t in np.linspace(0, np.pi / 2, 6)]
                parts += [lathe([(r, h - 0.001), (r, h + 0.003)], INK), lathe(arc, LIGHT)]
            case "step":
                parts += [lathe([(r, h - 0.001), (r, h + 0.004)], INK), lathe([(r, h + 0.004), (0.7 * r, h + 0.004)], INK)]
                parts += [lathe([(0.7 * r, h + 0.004), (0.66 * r, h + 0.011)], INK), lathe([(0.66 * r, h + 0.011), (0, h + 0.011)], INK)]
        top = [0.004, 0, 0.119]
        bend = [[0.003, 0, 0.108], [0.0145, 0, 0.1155]] if self.bend else [top]
        return join([*parts, tube(np.array([[0.001, 0, h], *bend]), 0.0028, ACCENT, 7)])

    def solids(self) -> tuple[Solid, ...]:
        low, mid = (2 * self.low + self.high) / 3, 0.45 * self.height
        return (
            foot(self.low),
            pillar(low, 0.001, mid),
            pillar(self.high - 0.0008, mid, self.height + 0.006),
            pillar(0.004, self.height + 0.006, 0.117),
        )

    def aspect(self) -> float:
        return np.pi * (self.low + self.high) / self.height


@value
class Owl:
    height: float = 0.078
    belly: float = 0.0215
    ears: Literal["tuft", "wide", "none"] = "tuft"
    eye: float = 0.0072
    wings: Literal["folded", "spread"] = "folded"

    def mesh(self) -> Mesh:
        h, r = self.height, self.belly
        f = 0.91 if self.ears != "none" else 1.0
        wall = _curve([(0.8 * r, 0), (r, 0.3 * h * f), (0.88 * r, 0.6 * h * f)], 6)
        head = _curve([(0.88 * r, 0.6 * h * f), (0.93 * r, 0.74 * h * f), (0.62 * r, 0.93 * h * f)], 5)
        parts = [
            lathe([(0, 0), (0.8 * r, 0)], BASE, 20),
            lathe(wall, DECORATED),
            lathe(head, INK),
            lathe([head[-1], (0.3 * r, 0.985 * h * f), (0, h * f)], INK),
        ]
        z, y = 0.755 * h * f, -0.76 * r
        for side in (-1, 1):
            face = turn(z=0.4 * side)
            x = side * 0.37 * r
            parts.append(ellipsoid((1.28 * self.eye, 0.004, 1.28 * self.eye), ACCENT, 14, 4).moved((x, y + 0.0012, z), face))
            parts.append(ellipsoid((self.eye, 0.004, self.eye), LIGHT, 14, 4).moved((x, y - 0.0008, z), face))
            parts.append(ellipsoid((0.5 * self.eye, 0.003, 0.5 * self.eye), DARK, 10, 4).moved((x + 0.0013 * side, y - 0.0031, z), face))
            parts.append(ellipsoid((0.0055, 0.0055, 0.003), WARM, 8, 4).moved((0.42 * side * r, -0.8 * r, 0.003)))
            tilt = turn(y=-side * (0.12 if self.wings == "folded" else 0.3))
            parts.append(ellipsoid((0.0036, 0.0115, 0.26 * h), INK, 10, 6).moved((side * 0.87 * r, 0.002, 0.36 * h), tilt))
            if self.ears != "none":
                lean, width = (0.22, 0.0058) if self.ears == "tuft" else (0.5, 0.0085)
                cone = lathe([(width, 0), (0, 0.17 * h)], INK, 8)
                parts.append(cone.moved((side * 0.45 * r, 0, 0.86 * h), turn(y=side * lean)))
        parts.append(lathe([(0.0042, 0), (0, 0.009)], WARM, 8).moved((0, y - 0.001, z - 0.004), turn(x=2.2)))
        return join(parts)

    def solids(self) -> tuple[Solid, ...]:
        h, r = self.height, self.belly
        return foot(0.8 * r), pillar(0.9 * r, 0.001, 0.15 * h), pillar(0.97 * r, 0.15 * h, 0.5 * h), pillar(0.87 * r, 0.5 * h, 0.86 * h)

    def aspect(self) -> float:
        return 2 * np.pi * 0.93 * self.belly / (0.57 * self.height)


@value
class Vase:
    """`knots` are (radius, share of the height), base to lip."""

    height: float = 0.110
    knots: tuple[tuple[Number, Number], ...] = ((0.0155, 0.0), (0.0215, 0.5), (0.0195, 0.7), (0.0095, 0.88), (0.0135, 1.0))
    handles: bool = False

    def mesh(self) -> Mesh:
        wall = _curve([(r, self.height * z) for r, z in self.knots], 14)
        low, lip = self.knots[0][0], self.knots[-1][0]
        inside = [(lip - 0.002, self.height), (0.7 * lip, 0.9 * self.height), (0, 0.88 * self.height)]
        parts = [
            lathe([(0, 0), (low, 0)], BASE, 22),
            lathe(wall, DECORATED, 22),
            lathe([wall[-1], (lip - 0.002, self.height)], ACCENT, 22),
            lathe(inside, DARK, 22),
        ]
        if self.handles:
            bar = handle("round", 0.0105, 0.72 * self.height, 0.93 * self.height, 0.0125, 0.0022, ACCENT)
            parts += [bar, bar.moved(turn=turn(z=np.pi))]
        return join(parts)

    def solids(self) -> tuple[Solid, ...]:
        r, z = np.array(self.knots).T
        cuts = np.array([0.009, 0.25, 0.45, 0.6, 0.75, 0.87, 1.0])
        middle = np.interp((cuts[1:] + cuts[:-1]) / 2, z, r)
        stack = [pillar(float(m), float(a) * self.height, float(b) * self.height) for m, a, b in zip(middle, cuts[:-1], cuts[1:], strict=True)]
        return foot(self.knots[0][0]), *stack

    def aspect(self) -> float:
        return 2 * np.pi * 0.017 / (1.03 * self.height)
