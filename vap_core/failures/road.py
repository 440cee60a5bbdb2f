"""How far an episode came, stage by stage: what a funnel counts."""

from typing import Any

import numpy as np

from vap_core.failures.course import Course, carried, first, follow, told
from vap_core.failures.labels import LIMITS, Limits
from vap_core.failures.prompts import verdicts
from vap_core.values import Episode

STAGES = ("proposed", "voted", "masked", "tracked", "touched", "lifted", "success")
"""The road of one episode. The first four are of prompts, and None for a method that highlights nothing."""

TRACKED = 0.9
"""Share of judged steps in which the prompts are right, from which on the track counts as held."""


def stages(episode: Episode, limits: Limits = LIMITS, course: Course | None = None) -> dict[str, Any]:
    """How far an episode came, as `stage_<name>` for STAGES, and `mask_iou` (t = 0, mean over the views that count), `track_right` (share of steps).

    At t = 0 in every view that counts: a box fits, the vote is right, the mask is on target; tracked: right in 9 of 10 steps up to the touch;
    then, by the hand: the target touched; carried or selected; success. `course` spares following it again.
    """
    way: dict[str, Any] = {f"stage_{name}": None for name in STAGES} | {"mask_iou": None, "track_right": None}
    if episode.outcome.status == "error" or not told(episode):
        return way
    course = course or follow(episode)
    opening = [view for view in course.shown[0] if view.pixels >= limits.pixels]
    if course.prompted and opening:
        touched = first(course.touches)
        told_right = [verdict == "right" for _, verdict in verdicts(course, limits, len(course.steps) if touched is None else touched)]
        right = float(np.mean(told_right)) if told_right else 0.0
        way |= {
            "stage_proposed": all(view.proposal >= limits.proposal for view in opening),
            "stage_voted": all(view.object == course.target for view in opening),
            "stage_masked": all(view.iou >= limits.iou for view in opening),
            "stage_tracked": right >= TRACKED,
            "mask_iou": float(np.mean([view.iou for view in opening])),
            "track_right": right,
        }
    lifted = episode.outcome.success_once if course.rule == "selected" else True in carried(course, limits, course.target)
    return {**way, "stage_touched": any(course.touches), "stage_lifted": lifted, "stage_success": episode.outcome.success}
