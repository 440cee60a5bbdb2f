"""Tracking through whole expert episodes, against the simulator: is the same object followed to the end, how well, and what hiding it costs.

    for job in plan():
        lines += follow(job, stack)

Every object of the target's category that shows at t = 0 is followed, in every camera, from the mask that the segmenter draws from its true
box: the tracker alone is judged. A line is one object in one camera, once undisturbed through the whole episode (`hidden` 0), and once for
each number of frames for which an occluder hides the target (vap_core.simulation.occluder), from the moment it is hidden to the end. A frame
counts for an object when it shows at least LEAST_PX pixels.
"""

import copy
import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool

from vap_core.base.types import Boxes, Mask, Rgb, Track, value
from vap_core.evaluation.perception.first_frames import LEAST_PX
from vap_core.perception.boxes import mask_box, mask_iou
from vap_core.perception.protocols import Stack
from vap_core.policies.scripted.expert import Expert
from vap_core.rollout.expert_loop import expert_steps
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.env import Env
from vap_core.simulation.occluder import Occlusion
from vap_core.simulation.scenes import Scene
from vap_core.simulation.suites.open_row import build_scene, make_env
from vap_core.simulation.types import EpisodeRow

KEPT = 0.5
"""IoU above which a track is on its object."""
MOST_HIDDEN = 6
BINS = 20
"""Points of the IoU over normalised time."""
EPISODES = {"simpler-fractal": 8, "simpler-bridge": 5, "vlabench": 2, "tabletop": 1}
"""Episodes a task in the default plan; suites with three cameras need fewer."""
AFTER = 40
"""Frames that are followed after the target is shown again; an undisturbed episode is followed to its end."""
ALL_HIDDEN = 1
"""Episodes a task of the default plan that are hidden for every number of frames; the others for 3 only. One camera counts as a third."""
Line = dict[str, Any]
Frame = Mapping[str, tuple[Rgb, Mapping[str, Mask]]]
"""Per camera the picture and every object's visible pixels."""


@value
class Job:
    """One episode. The tracker sees every `every`-th control step; `hidden` are the numbers of such frames for which the target is hidden."""

    row: EpisodeRow
    every: int
    hidden: tuple[int, ...]
    kind: Literal["plate", "arm"] = "plate"


@value
class Film:
    """An episode as its cameras saw it, and the frames `start` .. of the same moments with the target hidden."""

    frames: tuple[Frame, ...]
    start: int
    covered: tuple[Frame, ...]


def plan(
    episodes: Mapping[str, int] | None = None, suite_names: Sequence[str] | None = None
) -> list[Job]:
    """The default survey: every task of the benchmarks (or of `suite_names`), `episodes` of each by suite, spread evenly over its list."""
    count = {**EPISODES, **(episodes or {})}
    jobs = []
    for suite in (
        suites.BENCHMARKS.values() if suite_names is None else map(suites.suite, suite_names)
    ):
        for task in suite.tasks:
            for i, row in enumerate(suites.rows(suite.name, task.name, count[suite.name])):
                whole = i < ALL_HIDDEN * 3 // len(suite.cameras)
                jobs.append(
                    Job(
                        row,
                        every(row),
                        tuple(range(1, MOST_HIDDEN + 1)) if whole else (3,),
                        "arm" if i % 4 == 3 else "plate",
                    )
                )
    return jobs


def every(row: EpisodeRow) -> int:
    """Control steps from one tracked frame to the next: 2 for the long put tasks on the tabletop, at 30 a second, else each one."""
    return 2 if suites.suite(row.suite).hz >= 30 and row.rule == "put" else 1


def follow(job: Job, stack: Stack) -> list[Line]:
    """Run the episode's expert, track, and compare. The same job gives the same lines but for their times."""
    models = [place.model for place in job.row.placements]
    with build_scene(job.row.suite, models, job.row.variant) as scene:
        film = shoot(job, scene)
    return follow_film(film, job, stack)


def shoot(job: Job, scene: Scene, size: int = 224) -> Film:
    """The expert's episode, to its end, in pictures and masks; hidden from a moment that the episode's number decides."""
    row, expert = job.row, Expert()
    env = make_env(scene, row.suite, image_size=size, cameras=row.cameras)
    env.reset(row)
    state = expert.start(np.random.default_rng([row.seed, row.episode]))
    frames, moments = [], []
    for judge, action in expert_steps(env, row, expert, state):
        if judge.steps % job.every == 0 or action is None:
            frames.append(_seen(env))
            moments.append(env.snapshot())
    start = round(len(frames) * float(np.random.default_rng([13, row.episode]).uniform(0.2, 0.45)))
    occlusion = Occlusion(0, row.max_steps + 1, job.kind)
    screened = make_env(scene, row.suite, image_size=size, cameras=row.cameras, occlusion=occlusion)
    covered = []
    for moment in moments[start : start + max(job.hidden, default=0)]:
        screened.restore(moment)
        covered.append(_seen(screened))
    return Film(tuple(frames), start, tuple(covered))


