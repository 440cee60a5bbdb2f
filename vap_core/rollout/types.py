"""What a rollout yields: episodes, their frames, failures, and what the prompts covered."""

import json
from collections.abc import Callable, Mapping
from dataclasses import field, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Float64

from vap_core.base.types import (
    Association,
    Attended,
    Camera,
    Event,
    Grounding,
    Mask,
    Rgb,
    Track,
    Views,
    value,
)
from vap_core.perception.boxes import box_iou, mask_box, mask_iou
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


OF_ROW = ("suite", "task", "split", "variant", "episode", "seed")
OF_OUTCOME = (
    *("success", "success_once", "held_steps", "cmr"),
    *("wrong_object", "first_object_correct", "touched"),
)
"""Columns of a results table that are fields of an episode's row, and of its outcome."""


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
        """One flat row of a results table.

        `margin` is the least of all votes that had a candidate: 0 where no view had one, None where
        no vote was held. `subgoals_done` counts those that succeeded, `subgoal_1` says whether the
        first did.
        """
        row, outcome = self.header.row, self.outcome
        ballots = [
            grounding.ballot for of_view in self.header.groundings.values() for grounding in of_view
        ]
        held = [ballot.margin for ballot in ballots if ballot.winner is not None]
        columns: dict[str, Any] = {}
        if row.subgoals:
            ended = [part.success for part in outcome.subgoals]
            ended += [False] * (row.stages - len(ended))
            columns["subgoals_done"] = sum(ended)
            columns |= {f"subgoal_{i + 1}": done for i, done in enumerate(ended)}
        return {
            **{name: getattr(row, name) for name in OF_ROW},
            "method": self.header.method,
            "policy": self.header.policy,
            "outcome": outcome.status,
            **{name: getattr(outcome, name) for name in OF_OUTCOME},
            "steps": outcome.steps,
            "margin": min(held, default=0.0) if ballots else None,
            "detail": outcome.detail,
            **columns,
            **{f"seconds_{part}": seconds for part, seconds in self.seconds.items()},
        }


type Case = Literal["case 1", "case 2", "case 3", "unprompted", "unlabelled"]
MANIPULATION = ("wrong object", "collision", "missed grasp", "slip", "misplacement", "timeout")
CASES: dict[Case, tuple[str, ...]] = {
    "case 1": (
        "no proposal",
        "not in view",
        "shifted proposal",
        "distractor vote",
        "poor mask",
        "drift",
    ),
    "case 2": ("views disagree", "views drift apart"),
    "case 3": MANIPULATION,
    "unprompted": MANIPULATION,
    "unlabelled": ("nothing found", "not in view", "lost track", "narrow vote", "no signal"),
}
"""Every sub-case of every case, from perception to manipulation."""


@value
class Diagnosis:
    """Why one episode failed.

    It has the deciding frame and camera ("" where none decides), a sentence, and evidence in
    numbers and names.
    """

    case: Case
    sub_case: str
    frame_index: int
    camera: str
    evidence: Mapping[str, float | str]
    confidence: float
    sentence: str

    def columns(self) -> dict[str, Any]:
        """Its part of a row of a results table."""
        evidence = {
            name: round(part, 4) if isinstance(part, float) else part
            for name, part in self.evidence.items()
        }
        return {
            "case": self.case,
            "sub_case": self.sub_case,
            "deciding_frame": self.frame_index,
            "deciding_camera": self.camera,
            "case_confidence": self.confidence,
            "case_sentence": self.sentence,
            "case_evidence": json.dumps(evidence),
        }


NO_DIAGNOSIS: dict[str, Any] = {
    "case": "",
    "sub_case": "",
    "deciding_frame": -1,
    "deciding_camera": "",
    "case_confidence": float("nan"),
    "case_sentence": "",
    "case_evidence": "",
}
"""The columns of an episode that did not fail."""


@value
class EpisodeTrace:
    """What the diagnosis reads, one entry per recorded step.

    Nothing in it depends on a threshold. `others` are the objects other than target and goal that
    the robot touched in a step, `touches` says whether the target was one. `gap_m` is the distance
    of the tcp from the target's bounding box, `lift_m` how much higher each object is than at
    first, `moved_m` how far it has moved. `grip` is the gripper's command, 0 closed .. 1 open, nan
    at the terminal frame, which has none. `candidates` counts proposals by camera; `rejected` are
    the cameras in which the method says that the target is not in view, `overruled` those in which
    something else than the vote chose the candidate.
    """

    target: str
    rule: str
    steps: tuple[int, ...]
    coverage: tuple[tuple[MaskCoverage, ...], ...]
    others: tuple[tuple[str, ...], ...]
    touches: tuple[bool, ...]
    held: tuple[frozenset[str], ...]
    gap_m: Float64[np.ndarray, " t"]
    lift_m: Mapping[str, Float64[np.ndarray, " t"]]
    moved_m: Mapping[str, Float64[np.ndarray, " t"]]
    grip: Float64[np.ndarray, " t"]
    candidates: Mapping[str, int]
    prompted: bool
    rejected: frozenset[str] = frozenset()
    overruled: frozenset[str] = frozenset()


@value
class Explanation:
    """The trace of an episode, where there is ground truth, and its diagnosis, where it failed."""

    trace: EpisodeTrace | None
    diagnosis: Diagnosis | None


type Explain = Callable[[Episode], Explanation]


MAJORITY = 0.5
"""The share of a mask that must lie on an object for the mask to cover it."""


def mask_coverage(
    attended: Attended, truth: Truth, target: str, *, opening: bool
) -> tuple[MaskCoverage, ...]:
    """Every view's prompt for the first target of the instruction; `truth` has masks.

    `opening`: t = 0, when proposals count too, of a method that grounds.
    """
    found = []
    for camera, tracks in attended.tracks.items():
        if not tracks:
            continue
        mask = tracks[0].mask
        masks = truth.masks[camera]
        true = masks.get(target)
        pixels = 0 if true is None else int(true.sum())
        overlap = 0.0
        if mask is not None and true is not None and mask.any():
            overlap = mask_iou(mask, true)
        proposal = float("nan")
        groundings = attended.groundings.get(camera, ())
        if opening and groundings and true is not None and pixels:
            proposal = best_proposal(groundings[0], true)
        covered = covered_object(mask, masks)
        found.append(MaskCoverage(camera, covered, overlap, pixels, proposal))
    return tuple(found)


def covered_object(mask: Mask | None, masks: Mapping[str, Mask]) -> str | None:
    """The object on which most of a mask lies, "" when there is none such.

    None for no mask, or an empty one.
    """
    if mask is None or not mask.any():
        return None
    pixels = {name: int((mask & of_object).sum()) for name, of_object in masks.items()}
    best = max(pixels, key=lambda name: pixels[name], default="")
    return best if best and pixels[best] >= MAJORITY * int(mask.sum()) else ""


def best_proposal(grounding: Grounding, true: Mask) -> float:
    """The best box IoU of any candidate with the target's true mask."""
    box = mask_box(true)
    if box is None or not len(grounding.candidates):
        return 0.0
    return float(box_iou(grounding.candidates.xyxy, box[None]).max())
