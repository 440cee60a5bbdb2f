"""Plushies. Lengths are metres; the snout points towards -y."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from vap_core.base.types import value
from vap_make.objects.bodies.animals import EllipsoidFront
from vap_make.objects.bodies.hats import hat_meshes, hat_solids
from vap_make.objects.bodies.parts import ellipsoid, flat_disc, lathe, stacked_rings, tube
from vap_make.objects.shapes import (
    SIDES,
    Mesh,
    Number,
    Solid,
    Vector,
    join_meshes,
    rotation_matrix,
)
from vap_make.objects.textures import ACCENT, BASE, DARK, DECORATED, INK, LIGHT

PAW = (0.0085, 0.011, 0.006)
FRONT_PAW, HIND_PAW = (0.55, -0.72), (0.62, 0.55)
"""Where paws are, as shares of the body's half-width and half-length."""
LONG_EAR = (0.0075, 0.0042, 0.02)
SPINE_ROWS = {
    "spines": (6, 0.0116, 0.0048, 0.0088),
    "tufts": (4, 0.016, 0.0068, 0.0075),
    "mane": (2, 0.009, 0.0045, 0.0105),
}
"""For each coat: rows of spines, and their pitch, radius and length, metres."""


@value
class Plushie:
    """A plump animal on its belly: `length` along y, `snout` is the length of its snout."""

    length: float = 0.078
    width: float = 0.062
    height: float = 0.058
    coat: Literal["spines", "tufts", "mane", "smooth"] = "spines"
    ears: Literal["round", "long", "none"] = "round"
    snout: float = 0.019

    def _body_half(self) -> tuple[float, float, float]:
        """Half-axes of the body's ellipsoid."""
        return self.width / 2 - 0.002, self.length / 2 - 0.4 * self.snout, 0.54 * self.height

    def _body_centre(self) -> tuple[float, float, float]:
        return 0.0, 0.3 * self.snout, 0.46 * self.height

    def mesh(self) -> Mesh:
        half_x, half_y, half_z = self._body_half()
        _, y, z = self._body_centre()
        angle = np.linspace(np.arcsin(-z / half_z), np.pi / 2, 8)
        wall = np.stack(
            [
                z + half_z * np.sin(angle),
                np.full_like(angle, y),
                half_x * np.cos(angle),
                half_y * np.cos(angle),
            ],
            1,
        )
        face = EllipsoidFront(
            half=(0.74 * half_x, 0.5 * half_y, 0.62 * half_z),
            centre=(0.0, y - 0.62 * half_y, z - 0.22 * half_z),
        )
        ground = (float(wall[0, 2]), float(wall[0, 3]))
        parts = [
            stacked_rings(wall, DECORATED, 18),
            flat_disc((0, y, 0), ground, BASE, 10),
            *self._spines(),
            ellipsoid(face.half, INK, segments=13, rows=5).moved(face.centre),
            *self._snout(),
        ]
        for side in SIDES:
            parts += self._eye(face, side)
            parts += self._ear(side)
            for share_x, share_y in (FRONT_PAW, HIND_PAW):
                paw = ellipsoid(PAW, INK, segments=8, rows=3)
                parts.append(paw.moved((share_x * side * half_x, y + share_y * half_y, 0.006)))
        return join_meshes(parts)

    def _snout(self) -> list[Mesh]:
        _, half_y, half_z = self._body_half()
        _, y, z = self._body_centre()
        nose_y, nose_z = y - half_y - 0.55 * self.snout, z - 0.2 * half_z
        outline = [(0.0125, 0), (0.0095, 0.45 * self.snout), (0.0035, self.snout)]
        snout = lathe(outline, ACCENT, 14)
        nose = ellipsoid((0.0052, 0.0048, 0.0045), DARK, segments=8, rows=4)
        forward = rotation_matrix(x=np.pi / 2)
        return [
            snout.moved((0, nose_y + self.snout, nose_z - 0.001), forward),
            nose.moved((0, nose_y - 0.0005, nose_z)),
        ]

    def _eye(self, face: EllipsoidFront, side: int) -> list[Mesh]:
        x, z = side * 0.5 * face.half[0], 0.32 * face.half[2]
        eye = face.lens(
            x=x,
            z=z,
            size=(0.0042, 0.0028, 0.005),
            swatch=DARK,
            raised=0.0006,
            segments=8,
        )
        glint = face.lens(
            x=x + 0.0012,
            z=z + 0.0018,
            size=(0.0013, 0.001, 0.0013),
            swatch=LIGHT,
            raised=0.0028,
            segments=5,
        )
        return [eye, glint]

    def _ear_root(self, side: int) -> tuple[float, float, float]:
        half_x, half_y, half_z = self._body_half()
        _, y, z = self._body_centre()
        return side * 0.52 * half_x, y - 0.66 * half_y, z + 0.42 * half_z

    def _ear(self, side: int) -> list[Mesh]:
        x, y, z = self._ear_root(side)
        match self.ears:
            case "round":
                shell = ellipsoid((0.0095, 0.004, 0.0095), BASE, segments=12, rows=6)
                lining = ellipsoid((0.006, 0.002, 0.006), INK, segments=8, rows=3)
                lean = rotation_matrix(z=0.25 * side)
                return [
                    shell.moved((x, y - 0.002, z), lean),
                    lining.moved((x + 0.001 * side, y - 0.0055, z - 0.0005), lean),
                ]
            case "long":
                shell = ellipsoid(LONG_EAR, BASE, segments=8, rows=5)
                lining = ellipsoid((0.0045, 0.002, 0.0145), INK, segments=8, rows=4)
                lean = rotation_matrix(x=-0.35, y=0.4 * side)
                return [
                    shell.moved((x, y, z + 0.008), lean),
                    lining.moved((x, y - 0.0032, z + 0.0085), lean),
                ]
            case "none":
                return []

    def _spines(self) -> list[Mesh]:
        """Cones that stand on the back in rings around the snout's axis."""
        if self.coat == "smooth":
            return []
        _, _, half_z = self._body_half()
        rows, pitch, radius, length = SPINE_ROWS[self.coat]
        tilts = np.linspace(1.95, 0.25, rows)
        if self.coat == "mane":
            tilts = np.array([1.9, 1.65])
        spines = []
        for row, tilt in enumerate(tilts):
            reach = np.sin(tilt)
            count = max(4, round(1.25 * np.pi * half_z * reach / pitch))
            swatch = BASE
            if self.coat == "tufts" and row % 2:
                swatch = INK
            for spot in np.linspace(-0.17, 1.17, count) * np.pi + 0.06 * (row % 2):
                way = np.array([reach * np.cos(spot), np.cos(tilt), reach * np.sin(spot)])
                if self._is_on_back(way):
                    foot, rotation = self._spine_pose(way)
                    spine = lathe([(radius, 0), (0, length)], swatch, 4)
                    spines.append(spine.moved(foot, rotation))
        return spines

    def _is_on_back(self, way: np.ndarray) -> bool:
        """Whether the body's surface in that direction is well above the table."""
        root = way * self._body_half()
        return bool(root[2] + self._body_centre()[2] > 0.22 * self.height)

    def _spine_pose(self, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Foot of a spine in that direction from the body's centre, and its rotation from +z."""
        half, centre = self._body_half(), self._body_centre()
        outward = way / half
        outward /= np.linalg.norm(outward)
        lean = outward + np.array([0, 0.45, 0.1])
        lean /= np.linalg.norm(lean)
        if lean[2] > 0.999:
            rotation = rotation_matrix(x=-np.arcsin(lean[1]))
        else:
            rotation = rotation_matrix(y=np.arccos(lean[2]), z=np.arctan2(lean[1], lean[0]))
        return way * half + centre - 0.0015 * outward, rotation

    def solids(self) -> tuple[Solid, ...]:
        half_x, half_y, half_z = self._body_half()
        _, y, z = self._body_centre()
        coat = 0.003
        if self.coat == "smooth":
            coat = 0.0
        half_height = (z + half_z + coat) / 2
        body: Vector = (half_x + coat / 2, half_y + coat / 2, half_height)
        face: Vector = (0.74 * half_x, 0.5 * half_y, 0.6 * half_z)
        paws, ears = [], []
        for side in SIDES:
            for share_x, share_y in (FRONT_PAW, HIND_PAW):
                pos = (side * share_x * half_x, y + share_y * half_y, 0.006)
                paws.append(Solid("ellipsoid", PAW, pos))
            if self.ears == "long":
                ear_x, ear_y, ear_z = self._ear_root(side)
                ears.append(
                    Solid(
                        kind="ellipsoid",
                        size=LONG_EAR,
                        pos=(ear_x, ear_y, ear_z + 0.008),
                        euler=(-0.35, 0.4 * side, 0),
                    )
                )
        snout = Solid(
            kind="capsule",
            size=(0.006, 0.45 * self.snout),
            pos=(0, y - half_y - 0.05 * self.snout, z - 0.21 * half_z),
            axis="y",
        )
        return (
            Solid("box", (0.5 * half_x, 0.6 * half_y, 0.003), (0, y, 0.003)),
            Solid("ellipsoid", body, (0, y, half_height)),
            Solid("ellipsoid", face, (0, y - 0.62 * half_y, z - 0.22 * half_z)),
            *paws,
            *ears,
            snout,
        )

    def aspect(self) -> float:
        return np.pi * (self.width + self.length) / 2 / self.height


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
