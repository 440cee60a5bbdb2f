"""Animals and soft toys: sitting cats, plushies with or without spines, and round toys in hats. Lengths in metres; faces look towards -y."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from vap_core.sim.bodies.lofts import arc, curve, disc, limbs, rings
from vap_core.sim.shapes import DECORATED, Mesh, Number, Solid, ellipsoid, join, lathe, tube, turn
from vap_core.sim.textures import ACCENT, BASE, DARK, INK, LIGHT
from vap_core.values import value


def _on(
    half: tuple[Number, Number, Number], centre: tuple[Number, Number, Number], x: Number, z: Number, proud: Number = 0
) -> tuple[np.ndarray, np.ndarray]:
    """The point of an ellipsoid's front at (x, z) from its centre, raised by `proud` metres, and the turn that takes -y to the normal there."""
    y = -half[1] * np.sqrt(max(0.0, 1 - (x / half[0]) ** 2 - (z / half[2]) ** 2))
    out = np.array([x, y, z]) / np.array(half, np.float64) ** 2
    out /= np.linalg.norm(out)
    return np.array([x, y, z]) + np.array(centre) + proud * out, turn(x=-np.arcsin(out[2]), z=np.arctan2(out[0], -out[1]))


def _patch(half: tuple[Number, Number, Number], centre: tuple[Number, Number, Number], x: Number, z: Number, size: tuple[Number, Number, Number],
           paint: int, proud: Number = 0, n: int = 10) -> Mesh:  # fmt: skip
    """A lens (half-width, half-thickness, half-height) sewn onto an ellipsoid's front."""
    spot, face = _on(half, centre, x, z, proud)
    return ellipsoid(size, paint, n, 4).moved((float(spot[0]), float(spot[1]), float(spot[2])), face)


def _stitch(
    half: tuple[Number, Number, Number], centre: tuple[Number, Number, Number], path: Float[np.ndarray, "k 2"], thick: float, paint: int
) -> Mesh:
    """Embroidery along (x, z) points of an ellipsoid's front."""
    return tube(np.stack([_on(half, centre, float(x), float(z))[0] for x, z in path]), thick, paint, 5)


def _spike(radius: Number, length: Number, paint: int, sides: int = 5) -> Mesh:
    return lathe([(radius, 0), (0, length)], paint, sides)


