"""Whether a surface is closed, and closing it: crumbs dropped, triangles turned alike, holes capped."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vap_core.sim.scans.triangles import Faces, Vertices, normals

CRUMB = 0.02
"""A separate piece with less than this share of the area is dropped."""
MoreVertices = Float[np.ndarray, "m 3"]
OtherFaces = Int[np.ndarray, "k 3"]


def flaws(face: Faces) -> tuple[int, int]:
    """How many edges do not join exactly two triangles, and how many of the others join two that face opposite ways."""
    edge = _directed(face)
    _, which, uses = np.unique(_keys(np.sort(edge, axis=1)), return_inverse=True, return_counts=True)
    paired = edge[uses[which] == 2]
    return int((uses != 2).sum()), len(paired) - len(np.unique(_keys(paired)))


def close(vertex: Vertices, face: Faces) -> tuple[MoreVertices, OtherFaces]:
    """The surface as closed as simple means allow; what is left open shows in `flaws`."""
    import trimesh

    _, first = np.unique(np.sort(face, axis=1), axis=0, return_index=True)
    kept = face[np.sort(first)]
    kept = kept[_large(vertex, kept)]
    while (crowded := _crowded(kept)).any() and not crowded.all():
        kept = kept[~crowded]
    if flaws(kept)[1]:
        mesh = trimesh.Trimesh(vertex, kept, process=False)
        trimesh.repair.fix_winding(mesh)
        kept = np.array(mesh.faces, np.int64)
    points, caps = [vertex], [kept]
    for loop in _loops(_rims(kept)):
        centre = sum(map(len, points))
        points.append(vertex[loop].mean(axis=0, keepdims=True))
        caps.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), centre)], axis=1))
    return np.concatenate(points), np.concatenate(caps)


def _directed(face: Faces) -> Int[np.ndarray, "e 2"]:
    return face[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _keys(edge: Int[np.ndarray, "e 2"]) -> Int[np.ndarray, " e"]:
    return edge[:, 0] * (1 << 31) + edge[:, 1]


def _large(vertex: Vertices, face: Faces) -> Bool[np.ndarray, " f"]:
    """Triangles of pieces that are no crumbs."""
    edge = _directed(face)
    joined = coo_array((np.ones(len(edge), np.int8), (edge[:, 0], edge[:, 1])), shape=(len(vertex), len(vertex)))
    piece = connected_components(joined, directed=False)[1][face[:, 0]]
    area = np.bincount(piece, np.linalg.norm(normals(vertex[face]), axis=1))
    return (area >= CRUMB * area.sum())[piece]


def _crowded(face: Faces) -> Bool[np.ndarray, " f"]:
    """Triangles at an edge that joins more than two."""
    _, which, uses = np.unique(_keys(np.sort(_directed(face), axis=1)), return_inverse=True, return_counts=True)
    return (uses[which].reshape(-1, 3) > 2).any(axis=1)


def _rims(face: Faces) -> Int[np.ndarray, "e 2"]:
    """Edges with a triangle on one side only, as that triangle runs along them."""
    edge = _directed(face)
    _, which, uses = np.unique(_keys(np.sort(edge, axis=1)), return_inverse=True, return_counts=True)
    return edge[uses[which] == 1]


def _loops(rim: Int[np.ndarray, "e 2"]) -> list[np.ndarray]:
    """Closed walks along the rims that pass no vertex twice."""
    onward: dict[int, list[int]] = {}
    for start, end in rim.tolist():
        onward.setdefault(start, []).append(end)
    loops = []
    for first in list(onward):
        walk, place = [first], {first: 0}
        while onward.get(walk[-1]):
            step = onward[walk[-1]].pop()
            if step not in place:
                place[step] = len(walk)
                walk.append(step)
                continue
            loop, walk = walk[place[step] :], walk[: place[step] + 1]
            for vertex in loop[1:]:
                del place[vertex]
            loops.append(np.array(loop))
    return loops
