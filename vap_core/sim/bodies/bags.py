"""Bags: leather cases with a flap, a clasp and a handle, and round pouches with a zipper. Lengths in metres; fronts face -y."""

from typing import Literal

import numpy as np

from vap_core.sim.bodies.lofts import arc, limbs, loop, reshaped, rings, sheet
from vap_core.sim.shapes import DECORATED, Mesh, Number, Profile, Solid, barrel, block, ellipsoid, join, lathe, tube, turn
from vap_core.sim.textures import ACCENT, BASE, DARK, INK, METAL, WARM
from vap_core.values import value

GRIPS = {"arch": (0.0029, INK), "flat": (0.0032, ACCENT), "twin": (0.0024, INK)}
"""Half-thickness (m) and paint of a bag's handles."""


@value
class LeatherBag:
    """A case of `width` x `depth`; `height` is the body's, the handle stands on it. The flap covers a share of the front."""

    width: float = 0.092
    depth: float = 0.034
    height: float = 0.060
    flap: Literal["square", "round", "point", "none"] = "square"
    cover: float = 0.52
    clasp: Literal["lock", "buckles", "button", "none"] = "lock"
    handle: Literal["arch", "flat", "twin"] = "arch"
    hardware: Literal["metal", "gold"] = "metal"

    def _front(self, z: Number, x: Number = 0) -> float:
        """The body's half-depth at a height, which narrows towards the top, and at a distance x from its middle, where its corners are round."""
        share = float(z) / self.height
        edge = abs(float(x)) / (self.width / 2 * (1 - 0.04 * share))
        return self.depth / 2 * (1 - 0.16 * share) * max(0.0, 1 - edge**7) ** (1 / 7)

    def mesh(self) -> Mesh:
        w, h = self.width / 2, self.height
        z = np.linspace(0, h, 4)
        levels = np.stack([z, 0 * z, w * (1 - 0.04 * z / h), [self._front(v) for v in z]], 1)
        levels[0, 2:] *= 0.985
        floor = np.stack([[0, 0, 0, 0], levels[0]])
        parts = [rings(floor, BASE, 24, 7), rings(levels, DECORATED, 32, 7),
                 rings(np.stack([levels[-1], [h + 0.001, 0, 0.9 * levels[-1, 2], 0.75 * levels[-1, 3]]]), BASE, 24, 7, shut=True)]  # fmt: skip
        parts += [self._seam(), *self._flap(), *self._clasp(), *self._handle()]
        return join(parts)

    def _seam(self) -> Mesh:
        """Piping down the front's two sides and along its foot."""
        w, h = self.width / 2, self.height
        right = [(0.75 * w, 0.06 * h), (0.93 * w, 0.08 * h), (0.95 * w, 0.2 * h), (0.93 * w, 0.97 * h)]
        path = [*((-x, z) for x, z in right[::-1]), *right]
        return tube(np.array([(x, -self._front(z, x) + 0.0004, z) for x, z in path]), 0.0011, INK, 4)

    def _edge(self, u: np.ndarray) -> np.ndarray:
        """How far down the flap reaches (a share of `cover`) at u from -1 (left) to 1."""
        match self.flap:
            case "round":
                return 0.45 + 0.55 * np.sqrt(1 - 0.999 * u**2)
            case "point":
                return 1 - 0.55 * np.abs(u)
            case _:
                return 1 - 0.22 * np.clip((np.abs(u) - 0.8) / 0.2, 0, 1) ** 2

    def _flap(self) -> list[Mesh]:
        if self.flap == "none":
            return []
        w, h, thick = 0.97 * self.width / 2, self.height, 0.0018
        u = np.linspace(-1, 1, 13)
        low = h - self.cover * h * self._edge(u)
        back, top, front = self._front(0.8 * h), self._front(h), self._front(h)
        x = 0.985 * w * u
        run = ((0.85, 0.8 * h, back + 0.5 * thick), (0.88, h - 0.001, top), (0.94, h + thick, 0.6 * top), (0.97, h + thick, -0.6 * front))
        rows = [np.column_stack([share * w * u, np.full_like(u, y), np.full_like(u, z)]) for share, z, y in run]
        rows.append(np.column_stack([x, [-self._front(h - 0.002, a) - thick for a in x], np.full_like(u, h - 0.002)]))
        hem = np.column_stack([x, [-self._front(z, a) - thick for a, z in zip(x, low, strict=True)], low])
        under = hem + np.array([0, thick + 0.0005, 0])
        cloth = sheet(np.stack([under, hem, *rows[::-1]]), ACCENT)
        stitch = np.column_stack([0.93 * x, [-self._front(z, 0.93 * a) - thick - 0.0003 for a, z in zip(x, low + 0.003, strict=True)], low + 0.0032])
        ends = [np.array([[sign * 0.916 * w, -self._front(h - 0.003, 0.916 * w) - thick - 0.0002, h - 0.003]]) for sign in (-1, 1)]
        return [cloth, tube(np.concatenate([ends[0], stitch, ends[1]]), 0.0008, INK, 4)]

    def _clasp(self) -> list[Mesh]:
        w, h, shine = self.width / 2, self.height, METAL if self.hardware == "metal" else WARM
        z = h * (1 - self.cover)
        y = -self._front(z) - 0.0015
        match self.clasp:
            case "lock":
                plate = block((0.0085, 0.0022), 0.0125, shine, 6.0, 12)
                return [plate.moved((0, y, z - 0.004)), block((0.0025, 0.0008), 0.005, DARK, 4.0, 8).moved((0, y - 0.0022, z - 0.0005))]
            case "button":
                return [barrel(0.0055, 0.003, shine, 12).moved((0, y + 0.0005, z + 0.006), turn(x=np.pi / 2))]
            case "buckles":
                parts = []
                for side in (-1, 1):
                    strap = [(-self._front(h) - 0.0024, h), (-self._front(z) - 0.0026, z), (-self._front(0.22 * h) - 0.0022, 0.22 * h)]
                    grid = np.array([[(0.55 * w * side + x, y0, z0) for x in (-0.0045, 0.0045)] for y0, z0 in strap[::-1]])
                    parts.append(sheet(grid, INK))
                    parts.append(block((0.0068, 0.0018), 0.0085, shine, 5.0, 12).moved((0.55 * w * side, y - 0.0012, z - 0.007)))
                return parts
            case "none":
                return []

    def _grips(self) -> list[np.ndarray]:
        """The handles' middle lines."""
        h = self.height
        match self.handle:
            case "arch":
                return [arc(0, np.pi, 13, lambda t: (0.021 * np.sign(np.cos(t)) * np.abs(np.cos(t)) ** 0.6, 0 * t, h + 0.0155 * np.sin(t) ** 0.6))]
            case "flat":
                return [arc(0, np.pi, 10, lambda t: (0.030 * np.cos(t), 0 * t, h + 0.009 * np.sin(t) ** 0.7))]
            case "twin":
                deep = 0.7 * self._front(h)
                one = arc(0, np.pi, 10, lambda t: (0.019 * np.cos(t), deep * (1 - 0.3 * np.sin(t)), h - 0.002 + 0.023 * np.sin(t) ** 0.8))
                return [one, one * (1, -1, 1)]

    def _handle(self) -> list[Mesh]:
        thick, paint = GRIPS[self.handle]
        bars = [tube(grip, thick, paint, 6) for grip in self._grips()]
        if self.handle == "arch":
            shine = METAL if self.hardware == "metal" else WARM
            bars += [block((0.0045, 0.0035), 0.0045, shine, 5.0, 10).moved((s * 0.021, 0, self.height)) for s in (-1, 1)]
        return bars

    def solids(self) -> tuple[Solid, ...]:
        w, h = self.width / 2, self.height
        bars = [bar for grip in self._grips() for bar in limbs(grip, GRIPS[self.handle][0], 4)]
        low = h * (1 - self.cover) if self.flap != "none" else h
        flap = Solid("box", (0.94 * w, 0.0022, (h - low) / 2), (0, -self._front(0.8 * h), (h + low) / 2))
        return (
            Solid("box", (0.965 * w, self.depth / 2 - 0.0012, h / 4), (0, 0, h / 4)),
            Solid("box", (0.945 * w, self._front(0.75 * h) - 0.0004, h / 4), (0, 0, 0.75 * h)),
            *((flap,) if self.flap != "none" else ()),
            *bars,
        )

    def aspect(self) -> float:
        return 2 * (self.width + self.depth) / self.height


