"""Round stuffed toys: a ball with an embroidered face, stub limbs and a hat, for two fingers from above. Metres; faces look to -y."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from vap_core.sim.bodies.lofts import disc, rings
from vap_core.sim.shapes import DECORATED, Mesh, Number, Profile, Solid, ellipsoid, join, lathe, tube, turn
from vap_core.sim.textures import ACCENT, BASE, DARK, INK, LIGHT
from vap_core.values import value


@value
class StuffedToy:
    """`radius` is the ball's half-width; the hat begins above three quarters of `height`, the whole toy's."""

    radius: float = 0.0225
    height: float = 0.066
    hat: Literal["brim", "beanie", "cap", "ears", "crest"] = "brim"
    eyes: Literal["arcs", "dots", "crosses"] = "arcs"
    nose: Literal["ball", "bar", "wide"] = "ball"
    limbs: Literal["stubs", "feet", "none"] = "stubs"

    def _ball(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        share = {"brim": 0.42, "beanie": 0.42, "cap": 0.45, "ears": 0.45, "crest": 0.44}[self.hat]
        half = (self.radius, 0.93 * self.radius, share * self.height)
        return half, (0.0, 0.0, 0.9 * half[2])

    def _plate(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        (a, b, c), (x, y, z) = self._ball()
        return (0.76 * a, 0.74 * b, 0.66 * c), (x, y - 0.30 * b, z - 0.06 * c)

    def _front(self, x: Number, z: Number) -> tuple[np.ndarray, np.ndarray]:
        """The face's point at shares (x, z) of its half-width and half-height, and the turn that takes -y to the normal there."""
        half, centre = self._plate()
        unit = np.array([x, -np.sqrt(1 - x**2 - z**2), z])
        out = unit / half
        out /= np.linalg.norm(out)
        return unit * half + centre, turn(x=-np.arcsin(out[2]), z=np.arctan2(out[0], -out[1]))

    def _lens(self, x: Number, z: Number, size: tuple[Number, Number, Number], paint: int, n: int = 9) -> Mesh:
        spot, face = self._front(x, z)
        return ellipsoid(size, paint, n, 4).moved((float(spot[0]), float(spot[1]), float(spot[2])), face)

    def _stitch(self, path: Float[np.ndarray, "k 2"], paint: int) -> Mesh:
        return tube(np.stack([self._front(float(x), float(z))[0] for x, z in path]), 0.0011, paint, 4)

    def mesh(self) -> Mesh:
        half, centre = self._ball()
        plate, spot = self._plate()
        angle = np.linspace(-np.arcsin(0.9), np.pi / 2, 8)
        wall = np.stack([centre[2] + half[2] * np.sin(angle), 0 * angle, half[0] * np.cos(angle), half[1] * np.cos(angle)], 1)
        wall[0, 0] = 0.0
        ground = disc((0, 0, 0), (float(wall[0, 2]), float(wall[0, 3])), BASE, 12, down=True)
        return join([rings(wall, DECORATED, 18), ground, ellipsoid(plate, BASE, 14, 6).moved(spot), *self._face(), *self._limbs(), *self._hat()])

    def _face(self) -> list[Mesh]:
        t = np.linspace(0, np.pi, 5)
        smile = np.stack([0.26 * np.cos(t), -0.42 - 0.2 * np.sin(t)], 1)
        parts = [self._stitch(smile, DARK)]
        match self.nose:
            case "ball":
                parts.append(self._lens(0, -0.08, (0.0052, 0.0042, 0.0048), ACCENT))
            case "bar":
                parts.append(self._lens(0, -0.08, (0.0025, 0.0028, 0.0062), ACCENT))
            case "wide":
                parts.append(self._lens(0, -0.1, (0.0078, 0.0034, 0.0040), ACCENT))
        for side in (-1, 1):
            x, z = 0.45 * side, 0.22
            parts.append(self._lens(0.68 * side, -0.24, (0.0042, 0.0011, 0.0030), ACCENT, 8))
            match self.eyes:
                case "arcs":
                    parts.append(self._stitch(np.stack([x + 0.18 * np.cos(t), z + 0.22 * np.sin(t)], 1), DARK))
                case "dots":
                    parts.append(self._lens(x, z + 0.04, (0.0030, 0.0018, 0.0034), DARK, 8))
                case "crosses":
                    parts += [self._stitch(np.array([[x - 0.15, z - 0.15 * k], [x, z], [x + 0.15, z + 0.15 * k]]), DARK) for k in (-1, 1)]
        return parts

    def _limbs(self) -> list[Mesh]:
        half, _ = self._ball()
        parts: list[Mesh] = []
        for side in (-1, 1):
            if self.limbs != "none":
                parts.append(ellipsoid((0.0068, 0.0085, 0.0055), INK, 9, 4).moved((0.52 * side * half[0], -0.72 * half[1], 0.0055)))
            if self.limbs == "stubs":
                parts.append(
                    ellipsoid((0.0045, 0.0055, 0.0085), BASE, 8, 4).moved((side * 0.97 * half[0], -0.003, 0.30 * self.height), turn(y=-0.5 * side))
                )
        return parts

    def _hat(self) -> list[Mesh]:
        r, h = self.radius, self.height
        seat = (1, 0.93, 2)

        def turned(profile: Profile, paint: int, n: int = 16) -> Mesh:
            return lathe(profile, paint, n, seat)

        match self.hat:
            case "brim":
                edge, z = 1.12 * r, 0.665 * h
                brim = turned(
                    [(0.7 * r, z - 0.0005), (0.97 * edge, z - 0.001), (edge, z + 0.001), (0.97 * edge, z + 0.003), (0.7 * r, z + 0.003)], INK
                )
                crown = turned([(0.84 * r, z + 0.003), (0.82 * r, 0.84 * h), (0.68 * r, 0.955 * h), (0.4 * r, 0.995 * h), (0, h)], INK)
                return [brim, crown, turned([(0.86 * r, z + 0.003), (0.865 * r, z + 0.0075)], ACCENT)]
            case "beanie":
                z = 0.60 * h
                cuff = turned([(0.88 * r, z - 0.001), (1.03 * r, z), (1.03 * r, z + 0.006), (0.9 * r, z + 0.007)], ACCENT)
                dome = turned([(0.95 * r, z + 0.006), (0.86 * r, 0.77 * h), (0.55 * r, 0.87 * h), (0, 0.9 * h)], INK)
                return [cuff, dome, ellipsoid((0.0075, 0.0075, 0.0065), LIGHT, 9, 5).moved((0, 0, h - 0.0065))]
            case "cap":
                z = 0.64 * h
                dome = turned([(0.96 * r, z), (0.9 * r, 0.82 * h), (0.6 * r, 0.95 * h), (0, h - 0.002)], INK)
                peak = ellipsoid((0.8 * r, 0.62 * r, 0.0022), INK, 12, 4).moved((0, -0.72 * r, z + 0.001), turn(x=0.18))
                return [dome, peak, ellipsoid((0.0028, 0.0028, 0.0022), ACCENT, 7, 4).moved((0, 0, h - 0.0022))]
            case "ears":
                pair = []
                for s in (-1, 1):
                    pair.append(ellipsoid((0.0085, 0.0048, 0.0085), INK, 10, 5).moved((0.62 * s * r, 0, h - 0.0085)))
                    pair.append(ellipsoid((0.0052, 0.002, 0.0052), ACCENT, 8, 4).moved((0.62 * s * r, -0.0036, h - 0.0088)))
                return pair
            case "crest":
                return [
                    lathe([(0.006, 0), (0.0045, 0.4 * tall), (0, tall)], INK, 6).moved((0, y, h - tall), turn(x=-0.25))
                    for y, tall in ((-0.5 * r, 0.016), (0, 0.017), (0.45 * r, 0.0185))
                ]

    def solids(self) -> tuple[Solid, ...]:
        half, _ = self._ball()
        r, h = self.radius, self.height
        top = 1.9 * half[2]
        z = {"brim": 0.665, "beanie": 0.60, "cap": 0.64, "ears": 0.70, "crest": 0.70}[self.hat] * h
        foot = (0.52 * half[0], -0.72 * half[1], 0.0055)
        feet = [Solid("ellipsoid", (0.0068, 0.0085, 0.0055), (s * foot[0], *foot[1:])) for s in (-1, 1) if self.limbs != "none"]
        arm = (0.97 * half[0], -0.003, 0.30 * h)
        arms = [Solid("ellipsoid", (0.0045, 0.0055, 0.0085), (s * arm[0], *arm[1:]), turn=(0, -0.5 * s, 0)) for s in (-1, 1) if self.limbs == "stubs"]
        body = (
            *feet,
            *arms,
            Solid("box", (0.48 * half[0], 0.48 * half[1], 0.003), (0, 0, 0.003)),
            Solid("ellipsoid", (half[0], half[1], top / 2), (0, 0, top / 2)),
        )
        match self.hat:
            case "brim":
                rim = [Solid("box", (1.09 * r * np.cos(a), 1.02 * r * np.sin(a), 0.002), (0, 0, z + 0.001)) for a in (0.42, 0.79, 1.15)]
                return *body, *rim, Solid("ellipsoid", (0.88 * r, 0.82 * r, h - z), (0, 0, z))
            case "ears":
                return *body, *(Solid("ellipsoid", (0.0085, 0.0048, 0.0085), (0.62 * s * r, 0, h - 0.0085)) for s in (-1, 1))
            case "crest":
                return *body, Solid("box", (0.0035, 0.45 * r, 0.005), (0, 0, h - 0.011))
            case "cap":
                peak = Solid("ellipsoid", (0.8 * r, 0.62 * r, 0.0022), (0, -0.72 * r, z + 0.001), turn=(0.18, 0, 0))
                return *body, Solid("ellipsoid", (0.96 * r, 0.9 * r, h - 0.002 - z), (0, 0, z)), peak
            case "beanie":
                return (
                    *body,
                    Solid("ellipsoid", (1.0 * r, 0.93 * r, 0.9 * h - z), (0, 0, z)),
                    Solid("ellipsoid", (0.0075, 0.0075, 0.0065), (0, 0, h - 0.0065)),
                )

    def aspect(self) -> float:
        return 2 * np.pi * 0.9 * self.radius / (0.85 * self.height)
