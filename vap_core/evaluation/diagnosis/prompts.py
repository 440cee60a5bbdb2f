"""Cases 1 and 2: were the prompts right when it mattered?"""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from vap_core.associate import compare_views
from vap_core.evaluation.diagnosis.episode_trace import first_true, true_runs
from vap_core.evaluation.diagnosis.thresholds import Thresholds
from vap_core.rollout.failure import Case, Diagnosis, EpisodeTrace
from vap_core.rollout.types import MaskCoverage

type Verdict = Literal["right", "case 1", "case 2"]
Judged = tuple[int, Verdict]
"""An index into the trace, and the verdict on the prompts of that step."""


def wrong_prompt(trace: EpisodeTrace, thresholds: Thresholds) -> Diagnosis | None:
    """Case 1 or 2, or None where the prompts were right when it mattered."""
    judged, whole = _deciding_steps(trace, thresholds)
    wrong = _wrong_flags(judged)
    if not any(wrong):
        return None
    start, stop = _deciding_run(wrong, whole)
    kinds = [verdict for _, verdict in judged[start:stop]]
    case: Literal["case 1", "case 2"] = "case 1"
    if 2 * kinds.count("case 2") >= len(kinds):
        case = "case 2"
    at, _ = judged[start + kinds.index(case)]

    labels = _labels(trace.coverage[at], thresholds)
    view = _most_wrong(trace.coverage[at], labels, trace.target)
    if at == judged[0][0]:
        sub_case = _opening_sub_case(trace, case, view, thresholds)
    elif case == "case 2":
        sub_case = "views drift apart"
    else:
        sub_case = "drift"
    share = float(np.mean(wrong))
    chosen_by_vote = view.camera not in trace.overruled
    if sub_case == "drift":
        words = _drift_words(view, trace.target, trace.steps[at])
    else:
        words = _sentence(sub_case, view, labels, trace.steps[at], chosen_by_vote=chosen_by_vote)
    return Diagnosis(
        case=case,
        sub_case=sub_case,
        frame_index=trace.steps[at],
        camera=view.camera,
        evidence=_evidence(view, labels, share, len(wrong)),
        confidence=1.0,
        sentence=f"{words}; {_wrong_words(wrong)}",
    )


def verdicts(trace: EpisodeTrace, thresholds: Thresholds, until: int) -> list[Judged]:
    """The judged steps before `until`."""
    judged = []
    for i, coverage in enumerate(trace.coverage[: max(until, 1)]):
        verdict = _verdict(coverage, trace.target, thresholds)
        if verdict is not None:
            judged.append((i, verdict))
    return judged


def _deciding_steps(trace: EpisodeTrace, thresholds: Thresholds) -> tuple[list[Judged], bool]:
    """The judged steps that decide, and whether they are wrong as a whole.

    Empty where no prompt is to blame.

    Those up to the first touch of any object, when they are wrong in enough steps; else those up to
    where the hand comes to touch another object that a prompt is on.
    """
    touched = first_true(trace.touches)
    strayed = first_true(trace.others)
    until = len(trace.steps)
    for at in (touched, strayed):
        if at is not None:
            until = min(until, at)
    judged = verdicts(trace, thresholds, until)
    if judged and float(np.mean(_wrong_flags(judged))) >= thresholds.share:
        return judged, True
    if strayed is None:
        return [], False
    every = verdicts(trace, thresholds, until=len(trace.steps))
    before: set[str] = set()
    for at, touching in enumerate(trace.others):
        reached = set(touching) - before
        before = set(touching)
        if not reached:
            continue
        judged = [each for each in every if each[0] < max(at, 1)]
        if not judged or judged[-1][1] == "right":
            continue
        last, _ = judged[-1]
        if any(view.object in reached for view in trace.coverage[last]):
            return judged, False
    return [], False


def _wrong_flags(judged: Sequence[Judged]) -> list[bool]:
    return [verdict != "right" for _, verdict in judged]


def _deciding_run(wrong: Sequence[bool], whole: bool) -> tuple[int, int]:
    """The longest run of wrong steps; where they are not wrong as a whole, the last one."""
    if whole:
        return max(true_runs(wrong), key=lambda run: run[1] - run[0])
    return max(true_runs(wrong), key=lambda run: run[1] == len(wrong))


def _verdict(
    coverage: Sequence[MaskCoverage], target: str, thresholds: Thresholds
) -> Verdict | None:
    """Of one step; None when no view counts."""
    labels = _labels(coverage, thresholds)
    match compare_views(labels, target):
        case "nothing":
            return "case 1" if labels else None
        case "right":
            return _verdict_on_target(coverage, labels, target, thresholds)
        case wrong:
            return wrong


