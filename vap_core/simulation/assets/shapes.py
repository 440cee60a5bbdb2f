"""What an object is made of: one textured triangle mesh and a handful of collision solids.

Lengths are metres. Every shape stands on z = 0, centred on the z axis, with its front towards -y.
"""

from collections.abc import Sequence
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from vap_core.base.types import value

Number = float | int
Vector = tuple[Number, Number, Number]
"""A position or three half-sizes, metres."""
SIDES = (-1, 1)
"""Signs of the two sides of a symmetric body: -x or -y first."""


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
        if rotation is None:
            rotation = np.eye(3)
        return Mesh(
            vertex=self.vertex @ rotation.T + np.array(offset, np.float64),
            normal=self.normal @ rotation.T,
            uv=self.uv,
            face=self.face,
        )


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
        match self.axis:
            case "x":
                lay = rotation_matrix(y=np.pi / 2)
            case "y":
                lay = rotation_matrix(x=-np.pi / 2)
            case "z":
                lay = np.eye(3)
        return rotation_matrix(*self.euler) @ lay


@value
class Hull:
    """A convex collision solid of any form: its corners (metres) and its volume (cubic metres)."""

    vertex: Float[np.ndarray, "n 3"]
    volume: float


@runtime_checkable
class Shape(Protocol):
    """The parameters of one body, which give its mesh and its collision solids."""

    def mesh(self) -> Mesh:
        """The visual mesh, with texture coordinates into the body's texture."""
        ...

    def solids(self) -> tuple[Solid, ...] | tuple[Hull, ...]:
        """The collision solids, in the mesh's frame."""
        ...

    def aspect(self) -> float:
        """Circumference of the decorated wall over its height."""
        ...


def rotation_matrix(x: Number = 0, y: Number = 0, z: Number = 0) -> np.ndarray:
    """Rotation about x, then y, then z (radians), 3 x 3."""
    cos_x, sin_x = np.cos(x), np.sin(x)
    cos_y, sin_y = np.cos(y), np.sin(y)
    cos_z, sin_z = np.cos(z), np.sin(z)
    about_x = np.array([[1, 0, 0], [0, cos_x, -sin_x], [0, sin_x, cos_x]])
    about_y = np.array([[cos_y, 0, sin_y], [0, 1, 0], [-sin_y, 0, cos_y]])
    about_z = np.array([[cos_z, -sin_z, 0], [sin_z, cos_z, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def join_meshes(parts: Sequence[Mesh]) -> Mesh:
    """All parts as one mesh."""
    vertices, normals, uvs, faces = [], [], [], []
    first_vertex = 0
    for part in parts:
        vertices.append(part.vertex)
        normals.append(part.normal)
        uvs.append(part.uv)
        faces.append(part.face + first_vertex)
        first_vertex += len(part.vertex)
    return Mesh(
        vertex=np.concatenate(vertices),
        normal=np.concatenate(normals),
        uv=np.concatenate(uvs),
        face=np.concatenate(faces),
    )


def foot_box(radius: Number) -> Solid:
    """A square foot inside the circle: boxes rest on four contacts, cylinders on fewer."""
    return Solid("box", (0.74 * radius, 0.74 * radius, 0.002), (0, 0, 0.002))


def upright_cylinder(radius: float, low: float, high: float) -> Solid:
    """A cylinder around the z axis from z = `low` to z = `high`."""
    return Solid("cylinder", (radius, (high - low) / 2), (0, 0, (high + low) / 2))


def stacked_cylinders(
    radii: Float[np.ndarray, " k"], levels: Float[np.ndarray, " k_plus_1"]
) -> tuple[Solid, ...]:
    """Cylinders around the z axis; number i stands between `levels` i and i + 1."""
    stack = []
    for i, radius in enumerate(radii):
        stack.append(upright_cylinder(float(radius), float(levels[i]), float(levels[i + 1])))
    return tuple(stack)
