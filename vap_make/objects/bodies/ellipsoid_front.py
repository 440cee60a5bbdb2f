"""Parts placed on the front (-y) of an ellipsoid, as eyes and noses of animals are."""

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.turned import ellipsoid
from vap_make.objects.shapes import Mesh, Number, Vector, rotation_matrix


@value
class EllipsoidFront:
    """The front half of an ellipsoid: its half-axes and its centre, metres."""

    half: Vector
    centre: Vector

    def place(self, x: Number, z: Number, raised: Number = 0) -> tuple[np.ndarray, np.ndarray]:
        """The surface point at (x, z) from the centre, and the rotation of -y to its normal.

        The point is raised by `raised` metres.
        """
        half = self.half
        y = -half[1] * np.sqrt(max(0.0, 1 - (x / half[0]) ** 2 - (z / half[2]) ** 2))
        outward = np.array([x, y, z]) / np.array(half, np.float64) ** 2
        outward /= np.linalg.norm(outward)
        point = np.array([x, y, z]) + np.array(self.centre) + raised * outward
        facing = rotation_matrix(x=-np.arcsin(outward[2]), z=np.arctan2(outward[0], -outward[1]))
        return point, facing

    def lens(
        self,
        x: Number,
        z: Number,
        size: Vector,
        swatch: int,
        raised: Number = 0,
        segments: int = 10,
    ) -> Mesh:
        """An ellipsoid (half-width, half-thickness, half-height) on the surface."""
        point, facing = self.place(x, z, raised)
        return ellipsoid(size, swatch, segments, rows=4).moved(point, facing)
