"""What happened in an episode, as the rules look at it."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from vap_core.failures.labels import Limits
from vap_core.sim import robots
from vap_core.suites import suite
from vap_core.suites.rules import Judge
from vap_core.values import Episode, Frame, Pose, Shown, value


@value
class Course:
    """What the rules look at, one entry per recorded step; nothing in it depends on the limits.

    `others` and `touches` say which objects other than the goal the robot touched in a step, and whether the target was one; `gap_m` how far the
    tcp is from the target's bounding box; `lift_m` how much higher each object stands than at first, and `moved_m` how far it has moved; `grip` the
    gripper's command, 0 closed .. 1 open, nan at the terminal frame, which has none.
    """

    target: str
    rule: str
    steps: tuple[int, ...]
    shown: tuple[tuple[Shown, ...], ...]
    others: tuple[tuple[str, ...], ...]
    touches: tuple[bool, ...]
    held: tuple[frozenset[str], ...]
    gap_m: Float64[np.ndarray, " t"]
    lift_m: Mapping[str, Float64[np.ndarray, " t"]]
    moved_m: Mapping[str, Float64[np.ndarray, " t"]]
    grip: Float64[np.ndarray, " t"]
    candidates: Mapping[str, int]
    prompted: bool


def told(episode: Episode) -> bool:
    """Whether the simulator's truth is there to follow."""
    return bool(episode.frames) and bool(episode.frames[0].truth.objects_world)


def follow(episode: Episode) -> Course:
    """An episode's course, from its frames."""
    opening, frames = episode.opening, episode.frames
    row = opening.row
    judge = Judge.start(row, opening.target_sizes_m, frames[0].truth)
    names = [name for name in judge.start_world if name != row.goal]
    base = robots.get(suite(row.suite).robot).base_world
    touched = [tuple(name for name in frame.truth.touched if name != row.goal) for frame in frames]
    return Course(
        row.target,
        row.rule,
        tuple(frame.frame_index for frame in frames),
        tuple(frame.shown for frame in frames),
        tuple(tuple(name for name in names if name != row.target) for names in touched),
        tuple(row.target in names for names in touched),
        tuple(frame.truth.held for frame in frames),
        np.array([_gap(frame, row.target, opening.target_sizes_m[row.target], base) for frame in frames]),
        {name: np.array([frame.truth.objects_world[name][2] - judge.start_world[name][2] for frame in frames]) for name in names},
        {name: np.array([judge.travel_m(name, frame.truth) for frame in frames]) for name in names},
        np.array([np.nan if frame.action is None else float(frame.action[-1]) for frame in frames]),
        {camera: len(per_target[0].candidates) if per_target else 0 for camera, per_target in opening.groundings.items()},
        any(frame.shown for frame in frames),
    )


def _gap(frame: Frame, name: str, size: tuple[float, float, float], base: Pose) -> float:
    """From the tcp to an object's bounding box, metres; 0 inside."""
    from scipy.spatial.transform import Rotation

    tcp = base[:3] + Rotation.from_quat(base[3:], scalar_first=True).apply(frame.state[:3].astype(np.float64))
    pose = frame.truth.objects_world[name]
    local = Rotation.from_quat(pose[3:], scalar_first=True).inv().apply(tcp - pose[:3]) - [0.0, 0.0, size[2] / 2]
    return float(np.linalg.norm(np.maximum(np.abs(local) - np.asarray(size) / 2, 0.0)))


def first(flags: Sequence[bool]) -> int | None:
    return next((i for i, flag in enumerate(flags) if flag), None)


def carried(course: Course, limits: Limits, name: str) -> list[bool]:
    return [name in held and lift >= limits.lift_m for held, lift in zip(course.held, course.lift_m[name].tolist(), strict=True)]


def runs(flags: Sequence[bool]) -> list[tuple[int, int]]:
    """Start and stop of every unbroken run of True."""
    edges = np.flatnonzero(np.diff(np.array([False, *flags, False]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
