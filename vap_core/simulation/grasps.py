"""Where two fingers that point straight down may take an object: cuts through its collision solids, and what stands in the hand's way."""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float64

from vap_core.base.types import value
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.shapes import Hull
from vap_core.simulation.robots import Robot
from vap_core.simulation.types import Pose

YAWS = np.deg2rad(np.arange(0.0, 180.0, 15.0))
SHARES = (0.55, 0.65, 0.45, 0.75, 0.35)
"""Heights tried, as shares of the object's."""
TIGHT_M = 0.008
"""The open gripper is at least this much wider than what it takes."""
TIP_M = 0.016
"""Lowest height of the tcp: the fingertips stay off the table."""
ROOM_M, TAPER_M = 0.02, 0.02
"""Clearance beyond this counts for nothing; a taper of 1 counts like so much less of it."""
RIM_M = 0.005
HALF_PAD_M = 0.006
"""Half the height of a finger's pad."""
FINGER_M, PAD_M = 0.022, 0.012
"""Outward thickness of a finger, and half its width."""


@value
class Grasp:
    """One way to take an object: the tcp (metres, world), the opening axis' angle in the world (radians), the width between the fingers and
    the whole object's along that axis (m), how much the width changes with height (a taper slips), and the least distance of the open
    fingers to anything else (m).
    """

    tcp_world: Float64[np.ndarray, "3"]
    axis_rad: float
    width_m: float
    span_m: float
    taper: float
    clear_m: float


@lru_cache(maxsize=256)
def _hull_edges(
    name: str,
) -> tuple[tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "e 2"]], ...]:
    """Vertices and edges of every collision solid, in the object's frame."""
    from trimesh import convex, creation

    parts = []
    for solid in objects.get_object(name).shape.solids():
        if isinstance(solid, Hull):
            hull = convex.convex_hull(solid.vertex)
            parts.append((np.asarray(hull.vertices), np.asarray(hull.edges_unique, np.float64)))
            continue
        size = solid.size
        match solid.kind:
            case "box":
                body = creation.box(extents=[2 * side for side in size])
            case "cylinder":
                body = creation.cylinder(radius=size[0], height=2 * size[1], sections=24)
            case "capsule":
                body = creation.capsule(radius=size[0], height=2 * size[1], count=(12, 12))
            case "ellipsoid":
                body = creation.icosphere(subdivisions=2).apply_scale(size)
        vertex = np.asarray(body.vertices) @ solid.rotation().T + np.asarray(solid.pos, np.float64)
        parts.append((vertex, np.asarray(body.edges_unique, np.float64)))
    return tuple(parts)


def points_world(name: str, pose: Pose) -> Float64[np.ndarray, "n 3"]:
    """The corners of the object's collision solids where it stands now."""
    return np.concatenate([_place(vertex, pose) for vertex, _ in _hull_edges(name)])


def cut(name: str, pose: Pose, z_world: float) -> Float64[np.ndarray, "n 2"]:
    """Points on the outline of the object at height `z_world`; none above or below it."""
    found = []
    for vertex, edge in _hull_edges(name):
        start, end = _place(vertex, pose)[edge.astype(int).T]
        below, above = start[:, 2] - z_world, end[:, 2] - z_world
        crossing = (below < 0) != (above < 0)
        share = (below / np.where(crossing, below - above, 1.0))[crossing, None]
        found.append((start[crossing] + share * (end - start)[crossing])[:, :2])
    return np.concatenate(found)


def grasps(robot: Robot, target: str, poses: Mapping[str, Pose]) -> list[Grasp]:
    """Every grasp of `target` that fits the gripper and hits nothing, the clearest first; then those that hit something, should none be clear."""
    points = points_world(target, poses[target])
    others = [_rims(name, pose) for name, pose in poses.items() if name != target]
    found = list(_candidates(robot, target, poses[target], points, others))
    return sorted(
        found,
        key=lambda grasp: (
            round(max(ROOM_M - grasp.clear_m, 0.0) + TAPER_M * grasp.taper, 6),
            round(grasp.width_m, 6),
        ),
    )


def _rims(name: str, pose: Pose) -> Float64[np.ndarray, "n 3"]:
    """Points along every edge of the object's collision solids, at most `RIM_M` apart."""
    points = []
    for vertex, edge in _hull_edges(name):
        start, end = _place(vertex, pose)[edge.astype(int).T]
        steps = 1 + int(np.linalg.norm(end - start, axis=1).max() / RIM_M)
        share = np.linspace(0.0, 1.0, steps + 1)[:, None, None]
        points.append((start + share * (end - start)).reshape(-1, 3))
    return np.concatenate(points)


def _candidates(
    robot: Robot,
    target: str,
    pose: Pose,
    points: Float64[np.ndarray, "n 3"],
    others: Sequence[Float64[np.ndarray, "_ 3"]],
) -> Iterator[Grasp]:
    tried: set[float] = set()
    foot, top = float(points[:, 2].min()), float(points[:, 2].max())
    for share in SHARES:
        z = float(max(foot + share * (top - foot), top - 0.9 * robot.palm_m, TIP_M))
        outline = cut(target, pose, min(z, top - 0.002))
        if round(z, 3) in tried or not len(outline):
            continue
        tried.add(round(z, 3))
        higher, lower = cut(target, pose, z + HALF_PAD_M), cut(target, pose, z - HALF_PAD_M)
        for yaw in YAWS:
            axis = np.array([np.cos(yaw), np.sin(yaw)])
            along, across = outline @ axis, outline @ [-axis[1], axis[0]]
            width = float(np.ptp(along))
            if width > robot.opening_m - TIGHT_M:
                continue
            spans = [np.ptp(part @ axis) if len(part) else 0.0 for part in (higher, lower)]
            middle = (
                axis * (along.min() + along.max()) / 2
                + np.array([-axis[1], axis[0]]) * (across.min() + across.max()) / 2
            )
            taper = abs(float(spans[1] - spans[0])) / (2 * HALF_PAD_M)
            yield Grasp(
                np.array([*middle, z]),
                float(yaw),
                width,
                float(np.ptp(points[:, :2] @ axis)),
                taper,
                _clearance(robot, middle, axis, z, others),
            )


def _clearance(
    robot: Robot,
    middle: np.ndarray,
    axis: np.ndarray,
    z: float,
    others: Sequence[Float64[np.ndarray, "_ 3"]],
) -> float:
    """Least distance, across the table, of the open fingers (and of the palm above them) to anything that reaches their height."""
    least = 1.0
    across = np.array([-axis[1], axis[0]])
    reach = robot.opening_m / 2 + FINGER_M
    for points in others:
        for low, long, wide in (
            (z - 0.012, reach, PAD_M),
            (z + robot.palm_m, robot.hand_m[0], robot.hand_m[1]),
        ):
            high = points[points[:, 2] > low][:, :2] - middle
            if not len(high):
                continue
            u, v = np.abs(high @ axis) - long, np.abs(high @ across) - wide
            apart = np.hypot(np.maximum(u, 0), np.maximum(v, 0)) + np.minimum(np.maximum(u, v), 0)
            least = min(least, float(apart.min()))
    return least


def _place(vertex: Float64[np.ndarray, "n 3"], pose: Pose) -> Float64[np.ndarray, "n 3"]:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(pose[3:], scalar_first=True).apply(vertex) + pose[:3]
