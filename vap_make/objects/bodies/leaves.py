"""Leaves of plants and crowns. Lengths are metres."""

import numpy as np

from vap_make.objects.bodies.turned import lathe
from vap_make.objects.shapes import Mesh, Number, join_meshes, rotation_matrix
from vap_make.objects.textures import INK


def thick_leaf(
    length: Number,
    width: Number,
    thickness: Number,
    lean: Number,
    around: Number,
    curl: Number,
    blunt: Number,
    tip: int,
) -> Mesh:
    """A thick pointed leaf from the origin, `lean` radians off vertical towards `around`.

    `curl` bends its end up by curl * length metres; `blunt` is 0 (needle) to 1 (round); `tip` is
    the swatch of its end.
    """
    section = (width / 2, thickness / 2, 2)
    shoulder = (blunt, 0.82 * length)
    blade = join_meshes(
        [
            lathe([(0.6, 0), (1, 0.5 * length), shoulder], INK, 6, section),
            lathe([shoulder, (0, length)], tip, 6, section),
        ]
    )
    height = blade.vertex[:, 2]
    vertex = blade.vertex + np.outer(curl * height**2 / length, [0, 1, 0])
    slope = np.arctan(2 * curl * height / length)
    x, y, z = blade.normal.T
    normal = np.column_stack(
        [x, y * np.cos(slope) + z * np.sin(slope), z * np.cos(slope) - y * np.sin(slope)]
    )
    curled = Mesh(vertex=vertex, normal=normal, uv=blade.uv, face=blade.face)
    return _lean_outwards(curled, lean, around)


def flat_leaf(length: Number, width: Number, around: Number, swatch: int) -> Mesh:
    """A thin leaf that grows outwards from the axis and droops at its end."""
    outline = [(0.7, 0), (1, 0.45 * length), (0.75, 0.75 * length), (0, length)]
    blade = lathe(outline, swatch, 6, section=(width / 2, 0.0009, 2))
    vertex = blade.vertex - np.outer(0.42 * blade.vertex[:, 2] ** 2 / length, [0, 1, 0])
    drooping = Mesh(vertex=vertex, normal=blade.normal, uv=blade.uv, face=blade.face)
    return _lean_outwards(drooping, 1.45, around)


def _lean_outwards(leaf: Mesh, lean: Number, around: Number) -> Mesh:
    leaning = leaf.moved(rotation=rotation_matrix(x=lean))
    return leaning.moved(rotation=rotation_matrix(z=around + np.pi / 2))
