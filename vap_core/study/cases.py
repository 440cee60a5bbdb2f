"""Cases 1, 2 and 3 of a failed episode, from the trace of its frames, and their thresholds."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from vap_core.associate import compare_views
from vap_core.base.events import describe_rejection, is_lost
from vap_core.rollout.types import Case, Diagnosis, Episode, EpisodeTrace, Frame, MaskCoverage
from vap_core.simulation import robots
from vap_core.simulation.control import pose_transform
from vap_core.simulation.suites import suite
from vap_core.simulation.suites.rules import HELD_STEPS, LIFT_M, MOVED_M, Judge
from vap_core.simulation.types import Pose


@dataclass(frozen=True)
class Thresholds:
    """Where the rules draw their lines.

    A mask is on the target from `iou` on. A view counts if it shows at least `pixels` of the target
    (of 224 x 224), or highlights something. Prompts are wrong that are wrong in at least `share` of
    the judged steps. A candidate proposes the target from a box IoU of `proposal` on. The target is
    carried when it is held and at least `lift_m` higher. An object is knocked when it has moved by
    `moved_m`. The hand closes on the target when the gripper's command falls below `closed` with
    the tcp within `near_m` of the target's bounding box.
    """

    iou: float = 0.5
    pixels: float = 100.0
    share: float = 0.5
    proposal: float = 0.5
    lift_m: float = LIFT_M
    moved_m: float = MOVED_M
    near_m: float = 0.05
    closed: float = 0.5


THRESHOLDS = Thresholds()
NEIGHBOURS: dict[str, tuple[float, float]] = {
    "iou": (0.35, 0.65),
    "pixels": (50.0, 200.0),
    "share": (0.34, 0.67),
    "proposal": (0.35, 0.65),
    "lift_m": (0.005, 0.02),
    "moved_m": (0.02, 0.05),
    "near_m": (0.03, 0.08),
    "closed": (0.35, 0.65),
}
"""One threshold at a time, stricter and laxer."""


def neighbours(thresholds: Thresholds) -> Iterator[Thresholds]:
    """`thresholds` with one of them changed, twice for each."""
    for name, values in NEIGHBOURS.items():
        for each in values:
            yield replace(thresholds, **{name: each})


def has_truth(episode: Episode) -> bool:
    """Whether the frames hold ground truth."""
    return bool(episode.frames) and bool(episode.frames[0].truth.objects_world)


def trace_episode(episode: Episode) -> EpisodeTrace:
    """The trace of an episode that has ground truth."""
    header = episode.header
    frames = episode.frames
    row = header.row
    judge = Judge.start(row, header.object_sizes_m, frames[0].truth)
    names = _without(judge.start_world, row.goal)
    base = robots.get(suite(row.suite).robot).base_world
    size = header.object_sizes_m[row.target]

    steps = []
    coverage = []
    others = []
    touches = []
    held = []
    gap_m = []
    grip = []
    lift_m, moved_m = np.zeros((2, len(names), len(frames)))
    for step, frame in enumerate(frames):
        truth = frame.truth
        steps.append(frame.frame_index)
        coverage.append(frame.coverage)
        touched = _without(truth.touched, row.goal)
        others.append(tuple(_without(touched, row.target)))
        touches.append(row.target in touched)
        held.append(truth.held)
        gap_m.append(_gap_m(frame, truth.objects_world[row.target], size, base))
        grip.append(np.nan if frame.action is None else float(frame.action[-1]))
        for i, name in enumerate(names):
            lift_m[i, step] = truth.objects_world[name][2] - judge.start_world[name][2]
            moved_m[i, step] = judge.strayed_m(name, truth)

    candidates = {}
    rejected = []
    overruled = []
    for camera, per_target in header.groundings.items():
        candidates[camera] = len(per_target[0].candidates) if per_target else 0
        if per_target and per_target[0].rejected is not None:
            rejected.append(camera)
        if per_target and per_target[0].overruled:
            overruled.append(camera)
    return EpisodeTrace(
        target=row.target,
        rule=row.rule,
        steps=tuple(steps),
        coverage=tuple(coverage),
        others=tuple(others),
        touches=tuple(touches),
        held=tuple(held),
        gap_m=np.array(gap_m),
        lift_m=dict(zip(names, lift_m, strict=True)),
        moved_m=dict(zip(names, moved_m, strict=True)),
        grip=np.array(grip),
        candidates=candidates,
        prompted=any(coverage),
        rejected=frozenset(rejected),
        overruled=frozenset(overruled),
    )


def first_true(flags: Sequence[object]) -> int | None:
    """The index of the first true flag, or of the first sequence that is not empty."""
    for i, flag in enumerate(flags):
        if flag:
            return i
    return None


def true_runs(flags: Sequence[bool]) -> list[tuple[int, int]]:
    """Start and stop of every unbroken run of True."""
    padded = np.array([False, *flags, False]).astype(int)
    edges = np.flatnonzero(np.diff(padded)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def carried(trace: EpisodeTrace, thresholds: Thresholds, name: str) -> list[bool]:
    """For every step, whether the robot carries an object."""
    flags = []
    for held, lift in zip(trace.held, trace.lift_m[name].tolist(), strict=True):
        flags.append(name in held and lift >= thresholds.lift_m)
    return flags


def _gap_m(frame: Frame, pose: Pose, size: tuple[float, float, float], base: Pose) -> float:
    """From the tcp to an object's bounding box, metres; 0 inside.

    The object's origin is the centre of its base.
    """
    tcp = pose_transform(base).apply(frame.state[:3].astype(np.float64))
    local = pose_transform(pose).inverse().apply(tcp) - [0.0, 0.0, size[2] / 2]
    outside = np.maximum(np.abs(local) - np.asarray(size) / 2, 0.0)
    return float(np.linalg.norm(outside))


def _without(names: Iterable[str], excluded: str) -> list[str]:
    return [name for name in names if name != excluded]


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


NARROW = 0.25
"""A vote that is won by a smaller share of the references is a signal."""


def unlabelled(episode: Episode) -> Diagnosis:
    """The narrowest vote, lost tracks, and how differently similar the views' choices are."""
    found = []
    similarities = []
    rejected = []
    views_without = 0
    for groundings in episode.header.groundings.values():
        if not groundings:
            continue
        grounding = groundings[0]
        if grounding.rejected is not None:
            rejected.append(grounding)
        if grounding.winner is None:
            views_without += 1
        else:
            found.append(grounding)
            similarities.append(float(grounding.similarity[grounding.winner].mean()))
    margin = 0.0
    camera = ""
    disagreement = 0.0
    if found:
        narrowest = min(found, key=lambda grounding: grounding.ballot.margin)
        margin = narrowest.ballot.margin
        camera = narrowest.camera
        disagreement = max(similarities) - min(similarities)
    lost = []
    for frame in episode.frames:
        for event in frame.events:
            if is_lost(event):
                lost.append(event.frame_index)

    at = 0
    if rejected and not found:
        camera = rejected[0].camera
        sub_case = "not in view"
        sentence = f"{camera}: {describe_rejection(rejected[0])}, and no other view has it"
    elif not found:
        sub_case = "nothing found"
        sentence = "no view has a candidate"
    elif margin < NARROW:
        sub_case = "narrow vote"
        sentence = f"{camera}: the vote was won by {margin:.2f} of the references only"
    elif lost:
        sub_case = "lost track"
        at = lost[0]
        sentence = f"the target was lost {len(lost)} times, first at step {lost[0]}"
    else:
        sub_case = "no signal"
        at = episode.frames[-1].frame_index
        sentence = "votes and tracks give no sign of the cause"
    return Diagnosis(
        case="unlabelled",
        sub_case=sub_case,
        frame_index=at,
        camera="" if at else camera,
        evidence={
            "margin": margin,
            "lost": float(len(lost)),
            "disagreement": disagreement,
            "views_without": float(views_without),
        },
        confidence=0.0,
        sentence=sentence,
    )
