"""Triangles as plain arrays: their normals, and fewer of them for the same surface."""

import numpy as np
from jaxtyping import Float, Int

Vertices = Float[np.ndarray, "n 3"]
Faces = Int[np.ndarray, "f 3"]
"""Vertex numbers of each triangle, counter-clockwise seen from outside."""


def area_vectors(corners: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f 3"]:
    """Normals of triangles, as long as twice their areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def decimate(
    vertex: Vertices, face: Faces, target: int
) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, "k 3"]]:
    """About `target` triangles for a welded mesh, by quadric edge collapses."""
    from fast_simplification import simplify

    fewer_vertices, fewer_faces = simplify(
        vertex, face.astype(np.int32), target_count=target, agg=3.0
    )
    return np.asarray(fewer_vertices, np.float64), np.asarray(fewer_faces, np.int64)
