"""What a rollout yields: episodes, their frames, and what the prompts covered."""

from collections.abc import Mapping
from dataclasses import field, replace
from typing import Any

import numpy as np
from jaxtyping import Float32

from vap_core.base.types import Association, Camera, Event, Grounding, Rgb, Track, Views, value
from vap_core.simulation.types import EE_ACTION, Action, EpisodeRow, Outcome, Truth


@value
class EpisodeHeader:
    """What is known before the first action: written once at the head of a recording."""

    row: EpisodeRow
    method: str
    policy: str
    hz: float
    cameras: tuple[Camera, ...]
    instruction: str
    rewritten: str
    groundings: Mapping[str, tuple[Grounding, ...]]
    object_sizes_m: Mapping[str, tuple[float, float, float]]
    """Full extents of every object's bounding box, by model name."""
    action_names: tuple[str, ...] = EE_ACTION
    associations: tuple[Association | None, ...] = ()
    """Those of `Attended`."""
    references: Mapping[str, tuple[Rgb, ...]] = field(default_factory=dict)
    """The remembered crops of every object that the instruction may refer to, by name."""


@value
class MaskCoverage:
    """What the prompt covered in one view at one control step, by ground truth.

    Only the diagnosis reads it. `object` is the object that the mask lies on: its name, "" for none
    in particular, None where nothing is highlighted. `iou` compares the mask with the target's
    visible pixels, of which there are `pixels`. `proposal`, at t = 0, is the best box IoU of any
    candidate with the target; nan later.
    """

    camera: str
    object: str | None
    iou: float
    pixels: int
    proposal: float


@value
class Frame:
    """One control step: what was seen, what the policy was shown, what it did.

    `action` was decided from `images`; the terminal frame has none (None), because nothing is
    executed after it. `coverage` has an entry per view at steps whose images were prompted.
    `attention`, at steps in which the policy was observed while it planned, has by camera and query
    the share of attention on every image patch (policies.hooks.AttentionMap). `subgoal` is the
    number of the present sub-goal, from 1, and 0 on the way home between two; None in an episode
    that has one goal.
    """

    frame_index: int
    timestamp_s: float
    images: Views
    prompted: Views
    tracks: Mapping[str, tuple[Track, ...]]
    cameras: tuple[Camera, ...]
    state: Float32[np.ndarray, " s"]
    action: Action | None
    truth: Truth
    events: tuple[Event, ...]
    coverage: tuple[MaskCoverage, ...] = ()
    attention: Mapping[str, Mapping[str, Float32[np.ndarray, "_ _ _ _"]]] = field(
        default_factory=dict
    )
    subgoal: int | None = None

    def without_images(self) -> "Frame":
        """The same step without pictures, masks and attention, to keep in memory."""
        truth = replace(self.truth, masks={}, hand={})
        tracks = {
            camera: tuple(replace(track, mask=None) for track in of_view)
            for camera, of_view in self.tracks.items()
        }
        return replace(self, images={}, prompted={}, tracks=tracks, truth=truth, attention={})


@value
class ConsumedInput:
    """One thing that the policy consumed in one call of one episode: a camera's image, or the text.

    `changed` says whether the prompt changes it: pixels tinted in that view, or words rewritten.
    `consumed` and `raw` are digests of what the policy consumed of the prompted and of the raw
    input.
    """

    step: int
    name: str
    changed: bool
    pixels: int
    consumed: str
    raw: str

    @property
    def sound(self) -> bool:
        """What the prompt changes is consumed differently, and nothing else is."""
        return (self.consumed != self.raw) == self.changed


@value
class SubGoalSpan:
    """One sub-goal of an episode that has several, from its first step on.

    `header` is as if it were an episode of its own: its command, target and groundings.
    """

    header: EpisodeHeader
    first: int


@value
class Episode:
    """A finished episode.

    `seconds` sums wall time by part: physics, render, attend, policy, record, ... `consumed` is
    empty unless the rollout was audited. `subgoals` are those that began, where there were several.
    """

    header: EpisodeHeader
    frames: tuple[Frame, ...]
    outcome: Outcome
    seconds: Mapping[str, float]
    consumed: tuple[ConsumedInput, ...] = ()
    subgoals: tuple[SubGoalSpan, ...] = ()

    def part(self, stage: int) -> "Episode":
        """One sub-goal as an episode of its own, from its first step to its last."""
        span = self.subgoals[stage]
        outcome = self.outcome.subgoals[stage]
        stop = span.first + outcome.steps
        frames = [frame for frame in self.frames if span.first <= frame.frame_index <= stop]
        if frames:
            frames[-1] = replace(frames[-1], action=None)
        return Episode(span.header, tuple(frames), outcome, {})

    @property
    def key(self) -> tuple[str, str, str, int, int]:
        """Suite, task, method, seed and episode: its name within a run."""
        row = self.header.row
        return row.suite, row.task, self.header.method, row.seed, row.episode

    def summary(self) -> dict[str, Any]:
        """One flat row of a results table."""
        row = self.header.row
        outcome = self.outcome
        timings = {f"seconds_{part}": seconds for part, seconds in self.seconds.items()}
        return {
            "suite": row.suite,
            "task": row.task,
            "split": row.split,
            "variant": row.variant,
            "episode": row.episode,
            "seed": row.seed,
            "method": self.header.method,
            "policy": self.header.policy,
            "outcome": outcome.status,
            "success": outcome.success,
            "success_once": outcome.success_once,
            "held_steps": outcome.held_steps,
            "cmr": outcome.cmr,
            "wrong_object": outcome.wrong_object,
            "first_object_correct": outcome.first_object_correct,
            "touched": outcome.touched,
            "steps": outcome.steps,
            "margin": self._least_margin(),
            "detail": outcome.detail,
            **self._subgoal_columns(),
            **timings,
        }

    def _least_margin(self) -> float | None:
        """The least margin of all votes that had a candidate.

        0 where no view had one, None where no vote was held.
        """
        ballots = []
        for per_view in self.header.groundings.values():
            ballots += [grounding.ballot for grounding in per_view]
        if not ballots:
            return None
        held = [ballot.margin for ballot in ballots if ballot.winner is not None]
        return min(held, default=0.0)

    def _subgoal_columns(self) -> dict[str, Any]:
        """`subgoals_done` counts those that succeeded, `subgoal_1` says whether the first did."""
        if not self.header.row.subgoals:
            return {}
        columns: dict[str, Any] = {}
        done = 0
        for i in range(self.header.row.stages):
            ended = self.outcome.subgoals[i : i + 1]
            columns[f"subgoal_{i + 1}"] = bool(ended) and ended[0].success
            done += columns[f"subgoal_{i + 1}"]
        return {"subgoals_done": done, **columns}
