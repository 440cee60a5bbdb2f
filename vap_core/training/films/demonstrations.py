"""Demonstrations of the scripted expert with generic objects: what a frozen policy has learned from before it meets a user (P 5.1).

A stage is one compiled scene of one task: some generic objects of its category, seen in `EPISODES` episodes from new places. Stages are numbered;
the same suite, seed and number give the same films. Personal objects and their look-alikes never appear (`only_generic` refuses them).
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from vap_core.base.errors import OutOfReach
from vap_core.base.files import write_atomic
from vap_core.base.types import Mask, Rgb, value
from vap_core.policies.scripted.expert import Expert, ExpertState
from vap_core.rollout.expert_loop import expert_steps
from vap_core.simulation.assets import objects
from vap_core.simulation.env import Env
from vap_core.simulation.scenes import Scene
from vap_core.simulation.suites import VARIANTS, Suite, Task, simpler, suite, tabletop, vlabench
from vap_core.simulation.suites.layout import Area, Spot, place, radius_m, scatter, turned
from vap_core.simulation.suites.open_row import build_scene, make_env
from vap_core.simulation.types import EpisodeRow, Placement
from vap_core.training.films.scenes import HELD_OUT, TRAIN_INSTANCES, only_generic

SIDE, SEEN = 112, 224
"""Pixels of a film, and of the views that it is made of: a policy sees views of SEEN pixels scaled down to SIDE."""
EPISODES = 8
"""Episodes of one stage."""
JOLT, JOLT_M, JOLT_RAD = 0.15, 0.012, 0.2
"""Share of steps in which the hand is knocked off its way, so that recovering is shown, too; and how far, metres (deviation)."""
LOW_M = 0.05
"""A hand that begins so far below its highest point begins after a miss."""
EVERY = {"tabletop": 3}
"""Control steps from one picture to the next; elsewhere each has its own. At 30 Hz neighbours hardly differ, and pictures are what a film costs."""
MISSES = 0.5
"""Share of the grasping films that begin where a first grasp has missed: a policy that has not seen that presses on for ever."""
AREAS = {
    "simpler-fractal": simpler.DESK,
    "simpler-bridge": Area(0.18, 0.35, -0.095, 0.095),
    "vlabench": vlabench.TABLE,
    "tabletop": tabletop.TABLE,
}
"""Where the objects of each suite stand in training; a put on the tabletop keeps to tabletop.REACH."""
GAPS_M, TRIES = (0.05, 0.035, 0.02), 400
"""Room between objects, tried in turn, so many times each."""
MOST = {"simpler-bridge": 4}
"""Objects of a stage where an area has no room for every number: one to a corner."""
CORNER_M = 0.01
"""What finds no room at random stands so far from an area's corners, in x and in y, give or take as much."""


@value
class Film:
    """One successful episode. Frame f is what the cameras saw before action f x `every(suite)`, and `ids` are 0 there for the scene, 1 for the
    target, i + 1 for object i; state t and places t are those before action t.

    `places` are the objects' x, y, z in the world, metres; `names[0]` is the target, `goal` the index of its goal or -1.
    """

    images: UInt8[np.ndarray, "f c s s 3"]
    ids: UInt8[np.ndarray, "f c s s"]
    state: Float32[np.ndarray, "t p"]
    action: Float32[np.ndarray, "t a"]
    places: Float32[np.ndarray, "t n 3"]
    names: tuple[str, ...]
    task: str
    goal: int


def every(suite_name: str) -> int:
    """Control steps from one picture of a suite's films to the next."""
    return EVERY.get(suite_name, 1)


