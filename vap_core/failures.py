"""Why an episode failed: one case with its sub-case, deciding frame, camera and evidence, from the simulator's truth (P 5.5; SPEC section 7).

The prompts are judged up to the first touch of the target or of another object that is not the goal: they have then brought the hand where it is, and
what a track loses when its object topples is the hand's doing. They are wrong when they are wrong for half of that time; or when, any time later,
the hand touches another object while a prompt points at it.

Case 1, all views are prompted alike, and wrong: *no proposal*, *shifted proposal*, *distractor vote*, *poor mask* (all at t = 0), *drift* (later).
Case 2, views are prompted with different instances: *views disagree* (at t = 0), *views drift apart* (later).
Case 3, the prompts are right and the hand fails: *wrong object* (it takes another all the same, or touches it and never comes near the target),
*collision* (it knocks another on its way), *missed grasp*, *slip*, *misplacement* (let go in the wrong place), *timeout*.
Methods that highlight nothing have no prompt to be wrong: their failures are *unprompted*, with the sub-cases of Case 3.
A real robot's episode has no truth: it stays *unlabelled*, with the signals that the method itself gives (`_unlabelled`).

Every threshold is a field of `Limits`. The confidence of a diagnosis is the share of neighbouring limits (NEIGHBOURS) under which it stays the same.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from vap_core import associate
from vap_core.sim import robots
from vap_core.suites import suite
from vap_core.suites.rules import HELD_STEPS, LIFT_M, MOVED_M, Judge
from vap_core.values import Episode, Frame, Pose, Shown, value

type Case = Literal["case 1", "case 2", "case 3", "unprompted", "unlabelled"]
CASES: dict[Case, tuple[str, ...]] = {
    "case 1": ("no proposal", "shifted proposal", "distractor vote", "poor mask", "drift"),
    "case 2": ("views disagree", "views drift apart"),
    "case 3": ("wrong object", "collision", "missed grasp", "slip", "misplacement", "timeout"),
    "unprompted": ("wrong object", "collision", "missed grasp", "slip", "misplacement", "timeout"),
    "unlabelled": ("nothing found", "lost track", "narrow vote", "no signal"),
}
"""Every sub-case of every case, in the order of the way from the picture to the hand."""


@dataclass(frozen=True)
class Limits:
    """Where the rules draw their lines.

    A mask is on the target from `iou` on; a view counts that shows at least `pixels` of it (of 224 x 224) or that highlights something; prompts
    are wrong that are wrong in at least `share` of the judged steps; a candidate proposes the target from a box IoU of `proposal` on. The target
    is carried when it is held and at least `lift_m` higher; an object is knocked when it moved by `moved_m`; the hand closes on the target
    when the gripper's command falls below `closed` with the tcp within `near_m` of its bounding box.
    """

    iou: float = 0.5
    pixels: float = 100.0
    share: float = 0.5
    proposal: float = 0.5
    lift_m: float = LIFT_M
    moved_m: float = MOVED_M
    near_m: float = 0.05
    closed: float = 0.5


LIMITS = Limits()
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
"""One limit at a time, stricter and laxer."""


@value
class Diagnosis:
    """Why one episode failed. `camera` is "" where none decides; `sentence` says it in words; `evidence` in numbers and names."""

    case: Case
    sub_case: str
    frame_index: int
    camera: str
    evidence: Mapping[str, float | str]
    confidence: float
    sentence: str

    def columns(self) -> dict[str, Any]:
        """Its part of a row of a results table."""
        evidence = {name: round(part, 4) if isinstance(part, float) else part for name, part in self.evidence.items()}
        return {
            "case": self.case, "sub_case": self.sub_case, "deciding_frame": self.frame_index, "deciding_camera": self.camera,
            "case_confidence": self.confidence, "case_sentence": self.sentence, "case_evidence": json.dumps(evidence),
        }  # fmt: skip


NONE: dict[str, Any] = {
    "case": "", "sub_case": "", "deciding_frame": -1, "deciding_camera": "", "case_confidence": float("nan"), "case_sentence": "",
    "case_evidence": "",
}  # fmt: skip
"""Of an episode that did not fail."""


def diagnose(episode: Episode, limits: Limits = LIMITS) -> Diagnosis | None:
    """The one case of a failed episode; None for a success, and for an error, whose traceback says why."""
    if episode.outcome.status != "failure" or not episode.frames:
        return None
    if not episode.frames[0].truth.objects_world:
        return _unlabelled(episode)
    course = follow(episode)
    found = _classify(course, limits)
    same = [(other.case, other.sub_case) == (found.case, found.sub_case) for other in (_classify(course, near) for near in neighbours(limits))]
    return replace(found, confidence=float(np.mean(same)))


def neighbours(limits: Limits) -> Iterator[Limits]:
    """`limits` with one of them changed, twice for each."""
    for name, values in NEIGHBOURS.items():
        for each in values:
            yield replace(limits, **{name: each})


def columns(episode: Episode) -> dict[str, Any]:
    """What a results table keeps of an episode beside its outcome: its diagnosis, and how far it came (`stages`)."""
    found = diagnose(episode)
    return {**(NONE if found is None else found.columns()), **stages(episode)}


NARROW = 0.25
"""A vote won by less of the references than this could as well have gone to another."""


def _unlabelled(episode: Episode) -> Diagnosis:
    """What can be said without truth: the narrowest vote, tracks that were lost, and how differently the views liked what they chose."""
    groundings = [per_target[0] for per_target in episode.opening.groundings.values() if per_target]
    found = [g for g in groundings if g.winner is not None]
    lost = [event.frame_index for frame in episode.frames for event in frame.events if "not visible, the view passes unmodified" in event.text]
    likings = [float(g.similarity[g.winner].mean()) for g in found]
    narrowest = min(found, key=lambda g: g.margin, default=None)
    margin = 0.0 if narrowest is None else narrowest.margin
    evidence: dict[str, float | str] = {
        "margin": margin, "lost": float(len(lost)), "disagreement": max(likings) - min(likings) if likings else 0.0,
        "views_without": float(len(groundings) - len(found)),
    }  # fmt: skip
    at, camera = 0, "" if narrowest is None else narrowest.camera
    if not found:
        sub_case, words = "nothing found", "no view has a candidate"
    elif margin < NARROW:
        sub_case, words = "narrow vote", f"{camera}: the vote was won by {margin:.2f} of the references only"
    elif lost:
        sub_case, at, words = "lost track", lost[0], f"the target was lost {len(lost)} times, first at step {lost[0]}"
    else:
        sub_case, at, words = "no signal", episode.frames[-1].frame_index, "votes and tracks give no sign of what went wrong"
    return Diagnosis("unlabelled", sub_case, at, camera if at == 0 else "", evidence, 0.0, words)


@value
class Course:
    """What the rules look at, one entry per recorded step; nothing in it depends on the limits.

    `others` and `touches` say which objects other than the goal the robot touched in a step, and whether the target was one; `gap_m` how far the
    tcp is from the target's bounding box; `lift_m` how much higher each object stands than at first, and `moved_m` how far it has moved.
    """

    target: str
    rule: str
    steps: tuple[int, ...]
    shown: tuple[tuple[Shown, ...], ...]
    others: tuple[tuple[str, ...], ...]
    touches: tuple[bool, ...]
    held: tuple[frozenset[str], ...]
    gap_m: Float64[np.ndarray, " t"]
    lift_m: Mapping[str, Float64[np.ndarray, " t"]]
    moved_m: Mapping[str, Float64[np.ndarray, " t"]]
    grip: Float64[np.ndarray, " t"]
    candidates: Mapping[str, int]
    prompted: bool


def follow(episode: Episode) -> Course:
    """An episode's course, from its frames."""
    opening, frames = episode.opening, episode.frames
    row = opening.row
    judge = Judge.start(row, opening.target_sizes_m, frames[0].truth)
    names = [name for name in judge.start_world if name != row.goal]
    base = robots.get(suite(row.suite).robot).base_world
    touched = [tuple(name for name in frame.truth.touched if name != row.goal) for frame in frames]
    return Course(
        row.target,
        row.rule,
        tuple(frame.frame_index for frame in frames),
        tuple(frame.shown for frame in frames),
        tuple(tuple(name for name in names if name != row.target) for names in touched),
        tuple(row.target in names for names in touched),
        tuple(frame.truth.held for frame in frames),
        np.array([_gap(frame, row.target, opening.target_sizes_m[row.target], base) for frame in frames]),
        {name: np.array([frame.truth.objects_world[name][2] - judge.start_world[name][2] for frame in frames]) for name in names},
        {name: np.array([judge.travel_m(name, frame.truth) for frame in frames]) for name in names},
        np.array([float(frame.action[-1]) for frame in frames]),
        {camera: len(per_target[0].candidates) if per_target else 0 for camera, per_target in opening.groundings.items()},
        any(frame.shown for frame in frames),
    )