@value
class Cat:
    """A cat that sits on its haunches, about half as wide as tall."""

    height: float = 0.076
    girth: float = 0.0185
    ears: Literal["round", "pointed", "folded"] = "round"
    tail: Literal["curl", "up", "wrap"] = "curl"
    face: Literal["plain", "muzzle", "mask"] = "plain"
    collar: bool = False

    def _head(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        h = self.height
        return (0.225 * h, 0.19 * h, 0.18 * h), (0.0, -0.0045, 0.715 * h)

    def mesh(self) -> Mesh:
        h, w = self.height, self.girth
        half, at = self._head()
        wall = curve([(0, 0.002, 0.92 * w, 1.0 * w), (0.16 * h, 0.002, w, 1.05 * w), (0.36 * h, 0, 0.82 * w, 0.82 * w),
                      (0.60 * h, -0.002, 0.55 * w, 0.5 * w)], 7)  # fmt: skip
        parts = [rings(wall, DECORATED, 15), disc((0, 0.002, 0), (0.92 * w, w), BASE, 10, down=True), ellipsoid(half, BASE, 12, 6).moved(at)]
        for side in (-1, 1):
            parts.append(ellipsoid((0.42 * w, 0.62 * w, 0.17 * h), BASE, 8, 4).moved((side * 0.8 * w, 0.0035, 0.17 * h)))
            parts.append(ellipsoid((0.27 * w, 0.27 * w, 0.21 * h), BASE, 6, 4).moved((side * 0.36 * w, -0.74 * w, 0.23 * h)))
            parts.append(ellipsoid((0.33 * w, 0.42 * w, 0.055 * h), BASE, 7, 3).moved((side * 0.38 * w, -0.98 * w, 0.055 * h)))
            parts += self._ear(side)
            parts.append(_patch(half, at, 0.38 * side * half[0], 0.12 * half[2], (0.054 * h, 0.0016, 0.048 * h), ACCENT, n=9))
            parts.append(_patch(half, at, 0.36 * side * half[0], 0.12 * half[2], (0.018 * h, 0.0012, 0.042 * h), DARK, 0.0010, 5))
            for dz in (-0.5, -0.22):
                root, _ = _on(half, at, 0.42 * side * half[0], -0.42 * half[2])
                tip = root + np.array([side * 0.2 * h, 0.0005, (0.05 * (dz + 0.36) / 0.14 - 0.02) * h])
                parts.append(tube(np.stack([root, tip]), 0.00055, LIGHT, 3))
        if self.face != "plain":
            paint = INK if self.face == "muzzle" else LIGHT
            parts += [_patch(half, at, s * 0.17 * half[0], -0.42 * half[2], (0.07 * h, 0.0035, 0.055 * h), paint, n=8) for s in (-1, 1)]
        parts.append(_patch(half, at, 0, -0.2 * half[2], (0.032 * h, 0.003, 0.022 * h), INK if self.face == "plain" else DARK, 0.002, 6))
        if self.collar:
            t = np.linspace(0, 2 * np.pi, 12)
            ring = np.stack([0.62 * w * np.cos(t), 0.57 * w * np.sin(t) - 0.0018, np.full_like(t, 0.565 * h)], 1)
            parts += [tube(ring, 0.0019, ACCENT, 4, closed=False), ellipsoid((0.0032, 0.0026, 0.0032), LIGHT, 8, 4).moved((0, -0.78 * w, 0.53 * h))]
        parts.append(tube(self._tail_path(), 0.0042, BASE, 5))
        return join(parts)

    def _ear(self, side: int) -> list[Mesh]:
        h, (half, at) = self.height, self._head()
        root = (side * 0.62 * half[0], at[1] - 0.0005, at[2] + 0.62 * half[2])
        lean = turn(y=0.32 * side)
        match self.ears:
            case "round":
                petal = ((1, 0), (0.9, 0.4), (0.58, 0.78), (0, 1))
                shell = lathe([(r, 0.165 * h * z) for r, z in petal], BASE, 8, (0.088 * h, 0.006, 2))
                inner = lathe([(r, 0.11 * h * z) for r, z in petal], INK, 6, (0.054 * h, 0.004, 2))
                return [
                    shell.moved((root[0], root[1], root[2] - 0.02 * h), lean),
                    inner.moved((root[0], root[1] - 0.0036, root[2] + 0.005 * h), lean),
                ]
            case "pointed":
                shell, inner = (
                    lathe([(1, 0), (0, 0.175 * h)], BASE, 8, (0.08 * h, 0.006, 2)),
                    lathe([(1, 0), (0, 0.12 * h)], INK, 8, (0.05 * h, 0.0035, 2)),
                )
                return [shell.moved((root[0], root[1], root[2] - 0.01 * h), lean), inner.moved((root[0], root[1] - 0.0037, root[2] + 0.02 * h), lean)]
            case "folded":
                flap = ellipsoid((0.07 * h, 0.007, 0.04 * h), INK, 8, 4)
                return [flap.moved((1.1 * root[0], root[1] - 0.004, root[2] + 0.01 * h), turn(y=0.7 * side))]

    def _tail_path(self) -> Float[np.ndarray, "k 3"]:
        h, w = self.height, self.girth
        match self.tail:
            case "curl":
                return arc(0, 1, 10, lambda t: (w * (0.45 + 1.15 * np.sin(2.2 * t)) - 0.006 * t**3, 0.9 * w - 0.3 * w * t,
                                                0.0045 + 0.62 * h * t**1.3 - 0.14 * h * np.maximum(0, t - 0.75) * 4 * t))  # fmt: skip
            case "up":
                return arc(0, 1, 10, lambda t: (0.3 * w * np.sin(2 * np.pi * t), w * (0.8 + 0.7 * np.sin(2.0 * t)), 0.006 + 0.7 * h * t))
            case "wrap":
                return arc(0, 1, 10, lambda t: (1.28 * w * np.cos(2.9 * t - 1.45), 1.2 * w * np.sin(1.45 - 2.9 * t) - 0.002, 0.0046 + 0.0 * t))

    def solids(self) -> tuple[Solid, ...]:
        h, w = self.height, self.girth
        half, at = self._head()
        ears = [
            Solid("ellipsoid", (0.07 * h, 0.0045, 0.09 * h), (s * 0.64 * half[0], at[1], at[2] + 0.85 * half[2]), turn=(0, 0.32 * s, 0))
            for s in (-1, 1)
        ]
        return (
            Solid("box", (0.8 * w, 0.78 * w, 0.003), (0, 0.001, 0.003)),
            Solid("ellipsoid", (1.12 * w, 1.05 * w, 0.2 * h), (0, 0.002, 0.2 * h)),
            Solid("ellipsoid", (0.72 * w, 0.8 * w, 0.31 * h), (0, -0.002, 0.35 * h)),
            *(Solid("ellipsoid", (0.27 * w, 0.27 * w, 0.21 * h), (s * 0.36 * w, -0.74 * w, 0.23 * h)) for s in (-1, 1)),
            *(Solid("ellipsoid", (0.33 * w, 0.42 * w, 0.055 * h), (s * 0.38 * w, -0.98 * w, 0.055 * h)) for s in (-1, 1)),
            Solid("ellipsoid", half, at),
            *limbs(self._tail_path()[1:], 0.0042, 3),
            *ears,
        )

    def aspect(self) -> float:
        return 2 * np.pi * 0.85 * self.girth / (0.6 * self.height)


@value
class Plushie:
    """A plump animal on its belly: `length` along y, snout in front."""

    length: float = 0.078
    width: float = 0.062
    height: float = 0.058
    coat: Literal["spines", "tufts", "mane", "smooth"] = "spines"
    ears: Literal["round", "long", "none"] = "round"
    snout: float = 0.019

    def _body(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        half = (self.width / 2 - 0.002, self.length / 2 - 0.4 * self.snout, 0.54 * self.height)
        return half, (0.0, 0.3 * self.snout, 0.46 * self.height)

    def mesh(self) -> Mesh:
        (a, b, c), at = self._body()
        low = -at[2]
        angle = np.linspace(np.arcsin(low / c), np.pi / 2, 8)
        wall = np.stack([at[2] + c * np.sin(angle), np.full_like(angle, at[1]), a * np.cos(angle), b * np.cos(angle)], 1)
        parts = [rings(wall, DECORATED, 18), disc((0, at[1], 0), (float(wall[0, 2]), float(wall[0, 3])), BASE, 10, down=True), *self._spines()]
        face = ((0.74 * a, 0.5 * b, 0.62 * c), (0.0, at[1] - 0.62 * b, at[2] - 0.22 * c))
        parts.append(ellipsoid(face[0], INK, 13, 5).moved(face[1]))
        nose_y, nose_z = at[1] - b - 0.55 * self.snout, at[2] - 0.2 * c
        parts.append(
            lathe([(0.0125, 0), (0.0095, 0.45 * self.snout), (0.0035, self.snout)], ACCENT, 14).moved(
                (0, nose_y + self.snout, nose_z - 0.001), turn(x=np.pi / 2)
            )
        )
        parts.append(ellipsoid((0.0052, 0.0048, 0.0045), DARK, 8, 4).moved((0, nose_y - 0.0005, nose_z)))
        for side in (-1, 1):
            parts.append(_patch(*face, side * 0.5 * face[0][0], 0.32 * face[0][2], (0.0042, 0.0028, 0.005), DARK, 0.0006, 8))
            parts.append(_patch(*face, side * 0.5 * face[0][0] + 0.0012, 0.32 * face[0][2] + 0.0018, (0.0013, 0.001, 0.0013), LIGHT, 0.0028, 5))
            parts += self._ear(side)
            parts.append(ellipsoid((0.0085, 0.011, 0.006), INK, 8, 3).moved((side * 0.55 * a, at[1] - 0.72 * b, 0.006)))
            parts.append(ellipsoid((0.0085, 0.011, 0.006), INK, 8, 3).moved((side * 0.62 * a, at[1] + 0.55 * b, 0.006)))
        return join(parts)

    def _ear(self, side: int) -> list[Mesh]:
        (a, b, c), at = self._body()
        x, y, z = side * 0.52 * a, at[1] - 0.66 * b, at[2] + 0.42 * c
        match self.ears:
            case "round":
                shell, inner = ellipsoid((0.0095, 0.004, 0.0095), BASE, 12, 6), ellipsoid((0.006, 0.002, 0.006), INK, 8, 3)
                lean = turn(z=0.25 * side)
                return [shell.moved((x, y - 0.002, z), lean), inner.moved((x + 0.001 * side, y - 0.0055, z - 0.0005), lean)]
            case "long":
                lean = turn(x=-0.35, y=0.4 * side)
                return [ellipsoid((0.0075, 0.0042, 0.02), BASE, 8, 5).moved((x, y, z + 0.008), lean),
                        ellipsoid((0.0045, 0.002, 0.0145), INK, 8, 4).moved((x, y - 0.0032, z + 0.0085), lean)]  # fmt: skip
            case "none":
                return []

    def _spines(self) -> list[Mesh]:
        """Cones that stand on the back in rings around the snout's axis."""
        if self.coat == "smooth":
            return []
        (a, b, c), at = self._body()
        rows, pitch, size, length = {"spines": (6, 0.0116, 0.0048, 0.0088), "tufts": (4, 0.016, 0.0068, 0.0075), "mane": (2, 0.009, 0.0045, 0.0105)}[
            self.coat
        ]
        steps = np.linspace(1.95, 0.25, rows) if self.coat != "mane" else np.array([1.9, 1.65])
        spines = []
        for row, tilt in enumerate(steps):
            reach = np.sin(tilt)
            count = max(4, round(1.25 * np.pi * c * reach / pitch))
            for spot in np.linspace(-0.17, 1.17, count) * np.pi + 0.06 * (row % 2):
                way = np.array([reach * np.cos(spot), np.cos(tilt), reach * np.sin(spot)])
                root = way * (a, b, c)
                out = way / (a, b, c)
                out /= np.linalg.norm(out)
                lean = out + np.array([0, 0.45, 0.1])
                lean /= np.linalg.norm(lean)
                if root[2] + at[2] > 0.22 * self.height:
                    face = turn(x=-np.arcsin(lean[1])) if lean[2] > 0.999 else turn(y=np.arccos(lean[2]), z=np.arctan2(lean[1], lean[0]))
                    paint = INK if self.coat == "tufts" and row % 2 else BASE
                    spines.append(_spike(size, length, paint, 4).moved(tuple(float(v) for v in root + at - 0.0015 * out), face))  # type: ignore[arg-type]
        return spines

    def solids(self) -> tuple[Solid, ...]:
        (a, b, c), at = self._body()
        more = 0.0 if self.coat == "smooth" else 0.003
        ears = [
            Solid("ellipsoid", (0.0075, 0.0042, 0.02), (s * 0.52 * a, at[1] - 0.66 * b, at[2] + 0.42 * c + 0.008), turn=(-0.35, 0.4 * s, 0))
            for s in ((-1, 1) if self.ears == "long" else ())
        ]
        return (
            Solid("box", (0.5 * a, 0.6 * b, 0.003), (0, at[1], 0.003)),
            Solid("ellipsoid", (a + more / 2, b + more / 2, (at[2] + c + more) / 2), (0, at[1], (at[2] + c + more) / 2)),
            Solid("ellipsoid", (0.74 * a, 0.5 * b, 0.6 * c), (0, at[1] - 0.62 * b, at[2] - 0.22 * c)),
            *(
                Solid("ellipsoid", (0.0085, 0.011, 0.006), (s * x * a, at[1] + y * b, 0.006))
                for s in (-1, 1)
                for x, y in ((0.55, -0.72), (0.62, 0.55))
            ),
            *ears,
            Solid("capsule", (0.006, 0.45 * self.snout), (0, at[1] - b - 0.05 * self.snout, at[2] - 0.21 * c), "y"),
        )

    def aspect(self) -> float:
        return np.pi * (self.width + self.length) / 2 / self.height