@value
class Pouch:
    """A round purse that stands on its flattened edge: `radius` of its face, `thick` at its middle, `rim` the thickness of its padded edge."""

    radius: float = 0.0318
    thick: float = 0.040
    rim: float = 0.011
    zip: Literal["top", "front", "none"] = "top"
    pull: Literal["ring", "tab", "drop"] = "ring"
    strap: Literal["loop", "handle", "none"] = "loop"
    badge: Literal["none", "button", "bar"] = "none"
    CUT = 0.0022
    """How much of the round is pressed flat at the bottom, metres."""

    def _centre(self) -> float:
        return self.radius - self.CUT

    def mesh(self) -> Mesh:
        r, deep, edge = self.radius, self.thick / 2, self.rim
        angle = np.linspace(0, np.pi / 2, 6)
        inner = r - 0.55 * edge
        dome: Profile = [(float(inner * np.cos(a) ** 0.8), float(0.35 * edge + (deep - 0.35 * edge) * np.sin(a))) for a in angle[:-1]] + [(0.0, deep)]
        roll: Profile = [(float(r - edge / 2 + edge / 2 * np.cos(a)), float(0.62 * edge * np.sin(a))) for a in np.linspace(-2.2, 2.2, 7)]
        upright = turn(x=np.pi / 2)
        round_ = [lathe(dome, DECORATED, 26), lathe(dome, DECORATED, 26).moved((0, 0, 0), turn(x=np.pi)), lathe(roll, INK, 24)]
        body = join([part.moved((0, 0, self._centre()), upright) for part in round_])
        body = reshaped(body, lambda v: np.column_stack([v[:, 0], v[:, 1], np.maximum(v[:, 2], 0)]))
        return join([body, *self._zip(), *self._strap(), *self._badge()])

    def _zip(self) -> list[Mesh]:
        r, z, deep = self.radius, self._centre(), self.thick / 2
        if self.zip == "none":
            return []
        if self.zip == "top":
            tape = arc(0.12, np.pi - 0.12, 13, lambda t: ((r + 0.0004) * np.cos(t), 0 * t, z + (r + 0.0004) * np.sin(t)))
            rows = [tape + np.array([0, y, 0]) for y in (-0.0028, 0.0028)]
            teeth = tube(tape, 0.0012, METAL, 4)
            spot = np.array([r * np.cos(2.2), -0.001, z + r * np.sin(2.2)])
            parts = [sheet(np.stack(rows)[:, ::-1], DARK), teeth, barrel(0.0032, 0.0028, WARM, 8).moved(tuple(spot.tolist()), turn(y=-0.6))]
            end = spot + np.array([-0.001, -0.0085, -0.008])
        else:
            spot, end = np.array([0.38 * r, -0.92 * deep, z + 0.42 * r]), np.array([0.40 * r, -1.0 * deep, z + 0.12 * r])
            x = np.linspace(-0.62, 0.62, 7) * r
            y = -deep * np.sqrt(1 - (np.hypot(x, 0.42 * r) / r) ** 2) ** 0.8 - 0.0012
            line = np.stack([x, y, np.full_like(x, z + 0.42 * r)], 1)
            parts = [tube(line, 0.0024, DARK, 5), tube(line + np.array([0, -0.0016, 0]), 0.0012, METAL, 4)]
        return [*parts, *self._pull(spot, end)]

    def _pull(self, root: np.ndarray, end: np.ndarray) -> list[Mesh]:
        way = end - root
        match self.pull:
            case "ring":
                t = np.linspace(0, 2 * np.pi, 11)[:, None]
                ring = end + 0.0042 * (np.cos(t) * np.array([1.0, 0, 0]) + np.sin(t) * way / np.linalg.norm(way))
                return [tube(np.stack([root, root + 0.6 * way]), 0.0013, WARM, 5), loop(ring, 0.0012, WARM, 5)]
            case "tab":
                return [tube(np.stack([root, root + way * 1.25]), 0.0024, WARM, 4)]
            case "drop":
                bead = ellipsoid((0.0034, 0.0034, 0.0042), WARM, 8, 5)
                return [tube(np.stack([root, end]), 0.0011, WARM, 4), bead.moved(tuple(end.tolist()))]

    def _strap(self) -> list[Mesh]:
        r, z = self.radius, self._centre()
        path = self._strap_path()
        if self.strap == "loop":
            return [loop(path, 0.0021, INK, 5), barrel(0.0032, 0.006, WARM, 8).moved((r - 0.0035, 0, z + 0.1 * r), turn(y=np.pi / 2))]
        return [tube(path, 0.0023, INK, 5)] if len(path) else []

    def _strap_path(self) -> np.ndarray:
        """The strap's middle line; empty without one."""
        r, z = self.radius, self._centre()
        match self.strap:
            case "loop":
                return arc(0, 2 * np.pi, 13, lambda t: (r + 0.0075 - 0.0085 * np.cos(t), 0 * t, z + 0.1 * r + 0.018 * np.sin(t) - 0.004 * np.cos(t)))
            case "handle":
                return arc(0.15, np.pi - 0.15, 10, lambda t: (0.016 * np.cos(t), 0 * t, z + r - 0.0065 + 0.0165 * np.sin(t)))
            case "none":
                return np.zeros((0, 3))

    def _badge(self) -> list[Mesh]:
        deep, z = self.thick / 2, self._centre()
        match self.badge:
            case "button":
                return [barrel(0.0075, 0.0018, ACCENT, 14).moved((0, -deep + 0.0008, z), turn(x=np.pi / 2))]
            case "bar":
                return [block((0.011, 0.0012), 0.007, ACCENT, 6.0, 12).moved((0, -deep + 0.0002, z - 0.0035))]
            case "none":
                return []

    def solids(self) -> tuple[Solid, ...]:
        r, z = self.radius - self.CUT / 2, self.radius - self.CUT / 2
        path = self._strap_path()
        straps = limbs(path, 0.0021, 6 if self.strap == "loop" else 3) if len(path) else ()
        return (
            Solid("box", (0.0105, 0.4 * self.rim, 0.002), (0, 0, 0.002)),
            Solid("cylinder", (r, 0.45 * self.rim), (0, 0, z), "y"),
            Solid("cylinder", (0.80 * r, 0.32 * self.thick), (0, 0, z), "y"),
            Solid("ellipsoid", (0.9 * r, self.thick / 2, 0.9 * r), (0, 0, z)),
            *straps,
        )

    def aspect(self) -> float:
        return 2 * np.pi * 0.75 * self.radius / (1.2 * self.radius)
