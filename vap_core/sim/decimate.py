"""Fewer triangles for the same surface: edges collapse where the quadric error is least (Garland and Heckbert 1997), many at a time."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array

Vertices = Float[np.ndarray, "n 3"]
Faces = Int[np.ndarray, "f 3"]
LEAST_TURN = 0.3
"""A collapse is refused when it turns a triangle's normal by more than acos of this."""
STIFF = 1e-3
"""Weight of the edge's middle against the quadrics, which leave a flat neighbourhood undecided."""


def decimate(vertex: Vertices, face: Faces, target: int) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, "k 3"]]:
    """Collapse edges of a welded mesh until at most `target` triangles are left, or none can go without folding the surface.

    An edge whose collapse would fold it is sour: it is left out until nothing else can go, then tried once more.
    """
    vertex, quadric, fresh = vertex.copy(), _quadrics(vertex, face), True
    sour: np.ndarray = np.zeros(0, np.int64)
    while len(face) > target:
        edge = edges(face)
        key = edge @ (len(vertex), 1)
        spot, cost = _best(vertex[edge], quadric[edge[:, 0]] + quadric[edge[:, 1]])
        cost[~_simple(edge, face) | np.isin(key, sour)] = np.inf
        chosen = _apart(edge, cost)[: max(1, (len(face) - target) // 2)]
        if not len(chosen):
            if fresh:
                break
            sour, fresh = sour[:0], True
            continue
        fine = _unfolded(vertex, face, edge[chosen], spot[chosen])
        sour, chosen = np.concatenate([sour, key[chosen[~fine]]]), chosen[fine]
        fresh &= not len(chosen)
        keep, drop = edge[chosen].T
        vertex[keep] = spot[chosen]
        quadric[keep] += quadric[drop]
        alias = np.arange(len(vertex))
        alias[drop] = keep
        face = alias[face]
        face = face[(face != np.roll(face, 1, axis=1)).all(axis=1)]
    used, packed = np.unique(face, return_inverse=True)
    return vertex[used], packed.reshape(-1, 3)


def edges(face: Faces) -> Int[np.ndarray, "e 2"]:
    """Every edge once, its smaller vertex first."""
    low, high = np.sort(face[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).T
    base = int(face.max()) + 1
    return np.stack(np.divmod(np.unique(low * base + high), base), axis=1)


def normals(corner: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f 3"]:
    """Normals of triangles, as long as twice their areas."""
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def _quadrics(vertex: Vertices, face: Faces) -> Float[np.ndarray, "n 4 4"]:
    """Sum over a vertex's triangles of area times the squared distance to their planes, as quadratic forms in (x, y, z, 1)."""
    normal = normals(vertex[face])
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    unit = normal / np.maximum(size, 1e-30)
    plane = np.concatenate([unit, -(unit * vertex[face[:, 0]]).sum(axis=1, keepdims=True)], axis=1)
    each = size[:, :, None] * plane[:, :, None] * plane[:, None, :]
    total = np.zeros((len(vertex), 4, 4))
    for corner in face.T:
        np.add.at(total, corner, each)
    return total


def _best(ends: Float[np.ndarray, "e 2 3"], quadric: Float[np.ndarray, "e 4 4"]) -> tuple[Float[np.ndarray, "e 3"], Float[np.ndarray, " e"]]:
    """Where each edge collapses to, and what that costs."""
    middle = ends.mean(axis=1)
    weight = STIFF * np.trace(quadric[:, :3, :3], axis1=1, axis2=2)[:, None] + 1e-30
    left = quadric[:, :3, :3] + weight[:, :, None] * np.eye(3)
    spot = np.linalg.solve(left, (weight * middle - quadric[:, :3, 3])[:, :, None])[:, :, 0]
    homogeneous = np.concatenate([spot, np.ones((len(spot), 1))], axis=1)
    length = ((ends[:, 0] - ends[:, 1]) ** 2).sum(axis=1)
    return spot, np.einsum("ei,eij,ej->e", homogeneous, quadric, homogeneous) + 0.01 * weight[:, 0] * length


def _simple(edge: Int[np.ndarray, "e 2"], face: Faces) -> Bool[np.ndarray, " e"]:
    """Edges whose ends share exactly the two vertices opposite to them: only these collapse without pinching the surface."""
    n = int(face.max()) + 1
    a, b = edge.T
    ones = np.ones(2 * len(edge), np.int32)
    near = coo_array((ones, (np.concatenate([a, b]), np.concatenate([b, a]))), shape=(n, n)).tocsr()
    shared = np.asarray(near[a].multiply(near[b]).sum(axis=1)).ravel()
    return shared == 2


def _apart(edge: Int[np.ndarray, "e 2"], cost: Float[np.ndarray, " e"]) -> Int[np.ndarray, " k"]:
    """Edges that are the cheapest within a ring around both of their ends, cheapest first; no two touch the same triangle."""
    order = np.argsort(cost, kind="stable")
    rank = np.empty(len(edge), np.int64)
    rank[order] = np.arange(len(edge))
    own = np.full(int(edge.max()) + 1, len(edge))
    np.minimum.at(own, edge.ravel(), rank.repeat(2))
    ring = own.copy()
    np.minimum.at(ring, edge[:, 0], own[edge[:, 1]])
    np.minimum.at(ring, edge[:, 1], own[edge[:, 0]])
    free = (ring[edge] == rank[:, None]).all(axis=1) & np.isfinite(cost)
    return order[free[order]]


def _unfolded(vertex: Vertices, face: Faces, edge: Int[np.ndarray, "k 2"], spot: Float[np.ndarray, "k 3"]) -> Bool[np.ndarray, " k"]:
    """Which collapses turn none of the triangles that stay."""
    owner = np.full(len(vertex), -1)
    owner[edge.ravel()] = np.arange(len(edge)).repeat(2)
    moved = vertex.copy()
    moved[edge.ravel()] = spot.repeat(2, axis=0)
    touched = owner[face]
    stays = (touched >= 0).sum(axis=1) == 1
    before, after = normals(vertex[face[stays]]), normals(moved[face[stays]])
    size = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    bad = (before * after).sum(axis=1) <= LEAST_TURN * size
    fine = np.ones(len(edge), bool)
    fine[touched[stays].max(axis=1)[bad]] = False
    return fine
