"""Why an episode failed: one case with its sub-case, deciding frame, camera and evidence, from the simulator's truth (P 5.5; SPEC section 7).

The prompts are judged up to the first touch of the target or of another object that is not the goal: they have then brought the hand where it is, and
what a track loses when its object topples is the hand's doing. They are wrong when they are wrong for half of that time; or when, any time later,
the hand touches another object while a prompt points at it.

Case 1, all views are prompted alike, and wrong: *no proposal*, *shifted proposal*, *distractor vote*, *poor mask* (all at t = 0), *drift* (later).
Case 2, views are prompted with different instances: *views disagree* (at t = 0), *views drift apart* (later).
Case 3, the prompts are right and the hand fails: *wrong object* (it takes another all the same, or touches it and never comes near the target),
*collision* (it knocks another on its way), *missed grasp*, *slip*, *misplacement* (let go in the wrong place), *timeout*.
Methods that highlight nothing have no prompt to be wrong: their failures are *unprompted*, with the sub-cases of Case 3.
A real robot's episode has no truth: it stays *unlabelled*, with the signals that the method itself gives (`unlabelled`).

Every threshold is a field of `Limits`. The confidence of a diagnosis is the share of neighbouring limits (NEIGHBOURS) under which it stays the same.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from vap_core.failures.course import Course as Course
from vap_core.failures.course import follow as follow
from vap_core.failures.course import told as told
from vap_core.failures.hand import failed_hand
from vap_core.failures.labels import CASES as CASES
from vap_core.failures.labels import LIMITS as LIMITS
from vap_core.failures.labels import NEIGHBOURS as NEIGHBOURS
from vap_core.failures.labels import NONE as NONE
from vap_core.failures.labels import Case as Case
from vap_core.failures.labels import Diagnosis as Diagnosis
from vap_core.failures.labels import Limits as Limits
from vap_core.failures.labels import neighbours as neighbours
from vap_core.failures.prompts import wrong_prompt
from vap_core.failures.road import STAGES as STAGES
from vap_core.failures.road import stages as stages
from vap_core.failures.signals import unlabelled
from vap_core.values import Episode


def diagnose(episode: Episode, limits: Limits = LIMITS, course: Course | None = None) -> Diagnosis | None:
    """The one case of a failed episode; None for a success, and for an error, whose traceback says why. `course` spares following it again."""
    if episode.outcome.status != "failure" or not episode.frames:
        return None
    if not told(episode):
        return unlabelled(episode)
    course = course or follow(episode)
    found = _classify(course, limits)
    same = [(other.case, other.sub_case) == (found.case, found.sub_case) for other in (_classify(course, near) for near in neighbours(limits))]
    return replace(found, confidence=float(np.mean(same)))


def columns(episode: Episode) -> dict[str, Any]:
    """What a results table keeps of an episode beside its outcome: its diagnosis, and how far it came (`stages`)."""
    course = follow(episode) if told(episode) and episode.outcome.status != "error" else None
    found = diagnose(episode, course=course)
    return {**(NONE if found is None else found.columns()), **stages(episode, course=course)}


def _classify(course: Course, limits: Limits) -> Diagnosis:
    return (wrong_prompt(course, limits) if course.prompted else None) or failed_hand(course, limits)
