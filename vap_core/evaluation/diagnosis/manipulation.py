"""Case 3, and the failures of methods that prompt nothing: what the manipulation did wrong."""

from collections.abc import Mapping

import numpy as np

from vap_core.evaluation.diagnosis.episode_trace import carried, first_true, true_runs
from vap_core.evaluation.diagnosis.thresholds import Thresholds
from vap_core.rollout.failure import Case, Diagnosis, EpisodeTrace
from vap_core.simulation.suites.rules import HELD_STEPS


def failed_manipulation(trace: EpisodeTrace, thresholds: Thresholds) -> Diagnosis:
    """The sub-case of a manipulation, by the first of these that holds.

    What became of a target that was carried; another object taken; another object touched, and the
    target never reached; another object knocked; the target missed; the time out.
    """
    return (
        _lost_target(trace, thresholds)
        or _wrong_object(trace, thresholds)
        or _collision(trace, thresholds)
        or _missed_grasp(trace, thresholds)
        or _timeout(trace)
    )


def _lost_target(trace: EpisodeTrace, thresholds: Thresholds) -> Diagnosis | None:
    """A target that was carried is still held, let go in the wrong place, or has slipped."""
    held = carried(trace, thresholds, trace.target)
    target = trace.target
    if True not in held:
        return None
    last = len(held) - 1 - held[::-1].index(True)
    if last == len(held) - 1:
        lift_cm = 100 * trace.lift_m[target][last]
        return _diagnosis(trace, "timeout", last, f"still holds {target}, {lift_cm:.0f} cm up,")
    grip = float(trace.grip[last])
    around = trace.grip[max(last - 1, 0) : last + 2]
    if trace.rule != "picked" and np.nanmax(around) >= thresholds.closed:
        sentence = f"lets go of {target} in the wrong place"
        return _diagnosis(trace, "misplacement", last, sentence, grip=grip)
    return _diagnosis(trace, "slip", last, f"loses {target} out of the hand", grip=grip)


def _wrong_object(trace: EpisodeTrace, thresholds: Thresholds) -> Diagnosis | None:
    target = trace.target
    touched = first_true(trace.touches)
    picked = {name: _picked(trace, thresholds, name) for name in _others(trace)}
    taken = _earliest(picked)
    if taken is not None and (touched is None or taken[0] <= touched):
        at, name = taken
        sentence = f"takes {name} instead of {target}"
        return _diagnosis(trace, "wrong object", at, sentence, object=name)
    strayed = first_true(trace.others)
    reached = trace.rule != "selected" and (trace.gap_m <= thresholds.near_m).any()
    if strayed is not None and touched is None and not reached:
        name = trace.others[strayed][0]
        sentence = f"touches {name} and {_closest_words(trace, digits=0)}"
        return _diagnosis(trace, "wrong object", strayed, sentence, object=name)
    return None


def _collision(trace: EpisodeTrace, thresholds: Thresholds) -> Diagnosis | None:
    target = trace.target
    touched = first_true(trace.touches)
    strayed = first_true(trace.others)
    moves: dict[str, int | None] = {}
    for name in _others(trace):
        moves[name] = first_true((trace.moved_m[name] >= thresholds.moved_m).tolist())
    knocked = _earliest(moves)
    verb = "knocks"
    if trace.rule == "selected":
        verb = "touches"
        if strayed is not None and touched is not None and strayed <= touched:
            knocked = strayed, trace.others[strayed][0]
    if knocked is None or (touched is not None and touched < knocked[0]):
        return None
    at, name = knocked
    sentence = f"{verb} {name} on its way to {target}"
    return _diagnosis(trace, "collision", at, sentence, object=name)


def _missed_grasp(trace: EpisodeTrace, thresholds: Thresholds) -> Diagnosis | None:
    if trace.rule == "selected":
        return None
    near = trace.gap_m <= thresholds.near_m
    touched = first_true(trace.touches)
    closing = first_true((near & (trace.grip < thresholds.closed)).tolist())
    if closing is not None and (touched is None or closing < touched):
        at = closing
        sentence = _closing_words(trace, at)
    elif touched is not None:
        at = touched
        sentence = f"touches but does not grasp {trace.target}{_distance_words(trace, at)}"
    else:
        return None
    return _diagnosis(trace, "missed grasp", at, sentence)


def _closing_words(trace: EpisodeTrace, at: int) -> str:
    """How the hand closes at step index `at`, at which it does not touch the target."""
    distance = _distance_words(trace, at)
    if not distance:
        return f"closes around {trace.target} without touching it"
    return f"closes beside {trace.target}{distance}"


def _distance_words(trace: EpisodeTrace, at: int) -> str:
    """How far the tcp is from the target's bounding box; "" where it is in it, or at 0 mm."""
    gap_mm = round(1000 * trace.gap_m[at])
    if gap_mm == 0:
        return ""
    return f" ({gap_mm} mm from its bounding box)"


def _closest_words(trace: EpisodeTrace, digits: int) -> str:
    """How close the tcp comes to the bounding box of the target, which the hand never touches."""
    closest_cm = f"{100 * trace.gap_m.min():.{digits}f}"
    if float(closest_cm) == 0:
        return f"reaches {trace.target} and does not touch it"
    return f"comes no closer to {trace.target} than {closest_cm} cm"


def _timeout(trace: EpisodeTrace) -> Diagnosis:
    closest = int(np.argmin(trace.gap_m))
    sentence = _closest_words(trace, digits=1)
    if any(trace.touches):
        sentence = f"does not complete the task after it touches {trace.target}"
    return _diagnosis(trace, "timeout", closest, sentence)


def _diagnosis(
    trace: EpisodeTrace, sub_case: str, at: int, sentence: str, **evidence: float | str
) -> Diagnosis:
    case: Case = "unprompted"
    if trace.prompted:
        case = "case 3"
    distances = {
        "gap_m": float(trace.gap_m[at]),
        "closest_m": float(trace.gap_m.min()),
        "lift_m": float(trace.lift_m[trace.target].max()),
    }
    return Diagnosis(
        case=case,
        sub_case=sub_case,
        frame_index=trace.steps[at],
        camera="",
        evidence={**distances, **evidence},
        confidence=1.0,
        sentence=f"{sentence} at step {trace.steps[at]}",
    )


def _others(trace: EpisodeTrace) -> list[str]:
    return [name for name in trace.moved_m if name != trace.target]


def _picked(trace: EpisodeTrace, thresholds: Thresholds, name: str) -> int | None:
    """When another object was picked.

    That is, carried for as many steps as SIMPLER asks, by a hand that was open when it arrived.
    What hangs on a closed hand, or topples onto it, was knocked.
    """
    met = first_true([name in names for names in trace.others])
    if met is None or trace.grip[max(met - 1, 0)] < thresholds.closed:
        return None
    for start, stop in true_runs(carried(trace, thresholds, name)):
        if stop - start >= HELD_STEPS["picked"]:
            return start
    return None


def _earliest(at: Mapping[str, int | None]) -> tuple[int, str] | None:
    """The earliest step of any object, and the object."""
    earliest = None
    for name, step in at.items():
        if step is not None and (earliest is None or (step, name) < earliest):
            earliest = step, name
    return earliest