def _verdict_on_target(
    coverage: Sequence[MaskCoverage],
    labels: Mapping[str, str | None],
    target: str,
    thresholds: Thresholds,
) -> Verdict:
    """Of a step whose prompts are all on the target: are they good enough in any view?"""
    iou = 0.0
    pixels = 0
    for view in coverage:
        if labels.get(view.camera) == target:
            iou = max(iou, view.iou)
            pixels = max(pixels, view.pixels)
    if iou >= thresholds.iou or pixels < thresholds.pixels:
        return "right"
    return "case 1"


def _labels(coverage: Sequence[MaskCoverage], thresholds: Thresholds) -> dict[str, str | None]:
    """What each view that counts highlights.

    A mask on nothing in particular is another thing in every view.
    """
    labels: dict[str, str | None] = {}
    for view in coverage:
        if view.object == "":
            labels[view.camera] = f"nothing in {view.camera}"
        elif view.pixels >= thresholds.pixels or view.object is not None:
            labels[view.camera] = view.object
    return labels


def _most_wrong(
    coverage: Sequence[MaskCoverage], labels: Mapping[str, str | None], target: str
) -> MaskCoverage:
    """The view that is most wrong: another object first, then nothing, then a poor mask."""

    def wrongness(view: MaskCoverage) -> tuple[bool, bool, float]:
        label = labels[view.camera]
        return label not in (target, None), label is None, -view.iou

    counting = [view for view in coverage if view.camera in labels]
    return max(counting, key=wrongness)


def _opening_sub_case(
    trace: EpisodeTrace, case: Case, view: MaskCoverage, thresholds: Thresholds
) -> str:
    if case == "case 2":
        return "views disagree"
    if trace.candidates.get(view.camera, 0) == 0:
        return "no proposal"
    if view.camera in trace.rejected:
        return "not in view"
    if not view.proposal >= thresholds.proposal:
        return "shifted proposal"
    if view.object in (trace.target, "", None):
        return "poor mask"
    return "distractor vote"


def _evidence(
    view: MaskCoverage, labels: Mapping[str, str | None], share: float, steps: int
) -> dict[str, float | str]:
    evidence: dict[str, float | str] = {
        "wrong_share": share,
        "judged_steps": float(steps),
        "iou": view.iou,
        "pixels": float(view.pixels),
    }
    for camera, label in labels.items():
        evidence[f"shows_{camera}"] = label or "nothing"
    if np.isfinite(view.proposal):
        evidence["proposal"] = view.proposal
    return evidence


def _sentence(
    sub_case: str,
    view: MaskCoverage,
    labels: Mapping[str, str | None],
    step: int,
    *,
    chosen_by_vote: bool,
) -> str:
    camera = view.camera
    iou = f"{view.iou:.2f}"
    proposal = f"{view.proposal:.2f}"
    name = _named(view.object)
    parts = []
    for of_view, label in labels.items():
        parts.append(f"{of_view} {_named(label)}")
    shown = ", ".join(parts)
    match sub_case:
        case "no proposal":
            return f"{camera}: no candidate was found, the target passes unmarked"
        case "not in view":
            return f"{camera}: the best candidate is too unlike the references to be highlighted"
        case "shifted proposal":
            if np.isnan(view.proposal):
                return f"{camera}: the target cannot be seen; {name} is highlighted"
            return f"{camera}: no box fits the target (best IoU {proposal}); {name} is highlighted"
        case "distractor vote":
            choice = f"the vote elected {name}"
            if not chosen_by_vote:
                choice = f"{name} was chosen against the vote"
            return f"{camera}: the target was proposed (IoU {proposal}), and {choice}"
        case "poor mask":
            return f"{camera}: the mask misses most of the target (IoU {iou})"
        case "views disagree":
            return f"the views show different things from the start: {shown}"
    return f"the views agreed at first; at step {step} they show different things: {shown}"


def _drift_words(view: MaskCoverage, target: str, step: int) -> str:
    """A track that still lies on the target drifted by covering it badly."""
    found = f"is on {_named(view.object)}"
    if view.object == target:
        found = f"covers the target badly (IoU {view.iou:.2f})"
    return f"{view.camera}: right at first, from step {step} on the track {found}"


def _wrong_words(wrong: Sequence[bool]) -> str:
    """In how many of the judged steps the prompts were wrong."""
    if len(wrong) == 1:
        return "wrong in the one frame checked"
    n = sum(wrong)
    if n == len(wrong):
        return f"wrong in all {n} frames checked"
    return f"wrong in {n} of {len(wrong)} frames checked"


def _named(label: str | None) -> str:
    if label is None:
        return "nothing"
    if label == "" or label.startswith("nothing in "):
        return "no object"
    return label
