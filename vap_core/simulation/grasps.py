"""Where two fingers that point straight down may grasp an object.

From cross sections of its collision solids, and the other objects near the hand.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float64

from vap_core.base.types import value
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.shapes import Hull
from vap_core.simulation.robots import ROBOTS, Robot
from vap_core.simulation.types import Pose

YAWS = np.deg2rad(np.arange(0.0, 180.0, 15.0))
SHARES = (0.55, 0.65, 0.45, 0.75, 0.35)
"""Heights tried, as shares of the object's."""
TIGHT_M = 0.008
"""The open gripper is at least this much wider than what it grasps."""
TIP_M = 0.016
"""Lowest height of the tcp: the fingertips stay off the table."""
ROOM_M = 0.02
"""Clearance beyond this makes a grasp no better."""
TAPER_M = 0.02
"""A taper of 1 counts like so much less clearance."""
RIM_M = 0.005
"""Distance of the points along the edges of other objects, at most."""
HALF_PAD_M = 0.006
"""Half the height of a finger's pad."""
FINGER_M = 0.022
"""Outward thickness of a finger."""
PAD_M = 0.012
"""Half the width of a finger."""


@value
class Grasp:
    """One way to grasp an object.

    The tcp (metres, world), the opening axis' angle in the world (radians), the width between the
    fingers and the whole object's along that axis (m), how much the width changes with height (a
    taper slips), and the least distance of the open fingers to anything else (m).
    """

    tcp_world: Float64[np.ndarray, "3"]
    axis_rad: float
    width_m: float
    span_m: float
    taper: float
    clear_m: float


def points_world(name: str, pose: Pose) -> Float64[np.ndarray, "n 3"]:
    """The corners of the object's collision solids where it stands now."""
    return np.concatenate([_in_world(vertex, pose) for vertex, _ in _hull_edges(name)])


def cut(name: str, pose: Pose, z_world: float) -> Float64[np.ndarray, "n 2"]:
    """Points on the outline of the object at height `z_world`; none above or below it."""
    outlines = []
    for vertex, edge in _hull_edges(name):
        start, end = _in_world(vertex, pose)[edge.astype(int).T]
        below = start[:, 2] - z_world
        above = end[:, 2] - z_world
        crossing = (below < 0) != (above < 0)
        share = (below / np.where(crossing, below - above, 1.0))[crossing, None]
        points = start[crossing] + share * (end - start)[crossing]
        outlines.append(points[:, :2])
    return np.concatenate(outlines)


def grasps(robot: Robot, target: str, poses: Mapping[str, Pose]) -> list[Grasp]:
    """Every grasp of `target` that fits the gripper, the clearest first.

    Those that hit nothing come before those that do.
    """
    points = points_world(target, poses[target])
    others = [_rims(name, pose) for name, pose in poses.items() if name != target]
    candidates = _candidates(robot, target, poses[target], points=points, others=others)
    return sorted(candidates, key=_grasp_cost)


def too_wide_for(name: str) -> list[str]:
    """The robots that find no grasp of the object standing upright, alone on the table."""
    upright = np.array([0.4, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    return [robot.name for robot in ROBOTS.values() if not grasps(robot, name, {name: upright})]


def _grasp_cost(grasp: Grasp) -> tuple[float, float]:
    missing_room = max(ROOM_M - grasp.clear_m, 0.0)
    return round(missing_room + TAPER_M * grasp.taper, 6), round(grasp.width_m, 6)


@lru_cache(maxsize=256)
def _hull_edges(
    name: str,
) -> tuple[tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "e 2"]], ...]:
    """Vertices and edges of every collision solid, in the object's frame."""
    from trimesh import convex, creation

    parts = []
    for solid in objects.get_object(name).form.solids():
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


def _rims(name: str, pose: Pose) -> Float64[np.ndarray, "n 3"]:
    """Points along every edge of the object's collision solids, at most `RIM_M` apart."""
    points = []
    for vertex, edge in _hull_edges(name):
        start, end = _in_world(vertex, pose)[edge.astype(int).T]
        steps = 1 + int(np.linalg.norm(end - start, axis=1).max() / RIM_M)
        share = np.linspace(0.0, 1.0, steps + 1)[:, None, None]
        points.append((start + share * (end - start)).reshape(-1, 3))
    return np.concatenate(points)


def _candidates(
    robot: Robot,
    target: str,
    pose: Pose,
    *,
    points: Float64[np.ndarray, "n 3"],
    others: Sequence[Float64[np.ndarray, "_ 3"]],
) -> Iterator[Grasp]:
    """Grasps at several heights of the object and from several directions."""
    tried: set[float] = set()
    foot = float(points[:, 2].min())
    top = float(points[:, 2].max())
    for share in SHARES:
        z = float(max(foot + share * (top - foot), top - 0.9 * robot.palm_m, TIP_M))
        outline = cut(target, pose, min(z, top - 0.002))
        if round(z, 3) in tried or not len(outline):
            continue
        tried.add(round(z, 3))
        higher = cut(target, pose, z + HALF_PAD_M)
        lower = cut(target, pose, z - HALF_PAD_M)
        for yaw in YAWS:
            axis = np.array([np.cos(yaw), np.sin(yaw)])
            normal = np.array([-axis[1], axis[0]])
            along = outline @ axis
            across = outline @ normal
            width = float(np.ptp(along))
            if width > robot.opening_m - TIGHT_M:
                continue
            middle = (
                axis * (along.min() + along.max()) / 2 + normal * (across.min() + across.max()) / 2
            )
            change = float(_width_along(lower, axis) - _width_along(higher, axis))
            yield Grasp(
                tcp_world=np.array([*middle, z]),
                axis_rad=float(yaw),
                width_m=width,
                span_m=float(np.ptp(points[:, :2] @ axis)),
                taper=abs(change) / (2 * HALF_PAD_M),
                clear_m=_clearance(robot, middle, axis, z, others),
            )


def _width_along(outline: Float64[np.ndarray, "n 2"], axis: np.ndarray) -> float:
    """The extent of an outline along `axis`, 0 for none."""
    return float(np.ptp(outline @ axis)) if len(outline) else 0.0


def _clearance(
    robot: Robot,
    middle: np.ndarray,
    axis: np.ndarray,
    z: float,
    others: Sequence[Float64[np.ndarray, "_ 3"]],
) -> float:
    """Least distance of the open fingers, and of the palm above them, to any other object.

    Across the table, to the points that reach their height.
    """
    least = 1.0
    across = np.array([-axis[1], axis[0]])
    fingers = (z - 0.012, robot.opening_m / 2 + FINGER_M, PAD_M)
    palm = (z + robot.palm_m, robot.hand_m[0], robot.hand_m[1])
    for points in others:
        for low, long, wide in (fingers, palm):
            high = points[points[:, 2] > low][:, :2] - middle
            if not len(high):
                continue
            u = np.abs(high @ axis) - long
            v = np.abs(high @ across) - wide
            outside = np.hypot(np.maximum(u, 0), np.maximum(v, 0))
            apart = outside + np.minimum(np.maximum(u, v), 0)
            least = min(least, float(apart.min()))
    return least


def _in_world(vertex: Float64[np.ndarray, "n 3"], pose: Pose) -> Float64[np.ndarray, "n 3"]:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(pose[3:], scalar_first=True).apply(vertex) + pose[:3]
