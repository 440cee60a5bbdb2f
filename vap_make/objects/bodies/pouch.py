"""Round pouches with a zipper. Lengths are metres; the front faces -y."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from vap_core.base.types import value
from vap_make.objects.bodies.lofts import capsules_along, grid_mesh, smooth_mesh
from vap_make.objects.bodies.turned import (
    Profile,
    arc_profile,
    closed_cylinder,
    ellipsoid,
    lathe,
    rounded_block,
    tube,
)
from vap_make.objects.shapes import Mesh, Solid, join_meshes, rotation_matrix
from vap_make.objects.textures import ACCENT, DARK, DECORATED, INK, METAL, WARM

FLATTENING = 0.0022
"""How much of the round is pressed flat at the bottom, metres."""


@value
class Pouch:
    """A round purse that stands on its flattened edge.

    `radius` is its face's, `thick` its thickness in the middle, `rim` that of its padded edge.
    """

    radius: float = 0.0318
    thick: float = 0.040
    rim: float = 0.011
    zip: Literal["top", "front", "none"] = "top"
    pull: Literal["ring", "tab", "drop"] = "ring"
    strap: Literal["loop", "handle", "none"] = "loop"
    badge: Literal["none", "button", "bar"] = "none"

    def _centre_z(self) -> float:
        return self.radius - FLATTENING

    def mesh(self) -> Mesh:
        return join_meshes(
            [
                self._body(),
                *self._zip_meshes(),
                *self._strap_meshes(),
                *self._badge_meshes(),
            ]
        )

    def _body(self) -> Mesh:
        """Two domes and a rolled edge, turned about y and cut off at z = 0."""
        r, edge = self.radius, self.rim
        dome = self._dome()
        roll_angles = np.linspace(-2.2, 2.2, 7)
        roll = arc_profile((r - edge / 2, 0.0), (edge / 2, 0.62 * edge), roll_angles)
        upright = rotation_matrix(x=np.pi / 2)
        parts = []
        for part in (
            lathe(dome, DECORATED, 26),
            lathe(dome, DECORATED, 26).moved(rotation=rotation_matrix(x=np.pi)),
            lathe(roll, INK, 24),
        ):
            parts.append(part.moved((0, 0, self._centre_z()), upright))
        body = join_meshes(parts)
        x, y, z = body.vertex.T
        return smooth_mesh(np.column_stack([x, y, np.maximum(z, 0)]), body.uv, body.face)

    def _dome(self) -> Profile:
        edge, depth = self.rim, self.thick / 2
        inner = self.radius - 0.55 * edge
        dome: Profile = []
        for angle in np.linspace(0, np.pi / 2, 6)[:-1]:
            z = 0.35 * edge + (depth - 0.35 * edge) * np.sin(angle)
            dome.append((float(inner * np.cos(angle) ** 0.8), float(z)))
        return [*dome, (0.0, depth)]

    def _zip_meshes(self) -> list[Mesh]:
        match self.zip:
            case "top":
                return self._top_zip()
            case "front":
                return self._front_zip()
            case "none":
                return []

    def _top_zip(self) -> list[Mesh]:
        r, z = self.radius, self._centre_z()
        t = np.linspace(0.12, np.pi - 0.12, 13)
        middle = np.stack([(r + 0.0004) * np.cos(t), 0 * t, z + (r + 0.0004) * np.sin(t)], 1)
        front, back = middle + np.array([0, -0.0028, 0]), middle + np.array([0, 0.0028, 0])
        tape = grid_mesh(np.stack([front, back])[:, ::-1], DARK)
        teeth = tube(middle, 0.0012, METAL, sides=4)
        spot = np.array([r * np.cos(2.2), -0.001, z + r * np.sin(2.2)])
        slider = closed_cylinder(0.0032, 0.0028, WARM, 8).moved(spot, rotation_matrix(y=-0.6))
        end = spot + np.array([-0.001, -0.0085, -0.008])
        return [tape, teeth, slider, *self._pull_meshes(spot, end)]

    def _front_zip(self) -> list[Mesh]:
        r, z, depth = self.radius, self._centre_z(), self.thick / 2
        root = np.array([0.38 * r, -0.92 * depth, z + 0.42 * r])
        end = np.array([0.40 * r, -1.0 * depth, z + 0.12 * r])
        x = np.linspace(-0.62, 0.62, 7) * r
        y = -depth * np.sqrt(1 - (np.hypot(x, 0.42 * r) / r) ** 2) ** 0.8 - 0.0012
        middle = np.stack([x, y, np.full_like(x, z + 0.42 * r)], 1)
        tape = tube(middle, 0.0024, DARK, sides=5)
        teeth = tube(middle + np.array([0, -0.0016, 0]), 0.0012, METAL, sides=4)
        return [tape, teeth, *self._pull_meshes(root, end)]

    def _pull_meshes(self, root: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]) -> list[Mesh]:
        """The zipper's pull from the slider towards `end`."""
        way = end - root
        match self.pull:
            case "ring":
                t = np.linspace(0, 2 * np.pi, 11)[:, None]
                across = np.cos(t) * np.array([1.0, 0, 0])
                along = np.sin(t) * way / np.linalg.norm(way)
                ring = end + 0.0042 * (across + along)
                return [
                    tube(np.stack([root, root + 0.6 * way]), 0.0013, WARM, sides=5),
                    tube(ring, 0.0012, WARM, sides=5, capped=False),
                ]
            case "tab":
                return [tube(np.stack([root, root + way * 1.25]), 0.0024, WARM, sides=4)]
            case "drop":
                bead = ellipsoid((0.0034, 0.0034, 0.0042), WARM, segments=8, rows=5)
                return [tube(np.stack([root, end]), 0.0011, WARM, sides=4), bead.moved(end)]

    def _strap_path(self) -> Float[np.ndarray, "k 3"] | None:
        """The strap's middle line."""
        r, z = self.radius, self._centre_z()
        match self.strap:
            case "loop":
                t = np.linspace(0.0, 2 * np.pi, 13)
                x = r + 0.0075 - 0.0085 * np.cos(t)
                return np.stack([x, 0 * t, z + 0.1 * r + 0.018 * np.sin(t) - 0.004 * np.cos(t)], 1)
            case "handle":
                t = np.linspace(0.15, np.pi - 0.15, 10)
                up = z + r - 0.0065 + 0.0165 * np.sin(t)
                return np.stack([0.016 * np.cos(t), 0 * t, up], 1)
            case "none":
                return None

    def _strap_meshes(self) -> list[Mesh]:
        path = self._strap_path()
        if path is None:
            return []
        if self.strap == "handle":
            return [tube(path, 0.0023, INK, sides=5)]
        stud = closed_cylinder(0.0032, 0.006, WARM, 8)
        place = (self.radius - 0.0035, 0, self._centre_z() + 0.1 * self.radius)
        return [
            tube(path, 0.0021, INK, sides=5, capped=False),
            stud.moved(place, rotation_matrix(y=np.pi / 2)),
        ]

    def _badge_meshes(self) -> list[Mesh]:
        depth, z = self.thick / 2, self._centre_z()
        match self.badge:
            case "button":
                button = closed_cylinder(0.0075, 0.0018, ACCENT, 14)
                return [button.moved((0, -depth + 0.0008, z), rotation_matrix(x=np.pi / 2))]
            case "bar":
                bar = rounded_block((0.011, 0.0012), 0.007, ACCENT, power=6.0, segments=12)
                return [bar.moved((0, -depth + 0.0002, z - 0.0035))]
            case "none":
                return []

    def solids(self) -> tuple[Solid, ...]:
        r = z = self.radius - FLATTENING / 2
        solids = [
            Solid("box", (0.0105, 0.4 * self.rim, 0.002), (0, 0, 0.002)),
            Solid("cylinder", (r, 0.45 * self.rim), (0, 0, z), axis="y"),
            Solid("cylinder", (0.80 * r, 0.32 * self.thick), (0, 0, z), axis="y"),
            Solid("ellipsoid", (0.9 * r, self.thick / 2, 0.9 * r), (0, 0, z)),
        ]
        path = self._strap_path()
        if path is not None:
            count = 3
            if self.strap == "loop":
                count = 6
            solids += capsules_along(path, 0.0021, count)
        return tuple(solids)

    def aspect(self) -> float:
        return 2 * np.pi * 0.75 * self.radius / (1.2 * self.radius)
