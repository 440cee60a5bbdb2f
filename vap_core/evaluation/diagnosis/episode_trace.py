"""From the frames of an episode to the trace that the diagnosis reads."""

from collections.abc import Iterable, Sequence

import numpy as np

from vap_core.evaluation.diagnosis.thresholds import Thresholds
from vap_core.rollout.failure import EpisodeTrace
from vap_core.rollout.types import Episode, Frame
from vap_core.simulation import robots
from vap_core.simulation.control import pose_transform
from vap_core.simulation.suites import suite
from vap_core.simulation.suites.rules import Judge
from vap_core.simulation.types import Pose


def has_truth(episode: Episode) -> bool:
    """Whether the frames hold ground truth."""
    return bool(episode.frames) and bool(episode.frames[0].truth.objects_world)


def trace_episode(episode: Episode) -> EpisodeTrace:
    """The trace of an episode that has ground truth."""
    header = episode.header
    frames = episode.frames
    row = header.row
    judge = Judge.start(row, header.object_sizes_m, frames[0].truth)
    names = _without(judge.start_world, row.goal)
    base = robots.get(suite(row.suite).robot).base_world
    size = header.object_sizes_m[row.target]

    steps = []
    coverage = []
    others = []
    touches = []
    held = []
    gap_m = []
    grip = []
    lift_m, moved_m = np.zeros((2, len(names), len(frames)))
    for step, frame in enumerate(frames):
        truth = frame.truth
        steps.append(frame.frame_index)
        coverage.append(frame.coverage)
        touched = _without(truth.touched, row.goal)
        others.append(tuple(_without(touched, row.target)))
        touches.append(row.target in touched)
        held.append(truth.held)
        gap_m.append(_gap_m(frame, truth.objects_world[row.target], size, base))
        grip.append(np.nan if frame.action is None else float(frame.action[-1]))
        for i, name in enumerate(names):
            lift_m[i, step] = truth.objects_world[name][2] - judge.start_world[name][2]
            moved_m[i, step] = judge.strayed_m(name, truth)

    candidates = {}
    rejected = []
    overruled = []
    for camera, per_target in header.groundings.items():
        candidates[camera] = len(per_target[0].candidates) if per_target else 0
        if per_target and per_target[0].rejected is not None:
            rejected.append(camera)
        if per_target and per_target[0].overruled:
            overruled.append(camera)
    return EpisodeTrace(
        target=row.target,
        rule=row.rule,
        steps=tuple(steps),
        coverage=tuple(coverage),
        others=tuple(others),
        touches=tuple(touches),
        held=tuple(held),
        gap_m=np.array(gap_m),
        lift_m=dict(zip(names, lift_m, strict=True)),
        moved_m=dict(zip(names, moved_m, strict=True)),
        grip=np.array(grip),
        candidates=candidates,
        prompted=any(coverage),
        rejected=frozenset(rejected),
        overruled=frozenset(overruled),
    )


def first_true(flags: Sequence[object]) -> int | None:
    """The index of the first true flag, or of the first sequence that is not empty."""
    for i, flag in enumerate(flags):
        if flag:
            return i
    return None


def true_runs(flags: Sequence[bool]) -> list[tuple[int, int]]:
    """Start and stop of every unbroken run of True."""
    padded = np.array([False, *flags, False]).astype(int)
    edges = np.flatnonzero(np.diff(padded)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def carried(trace: EpisodeTrace, thresholds: Thresholds, name: str) -> list[bool]:
    """For every step, whether the robot carries an object."""
    flags = []
    for held, lift in zip(trace.held, trace.lift_m[name].tolist(), strict=True):
        flags.append(name in held and lift >= thresholds.lift_m)
    return flags


def _gap_m(frame: Frame, pose: Pose, size: tuple[float, float, float], base: Pose) -> float:
    """From the tcp to an object's bounding box, metres; 0 inside.

    The object's origin is the centre of its base.
    """
    tcp = pose_transform(base).apply(frame.state[:3].astype(np.float64))
    local = pose_transform(pose).inverse().apply(tcp) - [0.0, 0.0, size[2] / 2]
    outside = np.maximum(np.abs(local) - np.asarray(size) / 2, 0.0)
    return float(np.linalg.norm(outside))


def _without(names: Iterable[str], excluded: str) -> list[str]:
    return [name for name in names if name != excluded]
