"""Tracking through whole expert episodes, against the simulator.

It says whether the same object is tracked to the end, how well, and what hiding it costs.

    for job in plan():
        rows += track_episode(job, stack)

Every object of the target's category that shows at t = 0 is tracked, in every camera, from the mask
that the segmenter draws from its true box: the tracker alone is judged. A tracker that can follow a
target alone follows each of them by itself, with the others as evidence, as the method does. A row
is one object in one
camera, once undisturbed through the whole episode (`hidden` 0), and once for each number of frames
for which an occluder hides the target (vap_core.simulation.occluder), from the moment it is hidden
to the end. A frame counts for an object when it shows at least VISIBLE_PX pixels.
"""

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any, Literal

import numpy as np

from vap_core.attend import Attender
from vap_core.base.types import Boxes, Mask, Rgb, Track, value
from vap_core.perception.boxes import mask_box, mask_iou
from vap_core.perception.protocols import Stack, TargetTracker
from vap_core.policies.protocol import PolicyInput
from vap_core.policies.scripted.expert import Expert
from vap_core.rollout.running import expert_steps
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.env import Env
from vap_core.simulation.occluder import Occlusion
from vap_core.simulation.scenes import Scene
from vap_core.simulation.suites.open_row import build_scene, cameras_of, make_env
from vap_core.simulation.types import EpisodeRow
from vap_core.study.perception import USUAL_K, VISIBLE_PX, TableRow, registered_object
from vap_core.study.trials import scripted

KEPT = 0.5
"""IoU above which a track is on its object."""
WRONG = 0.1
"""IoU below which a track is on something else."""
HIDDEN = 3
"""Frames for which the target is hidden in the measures of identity."""
MOST_HIDDEN = 6
BINS = 20
"""Points of the IoU over normalised time."""
EPISODES = {"simpler-fractal": 8, "simpler-bridge": 5, "vlabench": 2, "tabletop": 1}
"""Episodes a task in the default plan; suites with three cameras need fewer."""
AFTER = 40
"""Frames that are tracked after the target is shown again.

An undisturbed episode is tracked to its end.
"""
ALL_HIDDEN = 1
"""Episodes a task of the default plan that are hidden for every number of frames.

The others are hidden for 3 only. One camera counts as a third.
"""
Frame = Mapping[str, tuple[Rgb, Mapping[str, Mask]]]
"""Per camera the picture and every object's visible pixels."""


@value
class Job:
    """One episode to track.

    The tracker sees every `every`-th control step; `hidden` are the numbers of such frames for
    which the target is hidden.
    """

    row: EpisodeRow
    every: int
    hidden: tuple[int, ...]
    kind: Literal["plate", "arm"] = "plate"


@value
class Film:
    """An episode as its cameras saw it.

    `covered` are the frames `start` .. of the same moments with the target hidden.
    """

    frames: tuple[Frame, ...]
    start: int
    covered: tuple[Frame, ...]


def plan(
    episodes: Mapping[str, int] | None = None, suite_names: Sequence[str] | None = None
) -> list[Job]:
    """The default survey: every task of the benchmarks, or of `suite_names`.

    `episodes` overrides how many of each task's list, spread evenly over it, by suite.

    Raises: UnknownName for a suite that no registry holds; BadSuite for a damaged list.
    """
    count = {**EPISODES, **(episodes or {})}
    jobs = []
    for name in suites.BENCHMARKS if suite_names is None else suite_names:
        suite = suites.suite(name)
        n_all_hidden = ALL_HIDDEN * 3 // len(suite.cameras)
        for task in suite.tasks:
            for i, row in enumerate(suites.rows(suite.name, task.name, count[suite.name])):
                hidden = tuple(range(1, MOST_HIDDEN + 1)) if i < n_all_hidden else (HIDDEN,)
                kind: Literal["plate", "arm"] = "arm" if i % 4 == 3 else "plate"
                jobs.append(Job(row=row, every=steps_per_frame(row), hidden=hidden, kind=kind))
    return jobs