def cast(known: Suite, task: Task, rng: np.random.Generator, held_out: bool = False) -> list[str]:
    """The target and its rivals, generic and of the task's category, then the task's goal if it has one. Half the rivals are look-alikes.

    Those `held_out` are in no film.
    """
    pool = range(HELD_OUT, HELD_OUT + TRAIN_INSTANCES) if held_out else range(TRAIN_INSTANCES)
    first, rivals = (
        pool[int(rng.integers(len(pool)))],
        int(rng.choice([1, 2, 3], p=[0.15, 0.7, 0.15])),
    )
    rivals = min(rivals, MOST.get(known.name, 5) - 1 - bool(task.goal))
    if rng.random() < 0.5:
        models = [
            objects.generic_instance(task.stem, first, int(twin))
            for twin in rng.permutation(6)[: rivals + 1]
        ]
    else:
        others = rng.choice([i for i in pool if i != first], rivals, replace=False)
        models = [objects.generic_instance(task.stem, int(i)) for i in (first, *others)]
    only_generic(models)
    return [model.name for model in models] + ([task.goal] if task.goal else [])


def row(
    known: Suite,
    task: Task,
    names: Sequence[str],
    number: int,
    variant: str,
    rng: np.random.Generator,
) -> EpisodeRow:
    """An episode of the task with these objects in new places; any of the category may be its target. Raises: ValueError when they do not fit."""
    things = [names[i] for i in rng.permutation(len(names) - bool(task.goal))]
    goal = [task.goal] if task.goal else []
    fixed = (
        {task.goal: tabletop.BOWLS[int(rng.integers(2))]}
        if goal and known.name == "tabletop"
        else {}
    )
    area = tabletop.REACH if fixed else AREAS[known.name]
    loose = [name for name in things + goal if name not in fixed]
    at = {**dict(zip(loose, _spots(rng, area, loose, fixed), strict=True)), **fixed}
    placed = [
        place(name, at[name], 0.0 if name == task.goal else turned(rng)) for name in things + goal
    ]
    order: tuple[Placement, ...] = (placed[0], *placed[len(things) :], *placed[1 : len(things)])
    return replace(
        known.row(task, number, order, seed=number, variant=variant), instruction=task.instruction
    )


def _spots(
    rng: np.random.Generator, area: Area, loose: Sequence[str], fixed: Mapping[str, Spot]
) -> list[Spot]:
    """Anywhere in the area, clear of each other; where no such places are found, in its corners. Raises: ValueError."""
    radii, kept = (
        [radius_m(name) for name in loose],
        [(spot, radius_m(name) / 2**0.5) for name, spot in fixed.items()],
    )
    for gap in GAPS_M:
        try:
            return scatter(rng, area, radii, kept, gap_m=gap, tries=TRIES)
        except ValueError:
            if gap == GAPS_M[-1] and (fixed or len(loose) > 4):
                raise
    corners = rng.permutation(
        [
            (x, y)
            for x in (area.x0 + CORNER_M, area.x1 - CORNER_M)
            for y in (area.y0 + CORNER_M, area.y1 - CORNER_M)
        ]
    )
    return [
        (float(x), float(y))
        for x, y in corners[: len(loose)] + rng.uniform(-CORNER_M, CORNER_M, (len(loose), 2))
    ]


def films(suite_name: str, seed: int, number: int) -> list[Film]:
    """The successful episodes of one stage."""
    known, rng = suite(suite_name), np.random.default_rng([71, seed, *suite_name.encode(), number])
    slips = np.random.default_rng([72, seed, *suite_name.encode(), number])
    task = known.tasks[number % len(known.tasks)]
    variant = str(rng.choice(list(VARIANTS))) if suite_name == "simpler-fractal" else "base"
    names = cast(known, task, rng)
    found = []
    with build_scene(suite_name, names, variant) as scene:
        for i in range(EPISODES):
            try:
                start = row(known, task, names, number * EPISODES + i, variant, rng)
                shot = shoot(
                    known,
                    scene,
                    start,
                    rng,
                    slips if start.rule != "selected" and slips.random() < MISSES else None,
                )
            except (
                OutOfReach,
                ValueError,
            ):  # no grasp from here, or no room: another place will do
                continue
            if shot is not None:
                found.append(shot)
    return found


