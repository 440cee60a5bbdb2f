"""The curves of an episode: robot state, action, reward, vote margins and track scores."""

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr

from vap_core.base.pictures import Rgb8
from vap_core.base.types import Event
from vap_core.recording.colours import (
    CAMERAS,
    ELECTED,
    LOOKALIKES,
    MUTED,
    TARGET,
    camera_colour,
    pack_rgba,
    series_style,
    state_style,
    target_suffix,
)
from vap_core.recording.entities.scene import nearest_other_m
from vap_core.recording.stream import Moment, frame_times, log_row, time_columns
from vap_core.rollout.types import Diagnosis, EpisodeHeader, EpisodeTrace, Frame
from vap_core.simulation.types import EpisodeRow

STATE_NAMES = ("x", "y", "z", "rx", "ry", "rz", "gripper")
"""The first numbers of a robot state; joint angles follow."""
MARGIN_WIDTH, SCORE_WIDTH, GRIPPER_WIDTH, LIFT_WIDTH, BAR_WIDTH = 2.5, 2.0, 2.5, 1.0, 6.0
CLOSED = 0.5
"""A smaller command closes the gripper."""
type Curve = tuple[str, str, Rgb8, float, np.ndarray]
"""Entity, words of the legend, colour, width, and the numbers of a line."""
BAR_SHARE = 0.05
"""How far the bars of the grasp are below zero, as a share of the largest distance."""


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
                style = rr.SeriesLines(names=name, colors=camera_colour(i), widths=width)
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
    """The vote margin of every target and view at all steps, its track score where tracked.

    A view without candidates has had no vote, and no margin.
    """
    for camera, groundings in header.groundings.items():
        for j, grounding in enumerate(groundings):
            if grounding.ballot.winner is not None:
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
    rec: rr.RecordingStream,
    header: EpisodeHeader,
    trace: EpisodeTrace,
    frames: Sequence[Frame],
    diagnosis: Diagnosis | None,
) -> tuple[float, float]:
    """The gripper's distance from the target and from the nearest other object, centimetres.

    Also the target's lift, bars below zero while the hand is closed and while it has an object, and
    a cross at the deciding frame. A target that is left out of the scene has no curve. Returns the
    chart's axis, from below the bars to above all curves.
    """
    index = frame_times(frames)
    curves: list[Curve] = []
    if not header.row.start.absent:
        lift_cm = 100 * trace.lift_m[trace.target]
        to_target_cm = 100 * trace.gap_m
        curves.append(("gripper_to_target", "to yours", TARGET, GRIPPER_WIDTH, to_target_cm))
        words = "yours lifted (thin line)"
        curves.append(("target_lifted", words, TARGET, LIFT_WIDTH, lift_cm))
    other_m = nearest_other_m(header, frames)
    if other_m is not None:
        words = "to the nearest other"
        curves.append(("nearest_other", words, LOOKALIKES[0], GRIPPER_WIDTH, 100 * other_m))
    highest = max([1.0, *(float(values.max()) for *_, values in curves)])
    curves += _grasp_bars(trace, frames, -BAR_SHARE * highest)
    for name, words, colour, width, values in curves:
        entity = f"/vap/hand/{name}"
        log_row(rec, entity, rr.SeriesLines(names=[words], colors=[colour], widths=[width]))
        send_curve(rec, entity, index, values)
    if diagnosis is not None and curves:
        *_, distances_cm = curves[0]
        _send_deciding_frame(rec, trace, frames, diagnosis, distances_cm)
    return -0.2 * highest, 1.05 * highest


def _grasp_bars(trace: EpisodeTrace, frames: Sequence[Frame], level: float) -> list[Curve]:
    """Where the hand is closed, and what it touches or holds then; nan elsewhere."""
    states = [grasp_state(frame, trace.target) for frame in frames]
    conditions = (
        ("hand_closed", MUTED, 2.6, trace.grip < CLOSED),
        ("touches_the_target", TARGET, 1.3, np.array([s.endswith("target") for s in states])),
        ("touches_another", LOOKALIKES[0], 1.3, np.array([s.endswith("other") for s in states])),
    )
    bars = []
    for name, colour, depth, flags in conditions:
        if flags.any():
            values = np.where(flags, depth * level, np.nan)
            words = f"bar: {name.replace('_', ' ').replace('the target', 'yours')}"
            bars.append((name, words, colour, BAR_WIDTH, values))
    return bars


