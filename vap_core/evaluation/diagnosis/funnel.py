"""How far an episode came, stage by stage."""

from typing import Any

import numpy as np

from vap_core.evaluation.diagnosis.episode_trace import (
    carried,
    first_true,
    has_truth,
    trace_episode,
)
from vap_core.evaluation.diagnosis.prompts import verdicts
from vap_core.evaluation.diagnosis.thresholds import THRESHOLDS, Thresholds
from vap_core.rollout.failure import EpisodeTrace
from vap_core.rollout.types import Episode

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
