"""Whether a surface is closed, and closing it.

Repair drops small separate pieces, turns triangles to face the same way, and caps holes.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vap_core.simulation.assets.triangles import Faces, Vertices, area_vectors

SMALLEST_PIECE = 0.02
"""A separate piece with less than this share of the area is dropped."""
Edges = Int[np.ndarray, "e 2"]


def count_edge_flaws(face: Faces) -> tuple[int, int]:
    """How many edges do not join exactly two triangles, and how many join two that face apart.

    Two triangles face opposite ways where both run along their edge in the same direction.
    """
    edge = _directed_edges(face)
    number, uses = _edge_uses(edge)
    paired = edge[uses[number] == 2]
    return int((uses != 2).sum()), len(paired) - len(np.unique(_edge_keys(paired)))


def close_surface(
    vertex: Vertices, face: Faces
) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, "k 3"]]:
    """The surface as closed as simple means allow; `count_edge_flaws` shows what is left open."""
    import trimesh

    _, first = np.unique(np.sort(face, axis=1), axis=0, return_index=True)
    kept = face[np.sort(first)]
    kept = kept[_in_large_piece(vertex, kept)]
    kept = _without_crowded_edges(kept)
    _, facing_apart = count_edge_flaws(kept)
    if facing_apart:
        mesh = trimesh.Trimesh(vertex, kept, process=False)
        trimesh.repair.fix_winding(mesh)
        kept = np.array(mesh.faces, np.int64)
    vertices, faces = [vertex], [kept]
    count = len(vertex)
    for loop in _boundary_loops(_boundary_edges(kept)):
        vertices.append(vertex[loop].mean(axis=0, keepdims=True))
        centre = np.full(len(loop), count)
        faces.append(np.stack([np.roll(loop, -1), loop, centre], axis=1))
        count += 1
    return np.concatenate(vertices), np.concatenate(faces)


def _directed_edges(face: Faces) -> Edges:
    """Three edges a triangle, in the direction in which it runs along them."""
    return face[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _edge_keys(edge: Edges) -> Int[np.ndarray, " e"]:
    """One number for each pair of vertices."""
    return edge[:, 0] * (1 << 31) + edge[:, 1]


def _edge_uses(edge: Edges) -> tuple[Int[np.ndarray, " e"], Int[np.ndarray, " u"]]:
    """The number of each edge regardless of direction, and how often each number occurs."""
    keys = _edge_keys(np.sort(edge, axis=1))
    _, number, uses = np.unique(keys, return_inverse=True, return_counts=True)
    return number, uses


def _in_large_piece(vertex: Vertices, face: Faces) -> Bool[np.ndarray, " f"]:
    """Which triangles belong to a piece of at least `SMALLEST_PIECE` of the area."""
    edge = _directed_edges(face)
    joined = coo_array(
        (np.ones(len(edge), np.int8), (edge[:, 0], edge[:, 1])), shape=(len(vertex), len(vertex))
    )
    _, label = connected_components(joined, directed=False)
    piece = label[face[:, 0]]
    area = np.bincount(piece, np.linalg.norm(area_vectors(vertex[face]), axis=1))
    return (area >= SMALLEST_PIECE * area.sum())[piece]


def _without_crowded_edges(face: Faces) -> Int[np.ndarray, "k 3"]:
    """The triangles left when those at edges that join more than two are dropped, repeatedly."""
    while True:
        number, uses = _edge_uses(_directed_edges(face))
        crowded = (uses[number].reshape(-1, 3) > 2).any(axis=1)
        if not crowded.any() or crowded.all():
            return face
        face = face[~crowded]


def _boundary_edges(face: Faces) -> Edges:
    """Edges with a triangle on one side only, in the direction in which it runs along them."""
    edge = _directed_edges(face)
    number, uses = _edge_uses(edge)
    return edge[uses[number] == 1]


def _boundary_loops(boundary: Edges) -> list[Int[np.ndarray, " k"]]:
    """Closed walks along the boundary that pass no vertex twice."""
    onward: dict[int, list[int]] = {}
    for start, end in boundary.tolist():
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
