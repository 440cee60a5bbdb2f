"""Cases 1, 2 and 3 of a failed episode, from the trace of its frames, and their thresholds."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from vap_core.associate import compare_views
from vap_core.base.events import describe_rejection, is_lost
from vap_core.rollout.types import Case, Diagnosis, Episode, EpisodeTrace, Frame, MaskCoverage
from vap_core.simulation import robots
from vap_core.simulation.control import pose_transform
from vap_core.simulation.suites import suite
from vap_core.simulation.suites.rules import HELD_STEPS, LIFT_M, MOVED_M, Judge
from vap_core.simulation.types import Pose, Truth


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
    header, frames = episode.header, episode.frames
    row = header.row
    truths = [frame.truth for frame in frames]
    judge = Judge.start(row, header.object_sizes_m, truths[0])
    names = _without(judge.start_world, row.goal)
    base = robots.get(suite(row.suite).robot).base_world
    size = header.object_sizes_m[row.target]
    touched = [_without(truth.touched, row.goal) for truth in truths]
    coverage = tuple(frame.coverage for frame in frames)
    first = {camera: each[0] for camera, each in header.groundings.items() if each}
    grip = [np.nan if frame.action is None else float(frame.action[-1]) for frame in frames]

    def over_time(of: Callable[[str, Truth], float]) -> dict[str, np.ndarray]:
        return {name: np.array([of(name, truth) for truth in truths]) for name in names}

    return EpisodeTrace(
        target=row.target,
        rule=row.rule,
        steps=tuple(frame.frame_index for frame in frames),
        coverage=coverage,
        others=tuple(tuple(_without(each, row.target)) for each in touched),
        touches=tuple(row.target in each for each in touched),
        held=tuple(truth.held for truth in truths),
        gap_m=np.array(
            [_gap_m(frame, frame.truth.objects_world[row.target], size, base) for frame in frames]
        ),
        lift_m=over_time(lambda name, t: t.objects_world[name][2] - judge.start_world[name][2]),
        moved_m=over_time(judge.strayed_m),
        grip=np.array(grip),
        candidates={camera: len(each.candidates) for camera, each in first.items()},
        prompted=any(coverage),
        rejected=frozenset(camera for camera, each in first.items() if each.rejected is not None),
        overruled=frozenset(camera for camera, each in first.items() if each.overruled),
    )


def first_true(flags: Sequence[object]) -> int | None:
    """The index of the first true flag, or of the first sequence that is not empty."""
    return next((i for i, flag in enumerate(flags) if flag), None)


def true_runs(flags: Sequence[bool]) -> list[tuple[int, int]]:
    """Start and stop of every unbroken run of True."""
    edges = np.flatnonzero(np.diff(np.array([False, *flags, False]).astype(int))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def carried(trace: EpisodeTrace, thresholds: Thresholds, name: str) -> list[bool]:
    """For every step, whether the robot carries an object."""
    steps = zip(trace.held, trace.lift_m[name].tolist(), strict=True)
    return [name in held and lift >= thresholds.lift_m for held, lift in steps]


def _gap_m(frame: Frame, pose: Pose, size: tuple[float, float, float], base: Pose) -> float:
    """From the tcp to an object's bounding box, metres; 0 inside.

    The object's origin is the centre of its base.
    """
    tcp = pose_transform(base).apply(frame.state[:3].astype(np.float64))
    local = pose_transform(pose).inverse().apply(tcp) - [0.0, 0.0, size[2] / 2]
    return float(np.linalg.norm(np.maximum(np.abs(local) - np.asarray(size) / 2, 0.0)))


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
    # The longest run of wrong steps; where they are not wrong as a whole, the last one.
    start, stop = max(
        true_runs(wrong), key=lambda run: run[1] - run[0] if whole else run[1] == len(wrong)
    )
    kinds = [verdict for _, verdict in judged[start:stop]]
    case: Literal["case 1", "case 2"] = (
        "case 2" if 2 * kinds.count("case 2") >= len(kinds) else "case 1"
    )
    at, _ = judged[start + kinds.index(case)]
    step = trace.steps[at]
    labels = _labels(trace.coverage[at], thresholds)
    view = _most_wrong(trace.coverage[at], labels, trace.target)
    sub_case = "views drift apart" if case == "case 2" else "drift"
    if at == judged[0][0]:
        sub_case = _opening_sub_case(trace, case, view, thresholds)
    evidence: dict[str, float | str] = {
        "wrong_share": float(np.mean(wrong)),
        "judged_steps": float(len(wrong)),
        "iou": view.iou,
        "pixels": float(view.pixels),
        **{f"shows_{camera}": label or "nothing" for camera, label in labels.items()},
    }
    if np.isfinite(view.proposal):
        evidence["proposal"] = view.proposal
    words = _sentence(sub_case, view, labels, step, trace)
    how_many = f"all {len(wrong)}" if all(wrong) else f"{sum(wrong)} of {len(wrong)}"
    checked = "the one frame" if len(wrong) == 1 else f"{how_many} frames"
    return Diagnosis(
        case=case,
        sub_case=sub_case,
        frame_index=step,
        camera=view.camera,
        evidence=evidence,
        confidence=1.0,
        sentence=f"{words}; wrong in {checked} checked",
    )


def verdicts(trace: EpisodeTrace, thresholds: Thresholds, until: int) -> list[Judged]:
    """The judged steps before `until`."""
    steps = enumerate(trace.coverage[: max(until, 1)])
    found = ((i, _verdict(coverage, trace.target, thresholds)) for i, coverage in steps)
    return [(i, verdict) for i, verdict in found if verdict is not None]


def _deciding_steps(trace: EpisodeTrace, thresholds: Thresholds) -> tuple[list[Judged], bool]:
    """The judged steps that decide, and whether they are wrong as a whole.

    Empty where no prompt is to blame.

    Those up to the first touch of any object, when they are wrong in enough steps; else those up to
    where the hand comes to touch another object that a prompt is on.
    """
    every = verdicts(trace, thresholds, until=len(trace.steps))

    def before(at: int) -> list[Judged]:
        return [each for each in every if each[0] < max(at, 1)]

    touches = [each for each in map(first_true, (trace.touches, trace.others)) if each is not None]
    judged = before(min(touches, default=len(trace.steps)))
    if judged and float(np.mean(_wrong_flags(judged))) >= thresholds.share:
        return judged, True
    for at, (earlier, touching) in enumerate(pairwise([(), *trace.others])):
        reached, judged = set(touching) - set(earlier), before(at)
        if reached and judged and judged[-1][1] != "right":
            last, _ = judged[-1]
            if any(view.object in reached for view in trace.coverage[last]):
                return judged, False
    return [], False


def _wrong_flags(judged: Sequence[Judged]) -> list[bool]:
    return [verdict != "right" for _, verdict in judged]


def _verdict(
    coverage: Sequence[MaskCoverage], target: str, thresholds: Thresholds
) -> Verdict | None:
    """Of one step; None when no view counts."""
    labels = _labels(coverage, thresholds)
    match compare_views(labels, target):
        case "nothing":
            return "case 1" if labels else None
        case "right":  # are they good enough in any view?
            views = [view for view in coverage if labels.get(view.camera) == target]
            covered = max([0.0, *(view.iou for view in views)]) >= thresholds.iou
            small = max([0, *(view.pixels for view in views)]) < thresholds.pixels
            return "right" if covered or small else "case 1"
        case wrong:
            return wrong


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

    return max((view for view in coverage if view.camera in labels), key=wrongness)


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


def _sentence(
    sub_case: str,
    view: MaskCoverage,
    labels: Mapping[str, str | None],
    step: int,
    trace: EpisodeTrace,
) -> str:
    iou, proposal, name = f"{view.iou:.2f}", f"{view.proposal:.2f}", _named(view.object)
    shown = ", ".join(f"{camera} {_named(label)}" for camera, label in labels.items())
    overruled = view.camera in trace.overruled
    choice = f"{name} was chosen against the vote" if overruled else f"the vote elected {name}"
    unboxed = f"no box fits the target (best IoU {proposal})"
    unboxed = "the target cannot be seen" if np.isnan(view.proposal) else unboxed
    # A track that still lies on the target drifted by covering it badly.
    poor = view.object == trace.target
    found = f"covers the target badly (IoU {iou})" if poor else f"is on {name}"
    of_views = {
        "views disagree": f"the views show different things from the start: {shown}",
        "views drift apart": f"the views agreed at first; at step {step} they show different "
        f"things: {shown}",
    }
    of_view = {
        "no proposal": "no candidate was found, the target passes unmarked",
        "not in view": "the best candidate is too unlike the references to be highlighted",
        "shifted proposal": f"{unboxed}; {name} is highlighted",
        "distractor vote": f"the target was proposed (IoU {proposal}), and {choice}",
        "poor mask": f"the mask misses most of the target (IoU {iou})",
        "drift": f"right at first, from step {step} on the track {found}",
    }
    return of_views.get(sub_case) or f"{view.camera}: {of_view[sub_case]}"


def _named(label: str | None) -> str:
    if label is None:
        return "nothing"
    return "no object" if label == "" or label.startswith("nothing in ") else label


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
    target = trace.target
    held = carried(trace, thresholds, target)
    if True not in held:
        return None
    last = len(held) - 1 - held[::-1].index(True)
    if last == len(held) - 1:
        lift_cm = 100 * trace.lift_m[target][last]
        return _diagnosis(trace, "timeout", last, f"still holds {target}, {lift_cm:.0f} cm up,")
    around = trace.grip[max(last - 1, 0) : last + 2]
    let_go = trace.rule != "picked" and np.nanmax(around) >= thresholds.closed
    sub_case, sentence = "slip", f"loses {target} out of the hand"
    if let_go:
        sub_case, sentence = "misplacement", f"lets go of {target} in the wrong place"
    return _diagnosis(trace, sub_case, last, sentence, grip=float(trace.grip[last]))


def _wrong_object(trace: EpisodeTrace, thresholds: Thresholds) -> Diagnosis | None:
    target = trace.target
    touched = first_true(trace.touches)
    taken = _earliest({name: _picked(trace, thresholds, name) for name in _others(trace)})
    if taken is not None and (touched is None or taken[0] <= touched):
        at, name = taken
        sentence = f"takes {name} instead of {target}"
        return _diagnosis(trace, "wrong object", at, sentence, object=name)
    strayed = first_true(trace.others)
    reached = trace.rule != "selected" and (trace.gap_m <= thresholds.near_m).any()
    if strayed is not None and touched is None and not reached:
        name = trace.others[strayed][0]
        more = f" and {_closest_words(trace)}"
        return _diagnosis(trace, "wrong object", strayed, f"touches {name}", more, object=name)
    return None


def _collision(trace: EpisodeTrace, thresholds: Thresholds) -> Diagnosis | None:
    touched, strayed = first_true(trace.touches), first_true(trace.others)
    knocked = _earliest(
        {
            name: first_true((trace.moved_m[name] >= thresholds.moved_m).tolist())
            for name in _others(trace)
        }
    )
    selects = trace.rule == "selected"
    if selects and strayed is not None and touched is not None and strayed <= touched:
        knocked = strayed, trace.others[strayed][0]
    if knocked is None or (touched is not None and touched < knocked[0]):
        return None
    at, name = knocked
    sentence = f"{'touches' if selects else 'knocks'} {name} on its way to {trace.target}"
    return _diagnosis(trace, "collision", at, sentence, object=name)


def _missed_grasp(trace: EpisodeTrace, thresholds: Thresholds) -> Diagnosis | None:
    if trace.rule == "selected":
        return None
    near = trace.gap_m <= thresholds.near_m
    touched = first_true(trace.touches)
    at = first_true((near & (trace.grip < thresholds.closed)).tolist())
    if at is not None and (touched is None or at < touched):
        distance = _distance_words(trace, at)
        words = f"closes around {trace.target} without touching it"
        sentence = f"closes beside {trace.target}{distance}" if distance else words
    elif touched is not None:
        at = touched
        sentence = f"touches but does not grasp {trace.target}{_distance_words(trace, at)}"
    else:
        return None
    strayed = first_true(trace.others[:at])
    if strayed is not None:
        sentence = f"touches {trace.others[strayed][0]} first, then {sentence}"
    return _diagnosis(trace, "missed grasp", at, sentence)


def _distance_words(trace: EpisodeTrace, at: int) -> str:
    """How far the tcp is from the target's bounding box; "" where it is in it, or at 0 mm."""
    gap_mm = round(1000 * trace.gap_m[at])
    return f" ({gap_mm} mm from its bounding box)" if gap_mm else ""