def steps_per_frame(row: EpisodeRow) -> int:
    """Control steps from one tracked frame to the next.

    Two for the long put tasks on the tabletop, at 30 a second, else one.

    Raises: UnknownName for a suite that no registry holds.
    """
    return 2 if suites.suite(row.suite).hz >= 30 and row.rule == "put" else 1


def track_episode(job: Job, stack: Stack) -> list[TableRow]:
    """Run the episode's expert, track, and compare.

    The same job gives the same rows but for their times.

    Raises: UnknownName for a suite or an object that no registry holds; OutOfReach, as
        `record_film`.
    """
    models = [place.model for place in job.row.placements]
    with build_scene(job.row.suite, models, job.row.variant) as scene:
        film = record_film(job, scene)
    return track_film(film, job, stack)


def record_film(job: Job, scene: Scene) -> Film:
    """The expert's episode, to its end, in pictures and masks.

    The target is hidden from a moment that the episode's number decides.

    Raises: OutOfReach when the expert cannot reach the target or its goal; UnknownName when the row
        places an object that the scene lacks.
    """
    row = job.row
    expert = Expert()
    env = make_env(scene, row.suite, cameras=cameras_of(row))
    env.reset(row)
    state = expert.start(np.random.default_rng([row.seed, row.episode]))
    frames = []
    moments = []
    for judge, action in expert_steps(env=env, row=row, expert=expert, state=state):
        if judge.steps % job.every == 0 or action is None:
            frames.append(_take_frame(env))
            moments.append(env.snapshot())
    fraction = float(np.random.default_rng([13, row.episode]).uniform(0.2, 0.45))
    start = round(len(frames) * fraction)
    occlusion = Occlusion(0, row.max_steps + 1, job.kind)
    screened = make_env(scene, row.suite, cameras=cameras_of(row), occlusion=occlusion)
    covered = []
    for moment in moments[start : start + max(job.hidden, default=0)]:
        screened.restore(moment)
        covered.append(_take_frame(screened))
    return Film(tuple(frames), start, tuple(covered))


def track_film(film: Film, job: Job, stack: Stack) -> list[TableRow]:
    """Track every object of the target's category that shows in the first frame.

    Once undisturbed and once for each number of hidden frames.
    """
    names = _shown_objects(film.frames[0], job.row.category)
    if not names:
        return []
    states = _start_tracker(film.frames[0], names, stack)
    before: list[Any] = []
    undisturbed = _TrackerRun(stack, names, job, hidden=0)
    for t, frame in enumerate(film.frames[1:], start=1):
        if t == film.start and job.hidden:
            before = copy.deepcopy(states)
        states = undisturbed.add(states, frame)
    rows = undisturbed.rows()
    for n in job.hidden if before else ():
        shown_again = film.frames[film.start + n :][:AFTER]
        if shown_again:  # else the episode was over before
            disturbed, states = _TrackerRun(stack, names, job, hidden=n), copy.deepcopy(before)
            for frame in (*film.covered[:n], *shown_again):
                states = disturbed.add(states, frame)
            rows += disturbed.rows()
    return rows


@dataclass
class _TrackerRun:
    """The tracks of one run of the tracker, frame by frame.

    `names` are the tracked objects of each camera; the target is hidden in the first `hidden`
    frames. `tracks` are by camera and the object's place.
    """

    stack: Stack
    names: Mapping[str, Sequence[str]]
    job: Job
    hidden: int
    frames: list[Frame] = field(default_factory=list)
    tracks: list[dict[tuple[str, int], Track]] = field(default_factory=list)
    times_ms: list[float] = field(default_factory=list)

    def add(self, states: list[Any], frame: Frame) -> list[Any]:
        """Track the next frame of every camera, and return the tracker's states after it."""
        followed = _followed(self.names, self.stack)
        images = [frame[camera][0] for camera, _ in followed]
        start = time.perf_counter()
        states, tracks = self.stack.tracker.step(states, images)
        self.times_ms.append(1e3 * (time.perf_counter() - start) / len(images))
        by_state = zip(followed, tracks, strict=True)
        self.tracks.append({(camera, i): of[i] for (camera, rows), of in by_state for i in rows})
        self.frames.append(frame)
        return states

    def rows(self) -> list[TableRow]:
        """One row per camera and object."""
        episode = self.job.row
        rows: list[TableRow] = []
        for camera, names in self.names.items():
            views = [frame[camera] for frame in self.frames]
            for i, name in enumerate(names):
                tracks = [of_frame[camera, i] for of_frame in self.tracks]
                row = {
                    "suite": episode.suite,
                    "task": episode.task,
                    "episode": episode.episode,
                    "variant": episode.variant,
                    "camera": camera,
                    "object": name,
                    "target": name == episode.target,
                    "hidden": self.hidden,
                    "kind": self.job.kind if self.hidden else "",
                    "every": self.job.every,
                    **_compare_track(views, name, tracks, self.hidden),
                    "step_ms": float(np.median(self.times_ms)),
                    "objects": len(names),
                    "frames": len(self.frames),
                }
                rows.append(row)
        return rows


