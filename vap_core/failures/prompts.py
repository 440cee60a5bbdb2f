"""Cases 1 and 2: were the prompts right, when it mattered?"""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from vap_core import associate
from vap_core.failures.course import Course, first, runs
from vap_core.failures.labels import Case, Diagnosis, Limits
from vap_core.values import Shown

type Verdict = Literal["right", "case 1", "case 2"]


def wrong_prompt(course: Course, limits: Limits) -> Diagnosis | None:
    """Case 1 or 2, or None where the prompts were right when it mattered."""
    touched, strayed = first(course.touches), first([bool(names) for names in course.others])
    until = min((at for at in (touched, strayed) if at is not None), default=len(course.steps))
    told = verdicts(course, limits, until)
    share = float(np.mean([verdict != "right" for _, verdict in told])) if told else 0.0
    if share < limits.share:
        told = verdicts(course, limits, strayed) if strayed is not None else []
        if not told or told[-1][1] == "right" or not _points_at(course, told[-1][0], course.others[strayed or 0]):
            return None
    wrong = [verdict != "right" for _, verdict in told]
    if not any(wrong):
        return None
    start, stop = max(runs(wrong), key=lambda run: (run[1] == len(wrong)) if share < limits.share else run[1] - run[0])
    kinds = [verdict for _, verdict in told[start:stop]]
    case: Case = "case 2" if 2 * kinds.count("case 2") >= len(kinds) else "case 1"
    at = next(i for i, verdict in told[start:stop] if verdict == case)
    labels = _labels(course.shown[at], limits)
    view = _culprit(course.shown[at], labels, course.target)
    opening = at == told[0][0]
    sub_case = _opening_sub_case(course, case, view, limits) if opening else "views drift apart" if case == "case 2" else "drift"
    evidence: dict[str, float | str] = {
        "wrong_share": float(np.mean(wrong)), "judged_steps": float(len(wrong)), "iou": view.iou, "pixels": float(view.pixels),
        **{f"shows_{camera}": "nothing" if what is None else what for camera, what in labels.items()},
        **({"proposal": view.proposal} if np.isfinite(view.proposal) else {}),
    }  # fmt: skip
    many = f"{round(100 * float(np.mean(wrong)))} % of {len(wrong)} judged steps"
    seen = ", ".join(f"{camera} {_named(what)}" for camera, what in labels.items())
    words = {
        "no proposal": f"{view.camera}: no candidate was found, the target passes unmarked",
        "shifted proposal": f"{view.camera}: no box fits the target (best IoU {view.proposal:.2f}); {_named(view.object)} is highlighted",
        "distractor vote": f"{view.camera}: the target was proposed (IoU {view.proposal:.2f}), and the vote elected {_named(view.object)}",
        "poor mask": f"{view.camera}: the mask misses most of the target (IoU {view.iou:.2f})",
        "drift": f"{view.camera}: right at first, from step {course.steps[at]} on the track is on {_named(view.object)}",
        "views disagree": f"the views show different things from the start: {seen}",
        "views drift apart": f"the views agreed at first; at step {course.steps[at]} they show different things: {seen}",
    }[sub_case]
    return Diagnosis(case, sub_case, course.steps[at], view.camera, evidence, 1.0, f"{words}; prompts wrong in {many}")


def verdicts(course: Course, limits: Limits, until: int) -> list[tuple[int, Verdict]]:
    """The judged steps before `until`, as indices into the course, and what is to be said of each."""
    told = [(i, _verdict(shown, course.target, limits)) for i, shown in enumerate(course.shown[: max(until, 1)]) if shown]
    return [(i, verdict) for i, verdict in told if verdict is not None]


def _verdict(shown: Sequence[Shown], target: str, limits: Limits) -> Verdict | None:
    """Of one step: None when no view counts."""
    labels = _labels(shown, limits)
    match associate.case(labels, target):
        case "nothing":
            return "case 1" if labels else None
        case "right":
            best = max(view.iou for view in shown if labels.get(view.camera) == target)
            seen = max(view.pixels for view in shown if labels.get(view.camera) == target)
            return "right" if best >= limits.iou or seen < limits.pixels else "case 1"
        case wrong:
            return wrong


def _labels(shown: Sequence[Shown], limits: Limits) -> dict[str, str | None]:
    """What each view that counts highlights; a mask on nothing in particular is another thing in every view."""
    counting = [view for view in shown if view.pixels >= limits.pixels or view.object is not None]
    return {view.camera: f"nothing in {view.camera}" if view.object == "" else view.object for view in counting}


def _points_at(course: Course, at: int, names: Sequence[str]) -> bool:
    """Whether a view highlights one of some objects at one step."""
    return any(view.object in names for view in course.shown[at])


def _named(what: str | None) -> str:
    return "nothing" if what is None else "no object" if what == "" or what.startswith("nothing in ") else what


def _culprit(shown: Sequence[Shown], labels: Mapping[str, str | None], target: str) -> Shown:
    """The view that is most wrong: another object first, then nothing, then a poor mask."""
    counting = [view for view in shown if view.camera in labels]
    return max(counting, key=lambda view: (labels[view.camera] not in (target, None), labels[view.camera] is None, -view.iou))


def _opening_sub_case(course: Course, case: Case, view: Shown, limits: Limits) -> str:
    if case == "case 2":
        return "views disagree"
    if course.candidates.get(view.camera, 0) == 0:
        return "no proposal"
    if not view.proposal >= limits.proposal:
        return "shifted proposal"
    return "distractor vote" if view.object not in (course.target, "", None) else "poor mask"
