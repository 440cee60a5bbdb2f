"""Case 3, and what a method without a prompt can get wrong: what the hand did."""

from collections.abc import Mapping

import numpy as np

from vap_core.failures.course import Course, carried, first, runs
from vap_core.failures.labels import Case, Diagnosis, Limits
from vap_core.suites.rules import HELD_STEPS


def failed_hand(course: Course, limits: Limits) -> Diagnosis:
    """Case 3, or the same of a method that prompts nothing: what became of the target, else who came in its way, else how near the hand came."""
    target, picking = course.target, course.rule != "selected"
    others = [name for name in course.moved_m if name != target]
    held, lift = carried(course, limits, target), course.lift_m[target]
    touched, strayed = first(course.touches), first([bool(names) for names in course.others])
    closest = int(np.argmin(course.gap_m))
    near = course.gap_m <= limits.near_m
    closing = first((near & (course.grip < limits.closed)).tolist())

    def told(sub_case: str, at: int, sentence: str, **evidence: float | str) -> Diagnosis:
        known = {"gap_m": float(course.gap_m[at]), "closest_m": float(course.gap_m[closest]), "lift_m": float(lift.max())}
        case: Case = "case 3" if course.prompted else "unprompted"
        return Diagnosis(case, sub_case, course.steps[at], "", {**known, **evidence}, 1.0, f"{sentence} at step {course.steps[at]}")

    if True in held:
        last = len(held) - 1 - held[::-1].index(True)
        if last == len(held) - 1:
            return told("timeout", last, f"still holds {target}, {100 * lift[last]:.0f} cm up,")
        if course.rule != "picked" and np.nanmax(course.grip[max(last - 1, 0) : last + 2]) >= limits.closed:
            return told("misplacement", last, f"lets go of {target} in the wrong place", grip=float(course.grip[last]))
        return told("slip", last, f"loses {target} out of the hand", grip=float(course.grip[last]))
    taken = _earliest({name: _taken(course, limits, name) for name in others})
    if taken is not None and (touched is None or taken[0] <= touched):
        return told("wrong object", taken[0], f"takes {taken[1]} instead of {target}", object=taken[1])
    if strayed is not None and touched is None and not (picking and near.any()):
        name = course.others[strayed][0]
        return told("wrong object", strayed, f"touches {name} and comes no closer to {target} than {100 * course.gap_m[closest]:.0f} cm", object=name)
    knocked = _earliest({name: first((course.moved_m[name] >= limits.moved_m).tolist()) for name in others})
    if not picking and strayed is not None and touched is not None and strayed <= touched:
        knocked = strayed, course.others[strayed][0]
    if knocked is not None and (touched is None or knocked[0] <= touched):
        return told("collision", knocked[0], f"{'knocks' if picking else 'touches'} {knocked[1]} on its way to {target}", object=knocked[1])
    tried = [at for at in (touched, closing) if at is not None]
    if tried and picking:
        how = "closes beside" if closing is not None and (touched is None or closing < touched) else "touches but does not grasp"
        return told("missed grasp", min(tried), f"{how} {target} ({1000 * course.gap_m[min(tried)]:.0f} mm away)")
    return told("timeout", closest, f"comes no closer to {target} than {100 * course.gap_m[closest]:.1f} cm")


def _taken(course: Course, limits: Limits, name: str) -> int | None:
    """When another object was picked: carried for as many steps as SIMPLER asks, by a hand that was open when it came. What hangs on a closed hand
    or topples onto it was knocked."""
    met = first([name in names for names in course.others])
    if met is None or course.grip[max(met - 1, 0)] < limits.closed:
        return None
    return next((start for start, stop in runs(carried(course, limits, name)) if stop - start >= HELD_STEPS["picked"]), None)


def _earliest(at: Mapping[str, int | None]) -> tuple[int, str] | None:
    """Who was first, and when."""
    return min(((i, name) for name, i in at.items() if i is not None), default=None)