def _closest_words(trace: EpisodeTrace) -> str:
    """How close the tcp comes to the bounding box of the target, which the hand never touches."""
    closest_cm = round(100 * trace.gap_m.min())
    if not closest_cm:
        return f"reaches {trace.target} and does not touch it"
    return f"comes no closer to {trace.target} than {closest_cm} cm"


def _timeout(trace: EpisodeTrace) -> Diagnosis:
    closest = int(np.argmin(trace.gap_m))
    sentence = _closest_words(trace)
    if any(trace.touches):
        sentence = f"does not complete the task after it touches {trace.target}"
    return _diagnosis(trace, "timeout", closest, sentence)


def _diagnosis(
    trace: EpisodeTrace,
    sub_case: str,
    at: int,
    sentence: str,
    more: str = "",
    **evidence: float | str,
) -> Diagnosis:
    distances = {
        "gap_m": float(trace.gap_m[at]),
        "closest_m": float(trace.gap_m.min()),
        "lift_m": float(trace.lift_m[trace.target].max()),
    }
    return Diagnosis(
        case="case 3" if trace.prompted else "unprompted",
        sub_case=sub_case,
        frame_index=trace.steps[at],
        camera="",
        evidence={**distances, **evidence},
        confidence=1.0,
        sentence=f"{sentence} at step {trace.steps[at]}{more}",
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
    return min(((step, name) for name, step in at.items() if step is not None), default=None)


NARROW = 0.25
"""A vote that is won by a smaller share of the references is a signal."""


def unlabelled(episode: Episode) -> Diagnosis:
    """The narrowest vote, lost tracks, and how differently similar the views' choices are."""
    first = [each[0] for each in episode.header.groundings.values() if each]
    rejected = [grounding for grounding in first if grounding.rejected is not None]
    found = [grounding for grounding in first if grounding.winner is not None]
    similarities = [float(each.similarity[each.winner].mean()) for each in found] or [0.0]
    narrowest = min(found, key=lambda grounding: grounding.ballot.margin, default=None)
    margin = 0.0 if narrowest is None else narrowest.ballot.margin
    camera = "" if narrowest is None else narrowest.camera
    events = (event for frame in episode.frames for event in frame.events)
    lost = [event.frame_index for event in events if is_lost(event)]
    at = 0
    if rejected and not found:
        camera = rejected[0].camera
        sub_case = "not in view"
        sentence = f"{camera}: {describe_rejection(rejected[0])}, and no other view has it"
    elif not found:
        sub_case, sentence = "nothing found", "no view has a candidate"
    elif margin < NARROW:
        sub_case = "narrow vote"
        sentence = f"{camera}: the vote was won by {margin:.2f} of the references only"
    elif lost:
        sub_case, at = "lost track", lost[0]
        sentence = f"the target was lost {len(lost)} times, first at step {at}"
    else:
        sub_case, at = "no signal", episode.frames[-1].frame_index
        sentence = "votes and tracks give no sign of the cause"
    return Diagnosis(
        case="unlabelled",
        sub_case=sub_case,
        frame_index=at,
        camera="" if at else camera,
        evidence={
            "margin": margin,
            "lost": float(len(lost)),
            "disagreement": max(similarities) - min(similarities),
            "views_without": float(len(first) - len(found)),
        },
        confidence=0.0,
        sentence=sentence,
    )
