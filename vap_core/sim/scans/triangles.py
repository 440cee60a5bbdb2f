"""Triangles as plain arrays: their edges, their normals, and fewer of them for the same surface."""

import numpy as np
from jaxtyping import Float, Int

Vertices = Float[np.ndarray, "n 3"]
Faces = Int[np.ndarray, "f 3"]


def decimate(vertex: Vertices, face: Faces, target: int) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, "k 3"]]:
    """About `target` triangles for a welded mesh, by quadric edge collapses (fast-simplification)."""
    from fast_simplification import simplify

    points, triangles = simplify(vertex, face.astype(np.int32), target_count=target, agg=3.0)
    return np.asarray(points, np.float64), np.asarray(triangles, np.int64)


def edges(face: Faces) -> Int[np.ndarray, "e 2"]:
    """Every edge once, its smaller vertex first."""
    low, high = np.sort(face[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).T
    base = int(face.max()) + 1
    return np.stack(np.divmod(np.unique(low * base + high), base), axis=1)


def normals(corner: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f 3"]:
    """Normals of triangles, as long as twice their areas."""
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