def _gap(frame: Frame, name: str, size: tuple[float, float, float], base: Pose) -> float:
    """From the tcp to an object's bounding box, metres; 0 inside."""
    from scipy.spatial.transform import Rotation

    tcp = base[:3] + Rotation.from_quat(base[3:], scalar_first=True).apply(frame.state[:3].astype(np.float64))
    pose = frame.truth.objects_world[name]
    local = Rotation.from_quat(pose[3:], scalar_first=True).inv().apply(tcp - pose[:3]) - [0.0, 0.0, size[2] / 2]
    return float(np.linalg.norm(np.maximum(np.abs(local) - np.asarray(size) / 2, 0.0)))


def _classify(course: Course, limits: Limits) -> Diagnosis:
    return (_wrong_prompt(course, limits) if course.prompted else None) or _failed_hand(course, limits)


type Verdict = Literal["right", "case 1", "case 2"]


def _labels(shown: Sequence[Shown], limits: Limits) -> dict[str, str | None]:
    """What each view that counts highlights; a mask on nothing in particular is another thing in every view."""
    counting = [view for view in shown if view.pixels >= limits.pixels or view.object is not None]
    return {view.camera: f"nothing in {view.camera}" if view.object == "" else view.object for view in counting}


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


def _verdicts(course: Course, limits: Limits, until: int) -> list[tuple[int, Verdict]]:
    """The judged steps before `until`, as indices into the course, and what is to be said of each."""
    told = [(i, _verdict(shown, course.target, limits)) for i, shown in enumerate(course.shown[: max(until, 1)]) if shown]
    return [(i, verdict) for i, verdict in told if verdict is not None]


