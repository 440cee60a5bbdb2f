"""The last that shoes and slippers are built over, with their soles, openings and solids.

Lengths are metres. A last lies along x, heel at -x, toe at +x; a place along it is given as a share
of its length from the heel.
"""

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.lofts import grid_mesh, interpolate_knots
from vap_make.objects.bodies.turned import tube
from vap_make.objects.shapes import Mesh, Number, Solid, join_meshes
from vap_make.objects.textures import DARK

Knots = tuple[tuple[Number, Number], ...]
WIDTH_KNOTS: Knots = ((0, 0.80), (0.3, 0.76), (0.68, 1.0), (1, 0.96))
"""(Share of the length, share of the width)."""
SOLE_LEVELS = ((-0.06, 0), (0.0, 0.3), (0.0, 0.55), (0.0, 0.8), (-0.02, 1.0), (-0.12, 1.06))


@value
class Last:
    """The form of a foot, made of superellipse sections.

    `top` lists (share of the length from the heel, share of the height) of the top line; the sole
    ends at height `low`.
    """

    length: float
    width: float
    height: float
    low: float
    top: Knots
    power: Number = 2.8

    def half_width(self, s: np.ndarray) -> np.ndarray:
        """Half-width at share s: round at both ends, widest at the ball of the foot."""
        bulge = interpolate_knots(WIDTH_KNOTS, 41)
        t = np.clip(2 * s - 1, -1, 1)
        q = np.where(t > 0, 2.5, 3.2)
        widest = self.width / 2 * np.interp(s, bulge[:, 0], bulge[:, 1])
        return widest * (1 - np.abs(t) ** q) ** (1 / q)

    def top_line(self, s: np.ndarray) -> np.ndarray:
        """Height of the top line at share s, metres."""
        line = interpolate_knots(self.top, 41)
        return self.height * np.interp(s, line[:, 0], line[:, 1])

    def surface(self, s: np.ndarray, lift: np.ndarray, raised: Number = 0) -> np.ndarray:
        """Points of the hull, raised by `raised` metres.

        `lift` runs from -1 (sole, near side y < 0) over 0 (top line) to 1 (sole, far side).
        """
        angle = np.pi / 2 * (1 - np.abs(lift))
        side = np.sign(lift)
        width, rise = self.half_width(s), self.top_line(s) - self.low
        slope = (self.top_line(s + 0.01) - self.top_line(s - 0.01)) / (0.02 * self.length)
        y = side * width * np.cos(angle) ** (2 / self.power)
        z = self.low + rise * np.sin(angle) ** (2 / self.power)
        directions = (-slope * np.sin(angle), side * np.cos(angle), np.sin(angle))
        outward = np.stack(np.broadcast_arrays(*directions), -1)
        outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
        points = np.stack(np.broadcast_arrays(self.length * (s - 0.5), y, z), -1)
        return points + raised * outward

    def top_point(self, s: Number, lift: Number = 0.0, raised: Number = 0) -> np.ndarray:
        """One point of the hull."""
        return self.surface(np.array([s]), np.array([lift]), raised)[0]

    def hull_mesh(self, swatch: int, rows: int = 6) -> Mesh:
        """The whole hull; decorated, either side shows the whole decoration."""
        columns = 13
        s = (1 - np.cos(np.linspace(0.0, np.pi, columns))) / 2
        down = np.broadcast_to(np.linspace(1, 0, rows)[:, None], (rows, columns))
        near = self.surface(s[None], np.linspace(-1, 0, rows)[:, None])
        far = self.surface(s[None, ::-1], np.linspace(1, 0, rows)[:, None])
        return join_meshes([grid_mesh(near, swatch, down=down), grid_mesh(far, swatch, down=down)])

    def patch(
        self,
        shares: tuple[Number, Number],
        lifts: tuple[Number, Number],
        swatch: int,
        raised: Number,
        size: tuple[int, int],
        slant: Number = 0,
    ) -> Mesh:
        """A piece of material on the hull between two shares of the length and two lifts.

        `size` are its columns and rows; `slant` moves its upper edge along the length.
        """
        (start, stop), (low, high), (columns, rows) = shares, lifts, size
        lift = np.linspace(low, high, rows)[:, None]
        shift = slant * np.linspace(0, 1, rows)[:, None]
        s = np.linspace(start, stop, columns)[None] + shift
        if low > high:
            s = s[:, ::-1]
        return grid_mesh(self.surface(s, lift, raised), swatch)

    def sole(self, swatch: int, stripe: int, flare: Number = 1.05) -> Mesh:
        """A slab under the hull with a stripe around it."""
        s = (1 - np.cos(np.linspace(0, np.pi, 9))) / 2
        x, half_width = self.length * (s - 0.5), self.half_width(s)
        outline_x = np.concatenate([x, x[::-1]])
        outline_y = np.concatenate([-half_width, half_width[::-1]])
        rim = np.stack([outline_x, outline_y], 1)
        rim = np.concatenate([rim, rim[:1]])

        def ring(scale: Number, z: Number) -> np.ndarray:
            grow = np.array([1 + (scale - 1) * self.width / self.length, scale])
            return np.column_stack([rim * grow, np.full(len(rim), z)])

        rings = []
        for change, z in SOLE_LEVELS:
            rings.append(ring(flare + change, z * self.low))
        wall = np.stack(rings)
        ground = np.stack([ring(0, 0), ring(flare - 0.06, 0)])
        return join_meshes(
            [
                grid_mesh(wall[:3], swatch),
                grid_mesh(wall[2:4], stripe),
                grid_mesh(wall[3:], swatch),
                grid_mesh(ground, swatch),
            ]
        )

    def opening(
        self, start: Number, stop: Number, share: Number, trim: int, inside: int, thickness: Number
    ) -> list[Mesh]:
        """The opening for the foot between two shares of the length, `share` of the width wide.

        It has a lining (swatch `inside`), the dark way to the toe, and a padded ring (`trim`).
        """
        t = np.linspace(0, 2 * np.pi, 15)
        s = (start + stop) / 2 + (stop - start) / 2 * np.sin(t)
        y = -share * self.half_width(np.clip(s, 0.08, 1)) * np.cos(t)
        z = np.interp(s, (start, stop), self.top_line(np.array([start, stop], np.float64)))
        rim = np.stack([self.length * (s - 0.5), y, z], 1)
        centre = np.broadcast_to(rim[:-1].mean(0), rim.shape)
        lining = np.stack([rim, centre]) + np.array([0, 0, 0.0008])
        towards_toe = (0.55 * lining[1] + 0.45 * rim[4]) * (1, 0, 1)
        shade = lining[0] * (0.62, 0.72, 0.62) + (1 - 0.62) * towards_toe
        shade = shade + np.array([0, 0, 0.0006])
        depth = np.stack([shade, np.broadcast_to(shade[:-1].mean(0), rim.shape)])
        return [
            grid_mesh(lining, inside),
            grid_mesh(depth, DARK),
            tube(rim, thickness, trim, sides=5, capped=False),
        ]

    def solids(self, cuts: Knots) -> tuple[Solid, ...]:
        """The collision solids: the sole's, then two blocks for every (start, stop) of `cuts`.

        The sole is a foot and two round ends. Of the two blocks the low one is wide, the high one
        is narrow and leans with the top line.
        """
        length, low = self.length, self.low
        toe = float(self.half_width(np.array([0.8]))[0])
        heel = float(self.half_width(np.array([0.2]))[0])
        half_height = low / 2 - 0.0002
        middle_z = low / 2 + 0.0002
        middle = (0.13 * length, 0.98 * self.width / 2, half_height)
        solids = [
            Solid("box", (0.32 * length, 0.97 * heel, low / 2), (-0.02 * length, 0, low / 2)),
            Solid("cylinder", (toe, half_height), (length / 2 - toe, 0, middle_z)),
            Solid("box", middle, (0.15 * length, 0, middle_z)),
            Solid("cylinder", (heel, half_height), (heel - length / 2, 0, middle_z)),
        ]
        for start, stop in cuts:
            solids += self._blocks(start, stop)
        return tuple(solids)

    def _blocks(self, start: Number, stop: Number) -> list[Solid]:
        length, low = self.length, self.low
        s = np.linspace(start, stop, 5)
        half_width, top = float(self.half_width(s).mean()), self.top_line(s).tolist()
        x, run = length * ((start + stop) / 2 - 0.5), length * (stop - start)
        lean, middle = float(np.arctan2(top[0] - top[-1], run)), (top[0] + top[-1]) / 2
        high = 0.55 * min(top[0], top[-1]) + 0.45 * low
        half_height = (middle - low) * np.cos(lean) / 2
        upper_z = middle - half_height * np.cos(lean) - 0.0005
        lower_half = (run / 2, 0.93 * half_width, (high - low) / 2)
        return [
            Solid("box", lower_half, (x, 0, (high + low) / 2)),
            Solid(
                kind="box",
                size=(run / 2, 0.70 * half_width, half_height),
                pos=(x - half_height * np.sin(lean), 0, upper_z),
                euler=(0, lean, 0),
            ),
        ]
