"""The curves of an episode: robot state, action, reward, vote margins and track scores."""

from collections.abc import Sequence

import numpy as np
import rerun as rr

from vap_core.recording.colours import SERIES, TARGET, Rgb8, series_colour, series_style
from vap_core.recording.entities.paths import target_suffix
from vap_core.recording.stream import frame_times, log_row
from vap_core.rollout.failure import EpisodeTrace
from vap_core.rollout.types import EpisodeHeader, Frame

STATE_NAMES = ("x", "y", "z", "rx", "ry", "rz", "gripper")
"""The first numbers of a robot state; joint angles follow."""
MARGIN_WIDTH, SCORE_WIDTH, GRIPPER_WIDTH = 2.5, 2.0, 2.0


def log_robot_styles(rec: rr.RecordingStream, header: EpisodeHeader, frame: Frame) -> None:
    """Names and colours of the action's and the state's curves."""
    n = len(frame.state)
    joints = [f"joint{i}" for i in range(1, n)]
    log_row(rec, "/action", series_style(header.action_names))
    log_row(rec, "/observation.state", series_style([*STATE_NAMES, *joints][:n]))


def log_method_styles(rec: rr.RecordingStream, header: EpisodeHeader) -> None:
    """Names and colours of the margins' and scores' curves, one for each target and view."""
    for curve, width in (("vote_margin", MARGIN_WIDTH), ("track_score", SCORE_WIDTH)):
        for i, (camera, groundings) in enumerate(header.groundings.items()):
            for j in range(len(groundings)):
                name = f"{camera}{target_suffix(j)}"
                style = rr.SeriesLines(names=name, colors=series_colour(i), widths=width)
                log_row(rec, f"/vap/{curve}/{name}", style)


def send_curve(
    rec: rr.RecordingStream, entity: str, index: Sequence[rr.TimeColumn], values: np.ndarray
) -> None:
    """One number, or one row of numbers, per step."""
    rec.send_columns(entity, index, rr.Scalars.columns(scalars=values))


def send_robot(
    rec: rr.RecordingStream, index: Sequence[rr.TimeColumn], frames: Sequence[Frame]
) -> None:
    """The state of every frame and the action of those that have one."""
    send_curve(rec, "/observation.state", index, np.stack([frame.state for frame in frames]))
    acting = []
    actions = []
    for frame in frames:
        if frame.action is not None:
            acting.append(frame)
            actions.append(frame.action)
    if acting:
        send_curve(rec, "/action", frame_times(acting), np.stack(actions))


def send_method(
    rec: rr.RecordingStream,
    header: EpisodeHeader,
    index: Sequence[rr.TimeColumn],
    frames: Sequence[Frame],
) -> None:
    """The vote margin of every target and view at all steps, its track score where tracked."""
    for camera, groundings in header.groundings.items():
        for j, grounding in enumerate(groundings):
            name = f"{camera}{target_suffix(j)}"
            margins = np.full(len(frames), grounding.ballot.margin)
            send_curve(rec, f"/vap/vote_margin/{name}", index, margins)
            _send_track_scores(rec, camera, j, frames)


def send_reward(
    rec: rr.RecordingStream, index: Sequence[rr.TimeColumn], steps: int, success: bool
) -> None:
    """Reward and success: 0, but for the last step of a success."""
    rewards = np.zeros(steps)
    rewards[-1] = float(success)
    send_curve(rec, "/next.reward", index, rewards)
    send_curve(rec, "/next.success", index, rewards)


def send_gripper(
    rec: rr.RecordingStream, trace: EpisodeTrace, index: Sequence[rr.TimeColumn]
) -> None:
    """The gripper's distance from the target's box and the target's lift, centimetres."""
    lift_m = trace.lift_m[trace.target]
    _send_gripper_curve(rec, "gripper to target", SERIES[0], trace.gap_m, index)
    _send_gripper_curve(rec, "target lifted", TARGET, lift_m, index)


def _send_track_scores(
    rec: rr.RecordingStream, camera: str, j: int, frames: Sequence[Frame]
) -> None:
    tracked = []
    scores = []
    for frame in frames:
        tracks = frame.tracks.get(camera, ())
        if j < len(tracks):
            tracked.append(frame)
            scores.append(tracks[j].score)
    if tracked:
        entity = f"/vap/track_score/{camera}{target_suffix(j)}"
        send_curve(rec, entity, frame_times(tracked), np.array(scores))


def _send_gripper_curve(
    rec: rr.RecordingStream,
    name: str,
    colour: Rgb8,
    values_m: np.ndarray,
    index: Sequence[rr.TimeColumn],
) -> None:
    entity = f"/vap/hand/{name.replace(' ', '_')}"
    style = rr.SeriesLines(names=[f"{name}, cm"], colors=[colour], widths=[GRIPPER_WIDTH])
    log_row(rec, entity, style)
    send_curve(rec, entity, index, 100 * values_m)
