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
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float64

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
Tracks = list[tuple[Track, ...]]
"""The tracks of one frame: a tuple per camera, a track per object."""


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
    if suite_names is None:
        suite_names = list(suites.BENCHMARKS)
    jobs = []
    for name in suite_names:
        suite = suites.suite(name)
        n_all_hidden = ALL_HIDDEN * 3 // len(suite.cameras)
        for task in suite.tasks:
            rows = suites.rows(suite.name, task.name, count[suite.name])
            for i, row in enumerate(rows):
                hidden: tuple[int, ...] = (HIDDEN,)
                if i < n_all_hidden:
                    hidden = tuple(range(1, MOST_HIDDEN + 1))
                kind: Literal["plate", "arm"] = "arm" if i % 4 == 3 else "plate"
                job = Job(row=row, every=steps_per_frame(row), hidden=hidden, kind=kind)
                jobs.append(job)
    return jobs


def steps_per_frame(row: EpisodeRow) -> int:
    """Control steps from one tracked frame to the next.

    Two for the long put tasks on the tabletop, at 30 a second, else one.

    Raises: UnknownName for a suite that no registry holds.
    """
    if suites.suite(row.suite).hz >= 30 and row.rule == "put":
        return 2
    return 1


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
    states_before: list[Any] | None = None
    undisturbed = _TrackerRun(stack, names, job, hidden=0)
    for t, frame in enumerate(film.frames[1:], start=1):
        if t == film.start and job.hidden:
            states_before = copy.deepcopy(states)
        states = undisturbed.add(states, frame)
    rows = undisturbed.rows()
    if states_before is None:
        return rows
    for n in job.hidden:
        if film.start + n >= len(film.frames):
            continue  # the episode was over before the target was shown again
        disturbed = _TrackerRun(stack, names, job, hidden=n)
        states = copy.deepcopy(states_before)
        shown_again = film.frames[film.start + n : film.start + n + AFTER]
        for frame in (*film.covered[:n], *shown_again):
            states = disturbed.add(states, frame)
        rows += disturbed.rows()
    return rows


class _TrackerRun:
    """The tracks of one run of the tracker, frame by frame.

    `names` are the tracked objects of each camera; the target is hidden in the first `hidden`
    frames.
    """

    def __init__(
        self, stack: Stack, names: Mapping[str, Sequence[str]], job: Job, *, hidden: int
    ) -> None:
        self.stack = stack
        self.names = names
        self.job = job
        self.hidden = hidden
        self.frames: list[Frame] = []
        self.tracks: list[Tracks] = []
        self.times_ms: list[float] = []

    def add(self, states: list[Any], frame: Frame) -> list[Any]:
        """Track the next frame of every camera, and return the tracker's states after it."""
        followed = _followed(self.names, self.stack)
        images = [frame[camera][0] for camera, _ in followed]
        start = time.perf_counter()
        states, tracks = self.stack.tracker.step(states, images)
        took_ms = 1e3 * (time.perf_counter() - start)
        by_camera: dict[str, dict[int, Track]] = {camera: {} for camera in self.names}
        for (camera, rows), of_state in zip(followed, tracks, strict=True):
            for i in rows:
                by_camera[camera][i] = of_state[i]
        self.frames.append(frame)
        self.tracks.append(
            [tuple(by_row[i] for i in sorted(by_row)) for by_row in by_camera.values()]
        )
        self.times_ms.append(took_ms / len(images))
        return states

    def rows(self) -> list[TableRow]:
        """One row per camera and object."""
        rows = []
        for v, (camera, names) in enumerate(self.names.items()):
            views = [frame[camera] for frame in self.frames]
            for i, name in enumerate(names):
                tracks = [of_frame[v][i] for of_frame in self.tracks]
                scores = _compare_track(views=views, name=name, tracks=tracks, hidden=self.hidden)
                rows.append(self._row(camera, name, scores))
        return rows

    def _row(self, camera: str, name: str, scores: TableRow) -> TableRow:
        episode = self.job.row
        return {
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
            **scores,
            "step_ms": float(np.median(self.times_ms)),
            "objects": len(self.names[camera]),
            "frames": len(self.frames),
        }


def _shown_objects(frame: Frame, category: str) -> dict[str, tuple[str, ...]]:
    """The objects of a category that a frame shows, by camera; cameras without any are left out."""
    shown = {}
    for camera, (rgb, masks) in frame.items():
        names = []
        for name, mask in masks.items():
            if get_object(name).category == category and _counts(mask, rgb):
                names.append(name)
        if names:
            shown[camera] = tuple(names)
    return shown


def _start_tracker(frame: Frame, names: Mapping[str, Sequence[str]], stack: Stack) -> list[Any]:
    """The tracker's states of `_followed`, from true boxes."""
    by_camera = {}
    for camera, tracked in names.items():
        rgb, masks = frame[camera]
        by_camera[camera] = _first_masks(rgb=rgb, masks=masks, names=tracked, stack=stack)
    images = []
    first_masks = []
    targets = []
    for camera, rows in _followed(names, stack):
        images.append(frame[camera][0])
        first_masks.append(by_camera[camera])
        targets.append(rows)
    tracker = stack.tracker
    if isinstance(tracker, TargetTracker):
        return tracker.start_targets(images, first_masks, targets)
    return tracker.start(images, first_masks)