def shoot(
    known: Suite,
    scene: Scene,
    start: EpisodeRow,
    rng: np.random.Generator,
    slips: np.random.Generator | None = None,
) -> Film | None:
    """The expert's episode, filmed; None when it fails. With `slips`, the film begins where a first grasp has missed."""
    env, expert = make_env(scene, known.name, image_size=SEEN), Expert()
    env.reset(start)
    names = [placed.model for placed in start.placements]
    state = expert.start(rng) if slips is None else _missed(env, expert, slips)
    pictures, steps = [], []
    for judge, action in expert_steps(
        env, start, expert, state, lambda planned: _knocked(planned, known, rng)
    ):
        if action is None:
            break
        shown = judge.steps % every(known.name) == 0
        truth = env.truth(masks=shown)
        if shown:
            seen = np.stack([small(rgb) for rgb in env.observe().images.values()])
            pictures.append(
                (seen, np.stack([_ids(truth.masks[camera], names) for camera in known.cameras]))
            )
        spots = np.array([truth.objects_world[name][:3] for name in names], np.float32)
        steps.append((env.state(), action, spots))
    if not judge.outcome().success:
        return None
    views, masks = (np.stack(part) for part in zip(*pictures, strict=True))
    states, actions, places = (np.stack(part) for part in zip(*steps, strict=True))
    return Film(
        views,
        masks,
        states,
        actions,
        places,
        tuple(names),
        start.task,
        names.index(start.goal) if start.goal else -1,
    )


def after_a_miss(film: Film) -> bool:
    """Whether the film begins with a second try: its hand begins far below its highest point."""
    height = film.state[:, 2]
    return bool(height[0] + LOW_M < height.max())


def _missed(env: Env, expert: Expert, rng: np.random.Generator) -> ExpertState:
    """Go astray, unfilmed, as far as the moment of beginning again. What was held by luck is put back: that is no miss."""
    state = expert.astray(env, rng)
    while True:
        (state,), (chunk,) = expert.plan_from_simulation([state], [env])
        if state.phase != "miss":
            break
        env.step(chunk[0])
    if env.row.target not in env.truth().held:
        return state
    env.reset(env.row)
    return expert.start(rng)


def small(rgb: Rgb) -> UInt8[np.ndarray, "s s 3"]:
    """As policies.lerobot scales a view for its policy: bilinear, antialiased."""
    return np.asarray(Image.fromarray(rgb).resize((SIDE, SIDE), Image.Resampling.BILINEAR))


def _ids(masks: Mapping[str, Mask], names: Sequence[str]) -> UInt8[np.ndarray, "s s"]:
    out = np.zeros((SEEN, SEEN), np.uint8)
    for i, name in enumerate(names):
        out[masks[name]] = i + 1
    return cv2.resize(out, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)


def _knocked(
    action: Float32[np.ndarray, " a"], known: Suite, rng: np.random.Generator
) -> Float32[np.ndarray, " a"]:
    """The action, now and then with a jolt that the expert did not ask for and corrects next."""
    if rng.random() > JOLT:
        return action
    jolt, out = rng.normal(size=len(action) - 1), action.copy()
    if known.control == "ee":
        out[:3] += jolt[:3] * JOLT_M
        out[5] += jolt[5] * JOLT_RAD
    else:
        out[: len(jolt)] += jolt * 2 * JOLT_M
    return out


PARTS = ("images", "ids", "state", "action", "places", "names", "task", "goal")


def cached(folder: Path, suite_name: str, seed: int, number: int) -> list[Film]:
    """The stage's films from `folder`, shot first if they are not there."""
    path = folder / f"{suite_name}-{seed}-{number:05d}.npz"
    if not path.exists():
        made, buffer = films(suite_name, seed, number), io.BytesIO()
        np.savez_compressed(
            buffer,
            n=len(made),
            **{f"{part}{i}": getattr(film, part) for i, film in enumerate(made) for part in PARTS},
        )
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path, buffer.getvalue())
    with np.load(path) as held:
        return [_film({part: held[f"{part}{i}"] for part in PARTS}) for i in range(int(held["n"]))]


def _film(parts: dict[str, np.ndarray]) -> Film:
    names, task, goal = tuple(map(str, parts["names"])), str(parts["task"]), int(parts["goal"])
    return Film(
        parts["images"],
        parts["ids"],
        parts["state"],
        parts["action"],
        parts["places"],
        names,
        task,
        goal,
    )
