"""Meshes and solids put together, and what a parametric body is."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from vap_core.simulation.assets.shapes import Mesh as Mesh
from vap_core.simulation.assets.shapes import Number as Number
from vap_core.simulation.assets.shapes import Solid as Solid
from vap_core.simulation.assets.shapes import Vector as Vector
from vap_core.simulation.assets.shapes import rotation_matrix as rotation_matrix

SIDES = (-1, 1)
"""Signs of the two sides of a symmetric body: -x or -y first."""


@runtime_checkable
class Shape(Protocol):
    """The parameters of one body, which give its mesh and its collision solids."""

    def mesh(self) -> Mesh:
        """The visual mesh, with texture coordinates into the body's texture."""
        ...

    def solids(self) -> tuple[Solid, ...]:
        """The collision solids, in the mesh's frame."""
        ...

    def aspect(self) -> float:
        """Circumference of the decorated wall over its height."""
        ...


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
