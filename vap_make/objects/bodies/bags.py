"""Leather bags with a flap, a clasp and handles. Lengths are metres; the front faces -y."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from vap_core.base.types import value
from vap_make.objects.bodies.parts import (
    Profile,
    arc_profile,
    capsules_along,
    closed_cylinder,
    ellipsoid,
    grid_mesh,
    lathe,
    rounded_block,
    smooth_mesh,
    stacked_rings,
    tube,
)
from vap_make.objects.shapes import (
    SIDES,
    Mesh,
    Number,
    Solid,
    join_meshes,
    rotation_matrix,
)
from vap_make.objects.textures import ACCENT, BASE, DARK, DECORATED, INK, METAL, WARM

HANDLES = {"arch": (0.0029, INK), "flat": (0.0032, ACCENT), "twin": (0.0024, INK)}
"""Half-thickness (m) and swatch of a bag's handles."""
FLAP_THICKNESS = 0.0018


@value
class LeatherBag:
    """A case of `width` x `depth`; `height` is the body's, the handles stand on it.

    The flap covers the share `cover` of the front.
    """

    width: float = 0.092
    depth: float = 0.034
    height: float = 0.060
    flap: Literal["square", "round", "point", "none"] = "square"
    cover: float = 0.52
    clasp: Literal["lock", "buckles", "button", "none"] = "lock"
    handle: Literal["arch", "flat", "twin"] = "arch"
    hardware: Literal["metal", "gold"] = "metal"

    def _front(self, z: Number, x: Number = 0) -> float:
        """The body's half-depth at height z and at a distance x from its middle.

        The body narrows towards the top, and its corners are round.
        """
        share = float(z) / self.height
        edge = abs(float(x)) / (self.width / 2 * (1 - 0.04 * share))
        return self.depth / 2 * (1 - 0.16 * share) * max(0.0, 1 - edge**7) ** (1 / 7)

    def _fronts(
        self, z: Float[np.ndarray, " k"], x: Float[np.ndarray, " k"]
    ) -> Float[np.ndarray, " k"]:
        """`_front` of each pair."""
        depths = np.empty(len(x))
        for i in range(len(x)):
            depths[i] = self._front(z[i], x[i])
        return depths

    def _metal(self) -> int:
        """Swatch of the metal parts."""
        if self.hardware == "metal":
            return METAL
        return WARM

    def mesh(self) -> Mesh:
        return join_meshes(
            [
                *self._body(),
                self._piping(),
                *self._flap_meshes(),
                *self._clasp_meshes(),
                *self._handle_meshes(),
            ]
        )

    def _body(self) -> list[Mesh]:
        half_width, h = self.width / 2, self.height
        z = np.linspace(0, h, 4)
        depths = self._fronts(z, np.zeros(4))
        levels = np.stack([z, 0 * z, half_width * (1 - 0.04 * z / h), depths], 1)
        levels[0, 2:] *= 0.985
        floor = np.stack([[0, 0, 0, 0], levels[0]])
        lid = np.stack([levels[-1], [h + 0.001, 0, 0.9 * levels[-1, 2], 0.75 * levels[-1, 3]]])
        return [
            stacked_rings(floor, BASE, 24, power=7),
            stacked_rings(levels, DECORATED, 32, power=7),
            stacked_rings(lid, BASE, 24, power=7, closed_top=True),
        ]

    def _piping(self) -> Mesh:
        """A bar down the front's two sides and along its foot."""
        half_width, h = self.width / 2, self.height
        x = half_width * np.array([0.75, 0.93, 0.95, 0.93])
        z = h * np.array([0.06, 0.08, 0.2, 0.97])
        x, z = np.concatenate([-x[::-1], x]), np.concatenate([z[::-1], z])
        path = np.stack([x, -self._fronts(z, x) + 0.0004, z], 1)
        return tube(path, 0.0011, INK, sides=4)

    def _flap_reach(self, u: np.ndarray) -> np.ndarray:
        """How far down the flap reaches (a share of `cover`) at u from -1 (left) to 1."""
        match self.flap:
            case "round":
                return 0.45 + 0.55 * np.sqrt(1 - 0.999 * u**2)
            case "point":
                return 1 - 0.55 * np.abs(u)
            case _:
                return 1 - 0.22 * np.clip((np.abs(u) - 0.8) / 0.2, 0, 1) ** 2

    def _flap_meshes(self) -> list[Mesh]:
        """The leather, from the back over the top to its hem on the front, and a stitched edge."""
        if self.flap == "none":
            return []
        half_width, h, thick = 0.97 * self.width / 2, self.height, FLAP_THICKNESS
        u = np.linspace(-1, 1, 13)
        x = 0.985 * half_width * u
        hem_z = h - self.cover * h * self._flap_reach(u)
        edge_z = np.full_like(u, h - 0.002)
        back, top = self._front(0.8 * h), self._front(h)
        over = (  # share of the half-width, z, y
            (0.85, 0.8 * h, back + 0.5 * thick),
            (0.88, h - 0.001, top),
            (0.94, h + thick, 0.6 * top),
            (0.97, h + thick, -0.6 * top),
        )
        rows = []
        for share, z, y in over:
            rows.append(
                np.column_stack([share * half_width * u, np.full_like(u, y), np.full_like(u, z)])
            )
        rows.append(np.column_stack([x, -self._fronts(edge_z, x) - thick, edge_z]))
        hem = np.column_stack([x, -self._fronts(hem_z, x) - thick, hem_z])
        under = hem + np.array([0, thick + 0.0005, 0])
        leather = grid_mesh(np.stack([under, hem, *rows[::-1]]), ACCENT)
        return [leather, tube(self._stitches(x, hem_z), 0.0008, INK, sides=4)]

    def _stitches(
        self, x: Float[np.ndarray, " k"], hem_z: Float[np.ndarray, " k"]
    ) -> Float[np.ndarray, "k_plus_2 3"]:
        """The path of the thread along the flap's edge, from its left upper corner to its right."""
        half_width, h, thick = 0.97 * self.width / 2, self.height, FLAP_THICKNESS
        depth = self._fronts(hem_z + 0.003, 0.93 * x)
        along_hem = np.column_stack([0.93 * x, -depth - thick - 0.0003, hem_z + 0.0032])
        corner_y = -self._front(h - 0.003, 0.916 * half_width) - thick - 0.0002
        left = np.array([[-0.916 * half_width, corner_y, h - 0.003]])
        right = np.array([[0.916 * half_width, corner_y, h - 0.003]])
        return np.concatenate([left, along_hem, right])

    def _clasp_meshes(self) -> list[Mesh]:
        z = self.height * (1 - self.cover)
        y = -self._front(z) - 0.0015
        match self.clasp:
            case "lock":
                plate = rounded_block(
                    (0.0085, 0.0022), 0.0125, self._metal(), power=6.0, segments=12
                )
                keyhole = rounded_block((0.0025, 0.0008), 0.005, DARK, power=4.0, segments=8)
                return [
                    plate.moved((0, y, z - 0.004)),
                    keyhole.moved((0, y - 0.0022, z - 0.0005)),
                ]
            case "button":
                button = closed_cylinder(0.0055, 0.003, self._metal(), 12)
                forward = rotation_matrix(x=np.pi / 2)
                return [button.moved((0, y + 0.0005, z + 0.006), forward)]
            case "buckles":
                parts = []
                for side in SIDES:
                    parts += self._buckle(0.55 * (self.width / 2) * side, y, z)
                return parts
            case "none":
                return []

    def _buckle(self, x: Number, y: Number, z: Number) -> list[Mesh]:
        """A strap down the front at x, and its buckle at height z."""
        h = self.height
        strap = np.array(
            [
                (-self._front(0.22 * h) - 0.0022, 0.22 * h),
                (-self._front(z) - 0.0026, z),
                (-self._front(h) - 0.0024, h),
            ]
        )
        left = np.column_stack([np.full(3, x + -0.0045), strap])
        right = np.column_stack([np.full(3, x + 0.0045), strap])
        buckle = rounded_block((0.0068, 0.0018), 0.0085, self._metal(), power=5.0, segments=12)
        return [
            grid_mesh(np.stack([left, right], 1), INK),
            buckle.moved((x, y - 0.0012, z - 0.007)),
        ]

    def _handle_paths(self) -> list[Float[np.ndarray, "k 3"]]:
        """The handles' middle lines."""
        h = self.height
        match self.handle:
            case "arch":
                t = np.linspace(0.0, np.pi, 13)
                x = 0.021 * np.sign(np.cos(t)) * np.abs(np.cos(t)) ** 0.6
                return [np.stack([x, 0 * t, h + 0.0155 * np.sin(t) ** 0.6], 1)]
            case "flat":
                t = np.linspace(0.0, np.pi, 10)
                return [np.stack([0.030 * np.cos(t), 0 * t, h + 0.009 * np.sin(t) ** 0.7], 1)]
            case "twin":
                t = np.linspace(0.0, np.pi, 10)
                y = 0.7 * self._front(h) * (1 - 0.3 * np.sin(t))
                z = h - 0.002 + 0.023 * np.sin(t) ** 0.8
                behind = np.stack([0.019 * np.cos(t), y, z], 1)
                return [behind, behind * (1, -1, 1)]

    def _handle_meshes(self) -> list[Mesh]:
        thickness, swatch = HANDLES[self.handle]
        parts = []
        for path in self._handle_paths():
            parts.append(tube(path, thickness, swatch))
        if self.handle == "arch":
            mount = rounded_block((0.0045, 0.0035), 0.0045, self._metal(), power=5.0, segments=10)
            for side in SIDES:
                parts.append(mount.moved((side * 0.021, 0, self.height)))
        return parts

    def solids(self) -> tuple[Solid, ...]:
        half_width, h = self.width / 2, self.height
        solids = [
            Solid("box", (0.965 * half_width, self.depth / 2 - 0.0012, h / 4), (0, 0, h / 4)),
            Solid(
                kind="box",
                size=(0.945 * half_width, self._front(0.75 * h) - 0.0004, h / 4),
                pos=(0, 0, 0.75 * h),
            ),
        ]
        if self.flap != "none":
            low = h * (1 - self.cover)
            half = (0.94 * half_width, 0.0022, (h - low) / 2)
            solids.append(Solid("box", half, (0, -self._front(0.8 * h), (h + low) / 2)))
        for path in self._handle_paths():
            solids += capsules_along(path, HANDLES[self.handle][0], 4)
        return tuple(solids)

    def aspect(self) -> float:
        return 2 * (self.width + self.depth) / self.height


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
