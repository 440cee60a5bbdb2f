"""Plushies. Lengths are metres; the snout points towards -y."""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.ellipsoid_front import EllipsoidFront
from vap_make.objects.bodies.lofts import flat_disc, stacked_rings
from vap_make.objects.bodies.turned import ellipsoid, lathe
from vap_make.objects.shapes import (
    SIDES,
    Mesh,
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