def _first(flags: Sequence[bool]) -> int | None:
    return next((i for i, flag in enumerate(flags) if flag), None)


def _carried(course: Course, limits: Limits, name: str) -> list[bool]:
    return [name in held and lift >= limits.lift_m for held, lift in zip(course.held, course.lift_m[name].tolist(), strict=True)]


def _wrong_prompt(course: Course, limits: Limits) -> Diagnosis | None:
    """Case 1 or 2, or None where the prompts were right when it mattered."""
    touched, strayed = _first(course.touches), _first([bool(names) for names in course.others])
    until = min((at for at in (touched, strayed) if at is not None), default=len(course.steps))
    told = _verdicts(course, limits, until)
    share = float(np.mean([verdict != "right" for _, verdict in told])) if told else 0.0
    if share < limits.share:
        told = _verdicts(course, limits, strayed) if strayed is not None else []
        if not told or told[-1][1] == "right" or not _points_at(course, told[-1][0], course.others[strayed or 0]):
            return None
    wrong = [verdict != "right" for _, verdict in told]
    if not any(wrong):
        return None
    start, stop = max(_runs(wrong), key=lambda run: (run[1] == len(wrong)) if share < limits.share else run[1] - run[0])
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


def _points_at(course: Course, at: int, names: Sequence[str]) -> bool:
    """Whether a view highlights one of some objects at one step."""
    return any(view.object in names for view in course.shown[at])


def _named(what: str | None) -> str:
    return "nothing" if what is None else "no object" if what == "" or what.startswith("nothing in ") else what


