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
    names = [f"stage_{name}" for name in STAGES]
    columns: dict[str, Any] = dict.fromkeys((*names, "mask_iou", "track_right"))
    if episode.outcome.status == "error" or not has_truth(episode):
        return columns
    trace = trace or trace_episode(episode)
    lifted = episode.outcome.success_once
    if trace.rule != "selected":
        lifted = True in carried(trace, thresholds, trace.target)
    return {
        **columns,
        **(_prompt_stages(trace, thresholds) if trace.prompted else {}),
        "stage_touched": any(trace.touches),
        "stage_lifted": lifted,
        "stage_success": episode.outcome.success,
    }


def _prompt_stages(trace: EpisodeTrace, thresholds: Thresholds) -> dict[str, Any]:
    views = [view for view in trace.coverage[0] if view.pixels >= thresholds.pixels]
    if not views:
        return {}
    touched = first_true(trace.touches)
    judged = verdicts(trace, thresholds, len(trace.steps) if touched is None else touched)
    right = float(np.mean([verdict == "right" for _, verdict in judged] or [False]))
    return {
        "stage_proposed": all(view.proposal >= thresholds.proposal for view in views),
        "stage_voted": all(view.object == trace.target for view in views),
        "stage_masked": all(view.iou >= thresholds.iou for view in views),
        "stage_tracked": right >= TRACKED,
        "mask_iou": float(np.mean([view.iou for view in views])),
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
        return diagnose(episode.part(deciding_subgoal(episode)), thresholds)
    if not has_truth(episode):
        return unlabelled(episode)
    trace = trace or trace_episode(episode)
    found = _classify(trace, thresholds)
    others = [_classify(trace, near) for near in neighbours(thresholds)]
    same = [(each.case, each.sub_case) == (found.case, found.sub_case) for each in others]
    return replace(found, confidence=float(np.mean(same)))


def explain(episode: Episode) -> Explanation:
    """The trace and the diagnosis of an episode, for its recording."""
    whole = trace_episode(episode) if has_truth(episode) else None
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
    began = episode.outcome.subgoals[: len(episode.subgoals)]
    failed = (stage for stage, outcome in enumerate(began) if not outcome.success)
    return next(failed, len(began) - 1)


def _classify(trace: EpisodeTrace, thresholds: Thresholds) -> Diagnosis:
    found = wrong_prompt(trace, thresholds) if trace.prompted else None
    return found or failed_manipulation(trace, thresholds)