def _shown_objects(frame: Frame, category: str) -> dict[str, tuple[str, ...]]:
    """The objects of a category that a frame shows, by camera; cameras without any are left out."""
    shown = {
        camera: tuple(
            name
            for name, mask in masks.items()
            if get_object(name).category == category and _counts(mask, rgb)
        )
        for camera, (rgb, masks) in frame.items()
    }
    return {camera: names for camera, names in shown.items() if names}


def _start_tracker(frame: Frame, names: Mapping[str, Sequence[str]], stack: Stack) -> list[Any]:
    """The tracker's states of `_followed`, from the masks that the segmenter draws from true
    boxes."""
    by_camera = {}
    for camera, tracked in names.items():
        rgb, masks = frame[camera]
        boxes = [box for name in tracked if (box := mask_box(masks[name])) is not None]
        scores = np.ones(len(boxes), np.float32)
        by_camera[camera] = stack.segmenter(rgb, Boxes(np.stack(boxes), scores, "object"))
    followed = _followed(names, stack)
    images = [frame[camera][0] for camera, _ in followed]
    first_masks = [by_camera[camera] for camera, _ in followed]
    tracker = stack.tracker
    if isinstance(tracker, TargetTracker):
        return tracker.start_targets(images, first_masks, [rows for _, rows in followed])
    return tracker.start(images, first_masks)


def _followed(names: Mapping[str, Sequence[str]], stack: Stack) -> list[tuple[str, list[int]]]:
    """The camera of every state of the tracker, and the objects that it follows, by their place.

    Where the tracker can, each object is followed by itself.
    """
    alone = isinstance(stack.tracker, TargetTracker)
    return [
        (camera, rows)
        for camera, tracked in names.items()
        for rows in ([[i] for i in range(len(tracked))] if alone else [[*range(len(tracked))]])
    ]


def _compare_track(
    views: Sequence[tuple[Rgb, Mapping[str, Mask]]],
    name: str,
    tracks: Sequence[Track],
    hidden: int,
) -> TableRow:
    """What became of one track.

    `mean_iou` and `kept` (IoU > KEPT in the last frame that shows the object) are None when none
    shows it. `lost` counts frames that show the object and have no track, `wrong` those whose track
    has an IoU below WRONG; `back_after` how many of the frames that show the object, once the first
    `hidden` are over, pass before the track is on it again (None: never). `gone` counts the frames
    in which nothing of the object shows, and `false_px` is the mean size of the track in them.
    `iou_over_time` is the IoU at BINS points of normalised time; None in frames that do not show
    the object.
    """
    shown = np.array([_counts(masks[name], rgb) for rgb, masks in views], bool)
    iou = np.full(len(views), np.nan)
    false_px = []
    for t, ((_, masks), track) in enumerate(zip(views, tracks, strict=True)):
        true = masks[name]
        mask = np.zeros_like(true) if track.mask is None else track.mask
        if not true.any():
            false_px.append(int(mask.sum()))
        if shown[t]:
            iou[t] = mask_iou(mask, true)
    there = np.array([track.mask is not None for track in tracks], bool)
    again = np.flatnonzero(iou[hidden:][shown[hidden:]] > KEPT)
    points = np.linspace(0, len(iou) - 1, BINS).round().astype(int)
    return {
        "shown": int(shown.sum()),
        "mean_iou": float(iou[shown].mean()) if shown.any() else None,
        "kept": bool(iou[shown][-1] > KEPT) if shown.any() else None,
        "lost": int((shown & ~there).sum()),
        "wrong": int((there & (iou < WRONG)).sum()),
        "gone": len(false_px),
        "false_px": float(np.mean(false_px)) if false_px else None,
        "back_after": int(again[0]) if len(again) else None,
        "iou_over_time": [None if np.isnan(each) else float(each) for each in iou[points]],
    }


