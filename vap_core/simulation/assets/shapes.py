"""What an object is made of: a textured triangle mesh, collision solids, and its decoration.

Lengths are metres. Every object stands on z = 0, centred on the z axis, with its front towards -y.
"""

from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from vap_core.base.types import Rgb, value

Number = float | int
Vector = tuple[Number, Number, Number]
"""A position or three half-sizes, metres."""
Srgb = tuple[int, int, int]
"""A colour, 0..255 a channel."""
Vertices = Float[np.ndarray, "n 3"]
Faces = Int[np.ndarray, "f 3"]
"""Vertex numbers of each triangle, counter-clockwise seen from outside."""


@value
class Mesh:
    """Triangles, wound counter-clockwise seen from outside.

    Every vertex has one normal and one texture coordinate (image x, y in 0..1).
    """

    vertex: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"]
    face: Int[np.ndarray, "f 3"]

    def moved(
        self, offset: Vector | np.ndarray = (0, 0, 0), rotation: np.ndarray | None = None
    ) -> "Mesh":
        """The mesh turned by the 3 x 3 rotation, then shifted by `offset` metres."""
        turn = np.eye(3) if rotation is None else rotation
        vertex = self.vertex @ turn.T + np.array(offset, np.float64)
        return Mesh(vertex, self.normal @ turn.T, self.uv, self.face)


@value
class Solid:
    """A collision primitive.

    `size` holds the half-extents of a box or an ellipsoid, or the (radius, half-length) of a
    cylinder or a capsule along `axis`, metres. `euler` then rotates it: radians about x, y and z,
    in that order.
    """

    kind: Literal["box", "cylinder", "ellipsoid", "capsule"]
    size: tuple[Number, ...]
    pos: Vector
    axis: Literal["x", "y", "z"] = "z"
    euler: Vector = (0, 0, 0)

    @property
    def volume(self) -> float:
        """Cubic metres."""
        match self.kind:
            case "box":
                return float(8 * np.prod(self.size))
            case "ellipsoid":
                return float(4 / 3 * np.pi * np.prod(self.size))
            case "cylinder":
                return float(2 * np.pi * self.size[0] ** 2 * self.size[1])
            case "capsule":
                return float(np.pi * self.size[0] ** 2 * (2 * self.size[1] + 4 / 3 * self.size[0]))

    def rotation(self) -> np.ndarray:
        """Body from solid, 3 x 3, for a primitive that lies along its own z."""
        lay = {"x": (0, np.pi / 2, 0), "y": (-np.pi / 2, 0, 0), "z": (0, 0, 0)}[self.axis]
        return rotation_matrix(*self.euler) @ rotation_matrix(*lay)


@value
class Hull:
    """A convex collision solid of any form: its corners (metres) and its volume (cubic metres)."""

    vertex: Float[np.ndarray, "n 3"]
    volume: float


@value
class Texture:
    """A decoration: `motif` is a glyph that is repeated, or a fill, fabric or craft.

    `repeats` counts motifs around the body. Motifs "word" and "digit" draw `word`. `seed` places
    scattered glyphs and random fills.
    """

    base: Srgb
    ink: Srgb
    accent: Srgb
    motif: str
    layout: str = "full"
    repeats: int = 4
    word: str = ""
    seed: int = 0


@runtime_checkable
class Form(Protocol):
    """Where an object's mesh, collision solids and picture come from."""

    def mesh(self) -> Mesh: ...

    def solids(self) -> tuple[Solid, ...] | tuple[Hull, ...]: ...

    def picture(self) -> Rgb:
        """What the mesh's texture coordinates point into."""
        ...


def rotation_matrix(x: Number = 0, y: Number = 0, z: Number = 0) -> np.ndarray:
    """Rotation about x, then y, then z (radians), 3 x 3."""
    cos_x, sin_x = np.cos(x), np.sin(x)
    cos_y, sin_y = np.cos(y), np.sin(y)
    cos_z, sin_z = np.cos(z), np.sin(z)
    about_x = np.array([[1, 0, 0], [0, cos_x, -sin_x], [0, sin_x, cos_x]])
    about_y = np.array([[cos_y, 0, sin_y], [0, 1, 0], [-sin_y, 0, cos_y]])
    return np.array([[cos_z, -sin_z, 0], [sin_z, cos_z, 0], [0, 0, 1]]) @ about_y @ about_x


def area_vectors(corners: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f 3"]:
    """Normals of triangles, as long as twice their areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