def _followed(names: Mapping[str, Sequence[str]], stack: Stack) -> list[tuple[str, list[int]]]:
    """The camera of every state of the tracker, and the objects that it follows, by their place.

    Where the tracker can, each object is followed by itself.
    """
    followed = []
    for camera, tracked in names.items():
        rows = list(range(len(tracked)))
        if isinstance(stack.tracker, TargetTracker):
            followed += [(camera, [row]) for row in rows]
        else:
            followed.append((camera, rows))
    return followed


def _first_masks(
    *, rgb: Rgb, masks: Mapping[str, Mask], names: Iterable[str], stack: Stack
) -> Bool[np.ndarray, "n h w"]:
    """The masks that the segmenter draws from the true boxes of objects."""
    boxes = []
    for name in names:
        box = mask_box(masks[name])
        if box is not None:
            boxes.append(box)
    scores = np.ones(len(boxes), np.float32)
    true_boxes = Boxes(np.stack(boxes), scores, "object")
    return stack.segmenter(rgb, true_boxes)


def _compare_track(
    *,
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
    """
    shown = np.zeros(len(views), bool)
    iou = np.full(len(views), np.nan)
    false_px = []
    n_lost = 0
    n_wrong = 0
    for t, ((rgb, masks), track) in enumerate(zip(views, tracks, strict=True)):
        true = masks[name]
        mask = np.zeros_like(true) if track.mask is None else track.mask
        if not true.any():
            n_px = int(mask.sum())
            false_px.append(n_px)
        if _counts(true, rgb):
            shown[t] = True
            iou[t] = mask_iou(mask, true)
            n_lost += track.mask is None
            n_wrong += track.mask is not None and iou[t] < WRONG
    shown_iou = iou[shown]
    again = np.flatnonzero(iou[hidden:][shown[hidden:]] > KEPT)
    return {
        "shown": int(shown.sum()),
        "mean_iou": float(shown_iou.mean()) if len(shown_iou) else None,
        "kept": bool(shown_iou[-1] > KEPT) if len(shown_iou) else None,
        "lost": n_lost,
        "wrong": int(n_wrong),
        "gone": len(false_px),
        "false_px": float(np.mean(false_px)) if false_px else None,
        "back_after": int(again[0]) if len(again) else None,
        "iou_over_time": _sample_over_time(iou),
    }


def _sample_over_time(iou: Float64[np.ndarray, " t"]) -> list[float | None]:
    """The IoU at BINS points of normalised time; None in frames that do not show the object."""
    points = np.linspace(0, len(iou) - 1, BINS)
    samples: list[float | None] = []
    for sample in iou[points.round().astype(int)]:
        samples.append(None if np.isnan(sample) else float(sample))
    return samples


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

    row = suites.rows(SUITE, TASK, 1)[0]
    models = [place.model for place in row.placements]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with build_scene(SUITE, models) as scene:
            times_ms = _time_in_turn(_works(stack, scene), repeat)
    finally:
        torch.set_num_threads(threads)
    rows = []
    for name, of_work_ms in times_ms.items():
        low, middle, high = np.percentile(of_work_ms, [25, 50, 75])
        row_of_work: TableRow = {
            "what": name,
            "ms": float(middle),
            "low_ms": float(low),
            "high_ms": float(high),
            "rounds": repeat,
        }
        rows.append(row_of_work)
    return rows


def _time_in_turn(works: Mapping[str, Work], repeat: int) -> dict[str, list[float]]:
    """Milliseconds of every piece of work in each round, after one round to warm up."""
    times_ms: dict[str, list[float]] = {}
    for name, work in works.items():
        work()
        times_ms[name] = []
    for _ in range(repeat):
        for name, work in works.items():
            start = time.perf_counter()
            work()
            times_ms[name].append(1e3 * (time.perf_counter() - start))
    return times_ms


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
    track_step = _track_step(stack, film, camera)
    state = policy.start(np.random.default_rng(0))

    def plan() -> object:
        policy_input = PolicyInput(observation.images, row.instruction, observation.state)
        return policy.plan([state], [policy_input])

    return {
        START: lambda: attender.start(views, row.instruction),
        STEP: track_step,
        PASS: lambda: stack.encoder([views[camera]]),
        POLICY: plan,
    }


def _track_step(stack: Stack, film: Sequence[Frame], camera: str) -> Work:
    """A step of the tracker on the next frame of a film, which begins again at its end."""
    rgb, masks = film[0][camera]
    all_masks = list(masks.values())
    states = stack.tracker.start([rgb], [np.stack(all_masks)])
    t = 0

    def step() -> None:
        nonlocal states, t
        t = (t + 1) % len(film)
        states, _ = stack.tracker.step(states, [film[t][camera][0]])

    return step