def _counts(mask: Mask, rgb: Rgb) -> bool:
    """Whether a view shows at least VISIBLE_PX of an object, for a view of 224 x 224."""
    return bool(mask.sum() >= VISIBLE_PX * rgb.shape[0] * rgb.shape[1] / 224**2)


def _take_frame(env: Env) -> Frame:
    """What every camera of an environment shows now."""
    images = env.observe().images
    masks = env.truth(masks=True).masks
    return {camera: (rgb, masks[camera]) for camera, rgb in images.items()}


SUITE = "simpler-bridge"
TASK = "pick-shaver"
Work = Callable[[], object]
START = "start-up grounding"
STEP = "track step"
PASS = "encoder pass"
POLICY = "scripted policy's plan"
LIMITS_MS = {START: 300.0, STEP: 45.0}


def measure(stack: Stack, repeat: int = 25) -> list[TableRow]:
    """A row per piece of work: its median, its quartiles, and how many rounds.

    A step of the scripted policy (a 224 px view of its own) and a pass of the backbone are there to
    compare with.
    """
    import torch

    models = [place.model for place in suites.rows(SUITE, TASK, 1)[0].placements]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with build_scene(SUITE, models) as scene:
            times_ms = _time_in_turn(_works(stack, scene), repeat)
    finally:
        torch.set_num_threads(threads)
    rows: list[TableRow] = []
    for name, of_work_ms in times_ms.items():
        low, middle, high = np.percentile(of_work_ms, [25, 50, 75]).tolist()
        row = {"what": name, "ms": middle, "low_ms": low, "high_ms": high, "rounds": repeat}
        rows.append(row)
    return rows


def _time_in_turn(works: Mapping[str, Work], repeat: int) -> dict[str, list[float]]:
    """Milliseconds of every piece of work in each round, after one round to warm up."""
    times_ms: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeat + 1):
        for name, work in works.items():
            start = time.perf_counter()
            work()
            times_ms[name].append(1e3 * (time.perf_counter() - start))
    return {name: of_work[1:] for name, of_work in times_ms.items()}


def _works(stack: Stack, scene: Scene) -> dict[str, Work]:
    """The work that is always timed, by its name."""
    row = suites.rows(SUITE, TASK, 1)[0]
    film = record_film(Job(row=row, every=1, hidden=(), kind="plate"), scene).frames
    env = Env(scene)
    policy = scripted(stack.category_detector, scene, suites.suite(SUITE))
    env.reset(row)
    observation = env.observe()
    camera = env.camera_names[0]
    views = {camera: observation.images[camera]}
    personal, _ = registered_object(stack, row.target, USUAL_K)
    attender = Attender(stack, {row.target: personal})
    rgb, masks = film[0][camera]
    states, turn = stack.tracker.start([rgb], [np.stack(list(masks.values()))]), count(1)
    state = policy.start(np.random.default_rng(0))

    def track() -> None:
        """The next frame of the film, which begins again at its end."""
        nonlocal states
        states, _ = stack.tracker.step(states, [film[next(turn) % len(film)][camera][0]])

    def plan() -> object:
        policy_input = PolicyInput(observation.images, row.instruction, observation.state)
        return policy.plan([state], [policy_input])

    return {
        START: lambda: attender.start(views, row.instruction),
        STEP: track,
        PASS: lambda: stack.encoder([views[camera]]),
        POLICY: plan,
    }
