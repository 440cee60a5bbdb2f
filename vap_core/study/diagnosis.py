"""Why an episode failed, from ground truth (P 5.5; SPEC section 7), and how far it came."""

from dataclasses import replace
from typing import Any

import numpy as np

from vap_core.rollout.types import NO_DIAGNOSIS, Diagnosis, Episode, EpisodeTrace, Explanation
from vap_core.study.cases import (
    THRESHOLDS,
    Thresholds,
    carried,
    failed_manipulation,
    first_true,
    has_truth,
    neighbours,
    trace_episode,
    unlabelled,
    verdicts,
    wrong_prompt,
)

STAGES = ("proposed", "voted", "masked", "tracked", "touched", "lifted", "success")
"""The stages of one episode in order.

The first four are of prompts, and None for a method that highlights nothing.
"""

TRACKED = 0.9
"""Share of judged steps in which the prompts are right, from which on the track counts as held."""


def stages(
    episode: Episode, thresholds: Thresholds = THRESHOLDS, trace: EpisodeTrace | None = None
) -> dict[str, Any]:
    """`stage_<name>` for STAGES, and two measures of the prompts.

    `mask_iou` is the mean at t = 0 over the views that count, `track_right` the share of steps.
    At t = 0, in every view that counts: a box fits, the vote is right, the mask is on the target.
    Tracked: right in 9 of 10 steps up to the touch. Then: the target touched; carried, or selected;
    success. `trace` is the episode's, where it is known already.
    """
    columns: dict[str, Any] = {}
    for name in STAGES:
        columns[f"stage_{name}"] = None
    columns["mask_iou"] = None
    columns["track_right"] = None
    if episode.outcome.status == "error" or not has_truth(episode):
        return columns
    trace = trace or trace_episode(episode)
    if trace.prompted:
        columns |= _prompt_stages(trace, thresholds)
    lifted = episode.outcome.success_once
    if trace.rule != "selected":
        lifted = True in carried(trace, thresholds, trace.target)
    columns["stage_touched"] = any(trace.touches)
    columns["stage_lifted"] = lifted
    columns["stage_success"] = episode.outcome.success
    return columns


def _prompt_stages(trace: EpisodeTrace, thresholds: Thresholds) -> dict[str, Any]:
    proposed = []
    voted = []
    masked = []
    ious = []
    for view in trace.coverage[0]:
        if view.pixels >= thresholds.pixels:
            proposed.append(view.proposal >= thresholds.proposal)
            voted.append(view.object == trace.target)
            masked.append(view.iou >= thresholds.iou)
            ious.append(view.iou)
    if not ious:
        return {}
    touched = first_true(trace.touches)
    until = len(trace.steps) if touched is None else touched
    right = 0.0
    judged = verdicts(trace, thresholds, until)
    if judged:
        right = float(np.mean([verdict == "right" for _, verdict in judged]))
    return {
        "stage_proposed": all(proposed),
        "stage_voted": all(voted),
        "stage_masked": all(masked),
        "stage_tracked": right >= TRACKED,
        "mask_iou": float(np.mean(ious)),
        "track_right": right,
    }


def diagnose(
    episode: Episode, thresholds: Thresholds = THRESHOLDS, trace: EpisodeTrace | None = None
) -> Diagnosis | None:
    """The one case of a failed episode; None for a success or an error.

    A traceback explains an error. `trace` is the episode's, where it is known already.
    """
    if episode.outcome.status != "failure" or not episode.frames:
        return None
    if episode.subgoals:
        return diagnose(_deciding_part(episode), thresholds)
    if not has_truth(episode):
        return unlabelled(episode)
    trace = trace or trace_episode(episode)
    found = _classify(trace, thresholds)
    same = []
    for near in neighbours(thresholds):
        other = _classify(trace, near)
        same.append((other.case, other.sub_case) == (found.case, found.sub_case))
    return replace(found, confidence=float(np.mean(same)))


def explain(episode: Episode) -> Explanation:
    """The trace and the diagnosis of an episode, for its recording."""
    whole = trace_episode(episode) if has_truth(episode) else None
    if episode.subgoals:
        return Explanation(whole, diagnose(episode))
    return Explanation(whole, diagnose(episode, trace=whole))


def columns(episode: Episode) -> dict[str, Any]:
    """The diagnosis and the stages (`stages`) of an episode, as columns of a results table.

    Of several sub-goals they are of the first that failed, or of the last; `subgoal` is its number.
    An error has no diagnosis, no stages and no such sub-goal, whatever its sub-goals did.
    """
    if episode.subgoals and episode.outcome.status != "error":
        stage = deciding_subgoal(episode)
        return {**columns(episode.part(stage)), "subgoal": stage + 1}
    trace = None
    if has_truth(episode) and episode.outcome.status != "error":
        trace = trace_episode(episode)
    found = diagnose(episode, trace=trace)
    diagnosis = NO_DIAGNOSIS if found is None else found.columns()
    return {**diagnosis, **stages(episode, trace=trace)}


def deciding_subgoal(episode: Episode) -> int:
    """The first sub-goal that failed, from 0; the last one where none did."""
    began = min(len(episode.subgoals), len(episode.outcome.subgoals))
    for stage, outcome in enumerate(episode.outcome.subgoals[:began]):
        if not outcome.success:
            return stage
    return began - 1


def _deciding_part(episode: Episode) -> Episode:
    return episode.part(deciding_subgoal(episode))


def _classify(trace: EpisodeTrace, thresholds: Thresholds) -> Diagnosis:
    if trace.prompted:
        found = wrong_prompt(trace, thresholds)
        if found is not None:
            return found
    return failed_manipulation(trace, thresholds)