def _send_deciding_frame(
    rec: rr.RecordingStream,
    trace: EpisodeTrace,
    frames: Sequence[Frame],
    diagnosis: Diagnosis,
    distances_cm: np.ndarray,
) -> None:
    """A cross on a curve, one number per frame."""
    if diagnosis.frame_index not in trace.steps:
        return
    at = trace.steps.index(diagnosis.frame_index)
    entity = "/vap/hand/deciding_frame"
    style = rr.SeriesPoints(
        names=["the deciding step"], colors=[ELECTED], markers=["cross"], marker_sizes=[7.0]
    )
    log_row(rec, entity, style)
    send_curve(rec, entity, frame_times([frames[at]]), distances_cm[at : at + 1])


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


SUBGOAL_COLOURS = (CAMERAS[1], CAMERAS[2])
"""Of sub-goals in turn: greys, which only frame what happens."""
HOMEWARD = "way home"
HOMEWARD_COLOUR = (60, 60, 60)
LEVEL_COLOURS = {"INFO": CAMERAS[1], "WARN": CAMERAS[0], "ERROR": ELECTED}
LINE_CHARACTERS = 60
"""Longer events are broken into rows, so that the list never cuts them."""


def grasp_state(frame: Frame, target: str) -> str:
    """What the gripper has to do with the objects at one step."""
    for verb, names in (("holds", frame.truth.held), ("touches", frame.truth.touched)):
        if names:
            return f"{verb} target" if target in names else f"{verb} other"
    return "free"


def send_subgoals(
    rec: rr.RecordingStream, frames: Sequence[Frame], row: EpisodeRow, before: int | None
) -> int | None:
    """The lane of sub-goals, each by its command: only changes. Returns the last number.

    An episode with one goal has no such lane.
    """
    if not row.subgoals:
        return before
    if before is None:
        colours = {HOMEWARD: HOMEWARD_COLOUR}
        for number in range(1, row.stages + 1):
            colour = SUBGOAL_COLOURS[number % len(SUBGOAL_COLOURS)]
            colours[subgoal_state(row, number)] = colour
        log_row(rec, "/vap/status/subgoal", state_style(colours))
    changed = []
    states = []
    for frame in frames:
        if frame.subgoal is not None and frame.subgoal != before:
            changed.append(frame)
            states.append(subgoal_state(row, frame.subgoal))
            before = frame.subgoal
    if changed:
        columns = rr.StateChange.columns(state=states)
        rec.send_columns("/vap/status/subgoal", frame_times(changed), columns)
    return before


def subgoal_state(row: EpisodeRow, number: int) -> str:
    """ "2: put my camera in the basket", or the way home."""
    if number == 0:
        return HOMEWARD
    return f"{number}: {row.subgoals[number - 1].instruction}"


def send_events(
    rec: rr.RecordingStream, events: Sequence[Event], seconds: Mapping[int, float]
) -> None:
    """The events, each at its step; `seconds` has every step's time."""
    if not events:
        return
    last_second = list(seconds.values())[-1]
    moments: list[Moment] = []
    colours = []
    lines = []
    levels = []
    for event in events:
        for line in textwrap.wrap(event.text, LINE_CHARACTERS):
            lines.append(line)
            levels.append(event.level)
            moments.append((event.frame_index, seconds.get(event.frame_index, last_second)))
            colours.append(pack_rgba(LEVEL_COLOURS[event.level]))
    columns = rr.TextLog.columns(
        text=lines,
        level=levels,
        color=np.array(colours, np.uint32),
    )
    rec.send_columns("/vap/events", time_columns(moments), columns)
