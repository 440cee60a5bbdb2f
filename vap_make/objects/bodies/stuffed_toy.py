"""Round stuffed toys: a ball with an embroidered face, stub limbs and a hat.

Lengths are metres; the face looks towards -y.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float

from vap_core.base.types import value
from vap_make.objects.bodies.hats import hat_meshes, hat_solids
from vap_make.objects.bodies.lofts import flat_disc, stacked_rings
from vap_make.objects.bodies.turned import ellipsoid, tube
from vap_make.objects.shapes import (
    SIDES,
    Mesh,
    Number,
    Solid,
    Vector,
    join_meshes,
    rotation_matrix,
)
from vap_make.objects.textures import ACCENT, BASE, DARK, DECORATED, INK

BALL_SHARES = {"brim": 0.42, "beanie": 0.42, "cap": 0.45, "ears": 0.45, "crest": 0.44}
"""Half the ball's height as a share of the toy's, by hat."""
FOOT, ARM = (0.0068, 0.0085, 0.0055), (0.0045, 0.0055, 0.0085)


@value
class StuffedToy:
    """A stuffed toy for two fingers from above.

    `radius` is the ball's half-width, `height` the whole toy's; the hat begins above three fifths
    of it.
    """

    radius: float = 0.0225
    height: float = 0.066
    hat: Literal["brim", "beanie", "cap", "ears", "crest"] = "brim"
    eyes: Literal["arcs", "dots", "crosses"] = "arcs"
    nose: Literal["ball", "bar", "wide"] = "ball"
    limbs: Literal["stubs", "feet", "none"] = "stubs"

    def _ball_half(self) -> tuple[float, float, float]:
        """Half-axes of the ball, whose centre is on the z axis."""
        return self.radius, 0.93 * self.radius, BALL_SHARES[self.hat] * self.height

    def _face_half(self) -> tuple[float, float, float]:
        """Half-axes of the ellipsoid that carries the face."""
        x, y, z = self._ball_half()
        return 0.76 * x, 0.74 * y, 0.66 * z

    def _face_centre(self) -> tuple[float, float, float]:
        _, y, z = self._ball_half()
        return 0.0, 0.0 - 0.30 * y, 0.9 * z - 0.06 * z

    def _on_face(self, x: Number, z: Number) -> tuple[np.ndarray, np.ndarray]:
        """The face's point at shares (x, z) of its half-width and half-height.

        With it comes the rotation that takes -y to the normal there.
        """
        half = self._face_half()
        unit = np.array([x, -np.sqrt(1 - x**2 - z**2), z])
        outward = unit / half
        outward /= np.linalg.norm(outward)
        facing = rotation_matrix(x=-np.arcsin(outward[2]), z=np.arctan2(outward[0], -outward[1]))
        return unit * half + self._face_centre(), facing

    def _lens(self, x: Number, z: Number, size: Vector, swatch: int, segments: int = 9) -> Mesh:
        point, facing = self._on_face(x, z)
        return ellipsoid(size, swatch, segments, rows=4).moved(point, facing)

    def _stitch(self, path: Float[np.ndarray, "k 2"]) -> Mesh:
        """A dark thread along shares (x, z) of the face's half-sizes."""
        points = []
        for x, z in path:
            point, _ = self._on_face(float(x), float(z))
            points.append(point)
        return tube(np.stack(points), 0.0011, DARK, sides=4)

    def mesh(self) -> Mesh:
        half_x, half_y, half_z = self._ball_half()
        angle = np.linspace(-np.arcsin(0.9), np.pi / 2, 8)
        wall = np.stack(
            [
                0.9 * half_z + half_z * np.sin(angle),
                0 * angle,
                half_x * np.cos(angle),
                half_y * np.cos(angle),
            ],
            1,
        )
        wall[0, 0] = 0.0
        ground = (float(wall[0, 2]), float(wall[0, 3]))
        face = ellipsoid(self._face_half(), BASE, segments=14, rows=6)
        return join_meshes(
            [
                stacked_rings(wall, DECORATED, 18),
                flat_disc((0, 0, 0), ground, BASE, 12),
                face.moved(self._face_centre()),
                *self._face(),
                *self._limb_meshes(),
                *hat_meshes(self.hat, self.radius, self.height),
            ]
        )

    def _face(self) -> list[Mesh]:
        t = np.linspace(0, np.pi, 5)
        smile = np.stack([0.26 * np.cos(t), -0.42 - 0.2 * np.sin(t)], 1)
        parts = [self._stitch(smile), self._nose()]
        for side in SIDES:
            parts.append(
                self._lens(0.68 * side, -0.24, (0.0042, 0.0011, 0.0030), ACCENT, segments=8)
            )
            parts += self._eye(0.45 * side, 0.22)
        return parts

    def _nose(self) -> Mesh:
        match self.nose:
            case "ball":
                return self._lens(0, -0.08, (0.0052, 0.0042, 0.0048), ACCENT)
            case "bar":
                return self._lens(0, -0.08, (0.0025, 0.0028, 0.0062), ACCENT)
            case "wide":
                return self._lens(0, -0.1, (0.0078, 0.0034, 0.0040), ACCENT)

    def _eye(self, x: Number, z: Number) -> list[Mesh]:
        match self.eyes:
            case "arcs":
                t = np.linspace(0, np.pi, 5)
                return [self._stitch(np.stack([x + 0.18 * np.cos(t), z + 0.22 * np.sin(t)], 1))]
            case "dots":
                return [self._lens(x, z + 0.04, (0.0030, 0.0018, 0.0034), DARK, segments=8)]
            case "crosses":
                strokes = []
                for slope in (-1, 1):
                    left, right = [x - 0.15, z - 0.15 * slope], [x + 0.15, z + 0.15 * slope]
                    strokes.append(self._stitch(np.array([left, [x, z], right])))
                return strokes

    def _foot_centre(self, side: int) -> tuple[float, float, float]:
        half_x, half_y, _ = self._ball_half()
        return 0.52 * side * half_x, -0.72 * half_y, 0.0055

    def _arm_centre(self, side: int) -> tuple[float, float, float]:
        half_x, _, _ = self._ball_half()
        return side * 0.97 * half_x, -0.003, 0.30 * self.height

    def _limb_meshes(self) -> list[Mesh]:
        parts: list[Mesh] = []
        for side in SIDES:
            if self.limbs != "none":
                foot = ellipsoid(FOOT, INK, segments=9, rows=4)
                parts.append(foot.moved(self._foot_centre(side)))
            if self.limbs == "stubs":
                arm = ellipsoid(ARM, BASE, segments=8, rows=4)
                parts.append(arm.moved(self._arm_centre(side), rotation_matrix(y=-0.5 * side)))
        return parts

    def solids(self) -> tuple[Solid, ...]:
        half_x, half_y, half_z = self._ball_half()
        top = 1.9 * half_z
        feet, arms = [], []
        for side in SIDES:
            if self.limbs != "none":
                feet.append(Solid("ellipsoid", FOOT, self._foot_centre(side)))
            if self.limbs == "stubs":
                place, euler = self._arm_centre(side), (0, -0.5 * side, 0)
                arms.append(Solid("ellipsoid", ARM, place, euler=euler))
        return (
            *feet,
            *arms,
            Solid("box", (0.48 * half_x, 0.48 * half_y, 0.003), (0, 0, 0.003)),
            Solid("ellipsoid", (half_x, half_y, top / 2), (0, 0, top / 2)),
            *hat_solids(self.hat, self.radius, self.height),
        )

    def aspect(self) -> float:
        return 2 * np.pi * 0.9 * self.radius / (0.85 * self.height)
