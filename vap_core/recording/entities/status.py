"""The state lanes and the event list: how the episode ended, what the gripper held, events."""

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr

from vap_core.base.types import Event
from vap_core.recording.colours import (
    CAMERAS,
    ELECTED,
    LOOKALIKES,
    TARGET,
    pack_rgba,
    state_style,
)
from vap_core.recording.stream import Moment, frame_times, log_row, time_columns
from vap_core.rollout.types import Frame
from vap_core.simulation.types import EpisodeRow

OUTCOME_COLOURS = {"success": CAMERAS[2], "failure": CAMERAS[2], "error": CAMERAS[2]}
GRASP_COLOURS = {
    "free": (70, 78, 92),
    "touches target": TARGET,
    "holds target": TARGET,
    "touches other": LOOKALIKES[0],
    "holds other": LOOKALIKES[0],
}
SUBGOAL_COLOURS = (CAMERAS[1], CAMERAS[2])
"""Of sub-goals in turn: greys, which only frame what happens."""
HOMEWARD = "way home"
HOMEWARD_COLOUR = (60, 60, 60)
LEVEL_COLOURS = {"INFO": CAMERAS[1], "WARN": CAMERAS[0], "ERROR": ELECTED}
LINE_CHARACTERS = 60
"""Longer events are broken into rows, so that the list never cuts them."""


def log_status_styles(rec: rr.RecordingStream) -> None:
    """The colours of both lanes."""
    log_row(rec, "/vap/status/outcome", state_style(OUTCOME_COLOURS))
    log_row(rec, "/vap/status/grasp", state_style(GRASP_COLOURS))


def send_outcome(rec: rr.RecordingStream, first: Frame, status: str) -> None:
    """The outcome over the whole lane: a state that starts at the last step has no width."""
    columns = rr.StateChange.columns(state=[status])
    rec.send_columns("/vap/status/outcome", frame_times([first]), columns)


def grasp_state(frame: Frame, target: str) -> str:
    """What the gripper has to do with the objects at one step."""
    for verb, names in (("holds", frame.truth.held), ("touches", frame.truth.touched)):
        if names:
            return f"{verb} target" if target in names else f"{verb} other"
    return "free"


def send_grasp_changes(
    rec: rr.RecordingStream, frames: Sequence[Frame], target: str, before: str | None
) -> str | None:
    """Send only changes: a state lasts until the next. Returns the last state."""
    changed = []
    states = []
    for frame in frames:
        state = grasp_state(frame, target)
        if state != before:
            changed.append(frame)
            states.append(state)
            before = state
    if changed:
        columns = rr.StateChange.columns(state=states)
        rec.send_columns("/vap/status/grasp", frame_times(changed), columns)
    return before


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