def follow_film(film: Film, job: Job, stack: Stack) -> list[Line]:
    """Track every same-category object that shows in the first frame, once undisturbed and once for each number of hidden frames."""
    named: dict[str, tuple[str, ...]] = {}
    for camera, (rgb, masks) in film.frames[0].items():
        showing = tuple(
            name
            for name, mask in masks.items()
            if get_object(name).category == job.row.category and _shows(mask, rgb)
        )
        if showing:
            named[camera] = showing
    if not named:
        return []
    images = [film.frames[0][camera][0] for camera in named]
    begun = [
        _first_masks(rgb, film.frames[0][camera][1], names, stack)
        for rgb, (camera, names) in zip(images, named.items(), strict=True)
    ]
    states = stack.tracker.start(images, begun)
    lines: list[Line] = []
    forked: list[Any] = []
    found: list[list[tuple[Track, ...]]] = []
    took: list[float] = []
    for t, frame in enumerate(film.frames[1:], start=1):
        if t == film.start and job.hidden:
            forked = [copy.deepcopy(states) for _ in job.hidden]
        states, tracks, ms = _step(stack, states, frame, named)
        found.append(tracks)
        took.append(ms)
    lines += _lines(job, named, film.frames[1:], found, took, 0)
    for n, after in zip(job.hidden, forked, strict=False):
        if film.start + n >= len(film.frames):
            continue  # the episode was over before the target was shown again
        shown = (*film.covered[:n], *film.frames[film.start + n : film.start + n + AFTER])
        found, took = [], []
        for frame in shown:
            after, tracks, ms = _step(stack, after, frame, named)
            found.append(tracks)
            took.append(ms)
        lines += _lines(job, named, shown, found, took, n)
    return lines


def _lines(
    job: Job,
    named: Mapping[str, Sequence[str]],
    frames: Sequence[Frame],
    found: Sequence[Sequence[tuple[Track, ...]]],
    took: Sequence[float],
    n: int,
) -> list[Line]:
    """One line per object and camera."""
    row = job.row
    lines = []
    for v, (camera, names) in enumerate(named.items()):
        for i, name in enumerate(names):
            scores = _compare(
                [frame[camera] for frame in frames], name, [tracks[v][i] for tracks in found], n
            )
            lines.append(
                {
                    "suite": row.suite, "task": row.task, "episode": row.episode, "variant": row.variant, "camera": camera, "object": name,
                    "target": name == row.target, "hidden": n, "kind": job.kind if n else "", "every": job.every, **scores,
                    "step_ms": float(np.median(took)), "objects": len(names), "frames": len(frames),
                }
            )  # fmt: skip
    return lines


def _compare(
    frames: Sequence[tuple[Rgb, Mapping[str, Mask]]],
    name: str,
    tracks: Sequence[Track],
    hidden: int,
) -> Line:
    """What became of one track: `mean_iou` and `kept` (IoU > KEPT in the last frame that shows the object) are None when none shows it.

    `lost` counts frames that show the object and have no track, `wrong` those whose track lies on less than a tenth of it; `back_after` how
    many of the frames that show the object, once the first `hidden` are over, pass before the track is on it again (None: never).
    """
    shown, overlap, false_px, lost, wrong = [], [], [], 0, 0
    for (rgb, masks), track in zip(frames, tracks, strict=True):
        true = masks[name]
        mask = np.zeros_like(true) if track.mask is None else track.mask
        counts = _shows(true, rgb)
        shown.append(counts)
        overlap.append(mask_iou(mask, true) if counts else np.nan)
        if not true.any():
            false_px.append(int(mask.sum()))
        lost += counts and track.mask is None
        wrong += counts and track.mask is not None and overlap[-1] < 0.1
    seen, of = np.array(shown), np.array(overlap)
    again = np.flatnonzero(of[hidden:][seen[hidden:]] > KEPT)
    return {
        "shown": int(seen.sum()),
        "mean_iou": float(of[seen].mean()) if seen.any() else None,
        "kept": bool(of[seen][-1] > KEPT) if seen.any() else None,
        "lost": int(lost),
        "wrong": int(wrong),
        "gone": len(false_px),
        "false_px": float(np.mean(false_px)) if false_px else None,
        "back_after": int(again[0]) if len(again) else None,
        "iou_over_time": [
            None if np.isnan(x) else float(x)
            for x in of[np.linspace(0, len(of) - 1, BINS).round().astype(int)]
        ],
    }


def _step(
    stack: Stack, states: list[Any], frame: Frame, cameras: Mapping[str, Sequence[str]]
) -> tuple[list[Any], list[tuple[Track, ...]], float]:
    """One frame of every camera, and the milliseconds a view took."""
    images = [frame[camera][0] for camera in cameras]
    start = time.perf_counter()
    states, tracks = stack.tracker.step(states, images)
    return states, tracks, 1e3 * (time.perf_counter() - start) / len(images)


def _first_masks(
    rgb: Rgb, masks: Mapping[str, Mask], names: Sequence[str], stack: Stack
) -> Bool[np.ndarray, "n h w"]:
    boxes = np.stack([box for name in names if (box := mask_box(masks[name])) is not None])
    return stack.segmenter(rgb, Boxes(boxes, np.ones(len(boxes), np.float32), "object"))


def _shows(mask: Mask, rgb: Rgb) -> bool:
    return bool(mask.sum() >= LEAST_PX * rgb.shape[0] * rgb.shape[1] / 224**2)


def _seen(env: Env) -> Frame:
    images, masks = env.observe().images, env.truth(masks=True).masks
    return {camera: (rgb, masks[camera]) for camera, rgb in images.items()}
