"""Why an episode failed, from ground truth (P 5.5; SPEC section 7).

The result is one case with its sub-case, deciding frame, camera and evidence.

The prompts are judged up to the first touch of the target, or of another object that is not the
goal: up to there they have guided the hand, and a track that is lost when its object topples is a
consequence of the manipulation. They are wrong when they are wrong in half of those steps, or when
the hand touches another object, any time later, while a prompt is on it.

Case 1, all views are prompted alike, and wrong: *no proposal*, *not in view* (the method says so),
*shifted proposal*, *distractor vote*, *poor mask* (all at t = 0), *drift* (later).
Case 2, views are prompted with different instances: *views disagree* (at t = 0), *views drift
apart* (later).
Case 3, the prompts are right and the manipulation fails: *wrong object* (it takes another, or
touches it and never comes near the target), *collision* (it knocks another on its way), *missed
grasp*, *slip*, *misplacement* (let go in the wrong place), *timeout*.
Methods that highlight nothing have no prompt to be wrong: their failures are *unprompted*, with the
sub-cases of Case 3. A real robot's episode has no ground truth: it stays *unlabelled*, with the
signals that the method itself gives.

Of an instruction in several steps the first sub-goal that failed is diagnosed, as an episode of its
own; the column `subgoal` is its number.

Every threshold is a field of `Thresholds`. The confidence of a diagnosis is the share of
neighbouring thresholds (NEIGHBOURS) under which it stays the same.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from vap_core.evaluation.diagnosis.episode_trace import has_truth as has_truth
from vap_core.evaluation.diagnosis.episode_trace import trace_episode as trace_episode
from vap_core.evaluation.diagnosis.funnel import STAGES as STAGES
from vap_core.evaluation.diagnosis.funnel import stages as stages
from vap_core.evaluation.diagnosis.manipulation import failed_manipulation
from vap_core.evaluation.diagnosis.prompts import wrong_prompt
from vap_core.evaluation.diagnosis.signals import unlabelled
from vap_core.evaluation.diagnosis.thresholds import NEIGHBOURS as NEIGHBOURS
from vap_core.evaluation.diagnosis.thresholds import THRESHOLDS as THRESHOLDS
from vap_core.evaluation.diagnosis.thresholds import Thresholds as Thresholds
from vap_core.evaluation.diagnosis.thresholds import neighbours as neighbours
from vap_core.rollout.failure import CASES as CASES
from vap_core.rollout.failure import NO_DIAGNOSIS as NO_DIAGNOSIS
from vap_core.rollout.failure import Case as Case
from vap_core.rollout.failure import Diagnosis as Diagnosis
from vap_core.rollout.failure import EpisodeTrace as EpisodeTrace
from vap_core.rollout.failure import Explanation as Explanation
from vap_core.rollout.types import Episode


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
