"""How far the gripper was from the objects at every step."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from vap_core.rollout.types import EpisodeHeader, Frame
from vap_core.simulation import robots
from vap_core.simulation.suites import suite


def nearest_other_m(header: EpisodeHeader, frames: Sequence[Frame]) -> np.ndarray | None:
    """From the tcp to the nearest bounding box of an object that is neither target nor goal.

    Metres, one number per frame; None where there is no such object.
    """
    row = header.row
    names = []
    for name in frames[0].truth.objects_world:
        if name not in (row.target, row.goal):
            names.append(name)
    if not names:
        return None
    tcp = tcp_world(header, frames)
    gaps = [
        box_gaps_m(tcp, poses_world(frames, name), header.object_sizes_m[name]) for name in names
    ]
    return np.min(gaps, axis=0)


def tcp_world(header: EpisodeHeader, frames: Sequence[Frame]) -> np.ndarray:
    """The tcp in the world frame, metres, a row per frame."""
    base = robots.get(suite(header.row.suite).robot).base_world
    tcp = np.array([frame.state[:3] for frame in frames], np.float64)
    return Rotation.from_quat(base[[4, 5, 6, 3]]).apply(tcp) + base[:3]


def poses_world(frames: Sequence[Frame], name: str) -> np.ndarray:
    """An object's poses, a row per frame."""
    return np.stack([frame.truth.objects_world[name] for frame in frames])


def box_gaps_m(
    points: np.ndarray, poses: np.ndarray, size: tuple[float, float, float]
) -> np.ndarray:
    """From every point to an object's bounding box at that step, metres; 0 inside.

    The object's origin is the centre of its base.
    """
    turns = Rotation.from_quat(poses[:, [4, 5, 6, 3]])
    local = turns.inv().apply(points - poses[:, :3]) - [0.0, 0.0, size[2] / 2]
    outside = np.maximum(np.abs(local) - np.asarray(size) / 2, 0.0)
    return np.asarray(np.linalg.norm(outside, axis=1))