def _runs(flags: Sequence[bool]) -> list[tuple[int, int]]:
    """Start and stop of every unbroken run of True."""
    edges = np.flatnonzero(np.diff(np.array([False, *flags, False]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


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


def _failed_hand(course: Course, limits: Limits) -> Diagnosis:
    """Case 3, or the same of a method that prompts nothing: what became of the target, else who came in its way, else how near the hand came."""
    target, picking = course.target, course.rule != "selected"
    others = [name for name in course.moved_m if name != target]
    carried, lift = _carried(course, limits, target), course.lift_m[target]
    touched, strayed = _first(course.touches), _first([bool(names) for names in course.others])
    closest = int(np.argmin(course.gap_m))
    near = course.gap_m <= limits.near_m
    closing = _first((near & (course.grip < limits.closed)).tolist())

    def told(sub_case: str, at: int, sentence: str, **evidence: float | str) -> Diagnosis:
        known = {"gap_m": float(course.gap_m[at]), "closest_m": float(course.gap_m[closest]), "lift_m": float(lift.max())}
        case: Case = "case 3" if course.prompted else "unprompted"
        return Diagnosis(case, sub_case, course.steps[at], "", {**known, **evidence}, 1.0, f"{sentence} at step {course.steps[at]}")

    if True in carried:
        last = len(carried) - 1 - carried[::-1].index(True)
        if last == len(carried) - 1:
            return told("timeout", last, f"still holds {target}, {100 * lift[last]:.0f} cm up,")
        if course.rule != "picked" and course.grip[max(last - 1, 0) : last + 2].max() >= limits.closed:
            return told("misplacement", last, f"lets go of {target} in the wrong place", grip=float(course.grip[last]))
        return told("slip", last, f"loses {target} out of the hand", grip=float(course.grip[last]))
    taken = _earliest({name: _taken(course, limits, name) for name in others})
    if taken is not None and (touched is None or taken[0] <= touched):
        return told("wrong object", taken[0], f"takes {taken[1]} instead of {target}", object=taken[1])
    if strayed is not None and touched is None and not (picking and near.any()):
        name = course.others[strayed][0]
        return told("wrong object", strayed, f"touches {name} and comes no closer to {target} than {100 * course.gap_m[closest]:.0f} cm", object=name)
    knocked = _earliest({name: _first((course.moved_m[name] >= limits.moved_m).tolist()) for name in others})
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
    met = _first([name in names for names in course.others])
    if met is None or course.grip[max(met - 1, 0)] < limits.closed:
        return None
    return next((start for start, stop in _runs(_carried(course, limits, name)) if stop - start >= HELD_STEPS["picked"]), None)


def _earliest(at: Mapping[str, int | None]) -> tuple[int, str] | None:
    """Who was first, and when."""
    return min(((i, name) for name, i in at.items() if i is not None), default=None)


STAGES = ("proposed", "voted", "masked", "tracked", "touched", "lifted", "success")
"""The road of one episode. The first four are of prompts, and None for a method that highlights nothing."""


def stages(episode: Episode, limits: Limits = LIMITS) -> dict[str, Any]:
    """How far an episode came, as `stage_<name>` for STAGES, and `mask_iou` (t = 0, mean over the views that count), `track_right` (share of steps).

    At t = 0 in every view that counts: a box fits, the vote is right, the mask is on target; tracked: right in 9 of 10 steps up to the touch;
    then, by the hand: the target touched; carried or selected; success.
    """
    told: dict[str, Any] = {f"stage_{name}": None for name in STAGES} | {"mask_iou": None, "track_right": None}
    if not episode.frames or episode.outcome.status == "error" or not episode.frames[0].truth.objects_world:
        return told
    course = follow(episode)
    first = [view for view in course.shown[0] if view.pixels >= limits.pixels]
    if course.prompted and first:
        touched = _first(course.touches)
        verdicts = [verdict == "right" for _, verdict in _verdicts(course, limits, len(course.steps) if touched is None else touched)]
        right = float(np.mean(verdicts)) if verdicts else 0.0
        told |= {
            "stage_proposed": all(view.proposal >= limits.proposal for view in first),
            "stage_voted": all(view.object == course.target for view in first),
            "stage_masked": all(view.iou >= limits.iou for view in first),
            "stage_tracked": right >= TRACKED,
            "mask_iou": float(np.mean([view.iou for view in first])),
            "track_right": right,
        }
    lifted = episode.outcome.success_once if course.rule == "selected" else True in _carried(course, limits, course.target)
    return {**told, "stage_touched": any(course.touches), "stage_lifted": lifted, "stage_success": episode.outcome.success}


TRACKED = 0.9
"""Share of judged steps in which the prompts are right, from which on the track counts as held."""
