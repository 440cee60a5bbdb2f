"""Demonstrations of the scripted expert with generic objects (P 5.1).

They are what a frozen policy has learned from before it meets a user. A stage is one compiled scene
of one task: some generic objects of its category, in a room of its own (`looks`), seen in EPISODES
episodes from new places. Stages are numbered; the same suite, seed and number give the same films.
Personal objects and their look-alikes never appear (`only_generic` refuses them), nor does the
category that the suite's recipe holds out.
"""

import io
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from vap_core.base.errors import BadOutput, OutOfReach
from vap_core.base.files import write_atomic, writing
from vap_core.base.types import Mask, Rgb, value
from vap_core.policies.scripted.expert import Expert, ExpertState
from vap_core.rollout.running import expert_steps
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.objects import ObjectModel
from vap_core.simulation.env import Env
from vap_core.simulation.scenes import Scene, build
from vap_core.simulation.suites import Suite, Task, suite
from vap_core.simulation.suites.layout import Area, Spot, place, radius_m, random_yaw, scatter
from vap_core.simulation.suites.open_row import make_env
from vap_core.simulation.types import EpisodeRow, Placement
from vap_make.films import pairs
from vap_make.films.looks import draw_look
from vap_make.films.scenes import HELD_OUT, TRAIN_INSTANCES, only_generic
from vap_make.folder import kept_arrays
from vap_make.lists import benchmarks
from vap_make.objects import dye_some, generic_instance
from vap_make.recipe import FILMED, RECIPES, every, filmed_tasks

SIDE = 112
"""Pixels of a film: a policy sees views of SEEN pixels scaled down to SIDE."""
SEEN = 224
"""Pixels of the views that a film is made of."""
EPISODES = 8
"""Episodes of one stage."""
JOLT = 0.15
"""Share of steps in which the hand is knocked off its way, so that films show how to recover."""
JOLT_M = 0.012
"""Standard deviation of how far the hand is knocked, metres."""
JOLT_RAD = 0.2
"""Standard deviation of how far the hand is turned by a knock, radians."""
LOW_M = 0.05
"""A hand that begins so far below its highest point begins after a miss."""
MISSES = 0.5
"""Share of the grasping films that begin where a first grasp has missed.

A policy that has not seen that presses on for ever.
"""
GAPS_M = (0.05, 0.035, 0.02)
"""Room between objects, tried in turn."""
TRIES = 400
"""How many times each gap is tried."""
MOST = 6
"""Objects of a scene, the goal among them."""
DISTRACTORS = ("cup", "straw cup", "owl figurine", "camera", "vase")
"""Categories of distractors. Those of films are training instances, which no evaluation shows."""
CORNER_M = 0.01
"""Distance from an area's corners, in x and in y, of what finds no room at random.

It is jittered by up to as much.
"""
PARTS = ("images", "ids", "state", "action", "places", "names", "task", "goal")
"""The fields of a Film, as files keep them."""


@value
class Film:
    """One successful episode.

    Frame f is what the cameras saw before action f x `every(suite)`, and `ids` are 0 there for the
    scene, 1 for the target, i + 1 for object i; state t and places t are those before action t.
    `places` are the objects' x, y, z in the world, metres; `names[0]` is the target, `goal` the
    index of its goal or -1.
    """

    images: UInt8[np.ndarray, "f c s s 3"]
    ids: UInt8[np.ndarray, "f c s s"]
    state: Float32[np.ndarray, "t p"]
    action: Float32[np.ndarray, "t a"]
    places: Float32[np.ndarray, "t n 3"]
    names: tuple[str, ...]
    task: str
    goal: int


def draw_objects(
    known: Suite, task: Task, rng: np.random.Generator, held_out: bool = False
) -> list[str]:
    """The target and its rivals, distractors of other categories if any, and the task's goal; of a
    pair those of `pairs`.

    Target and rivals are generic and of the task's category; half the rivals are look-alikes, and
    most scenes have dyed objects. Those `held_out` are in no film.
    """
    if FILMED[known.name].pairs:
        draw, goals = pairs.draw_models, []
    else:
        draw, goals = partial(draw_models, known), [task.goal] * bool(task.goal)
    models = dye_some(draw(task, rng, held_out), rng, RECIPES[known.name].held_out_words)
    only_generic(models)
    return [*(model.name for model in models), *goals]


def draw_models(
    known: Suite, task: Task, rng: np.random.Generator, held_out: bool
) -> list[ObjectModel]:
    """The target, its rivals and distractors, none of them dyed."""
    filmed = FILMED[known.name]
    pool = range(TRAIN_INSTANCES)
    if held_out:
        pool = range(HELD_OUT, HELD_OUT + TRAIN_INSTANCES)
    first = pool[int(rng.integers(len(pool)))]
    distractors = int(rng.integers(1, 3)) if rng.random() < filmed.distractors else 0
    rivals = int(rng.choice([1, 2, 3], p=[0.15, 0.7, 0.15]))
    rivals = min(
        rivals, filmed.most - 1 - bool(task.goal), MOST - 1 - distractors - bool(task.goal)
    )
    models = []
    if rng.random() < 0.5:
        for twin in rng.permutation(6)[: rivals + 1]:
            models.append(generic_instance(task.stem, first, int(twin)))
    else:
        others = [i for i in pool if i != first]
        for i in (first, *rng.choice(others, rivals, replace=False)):
            models.append(generic_instance(task.stem, int(i)))
    kinds = [kind for kind in DISTRACTORS if kind != task.category]
    # Left out after the draw, which every later one hangs on.
    left = rng.permutation(kinds)
    for kind in left[left != RECIPES[known.name].held_out_category][:distractors]:
        index = pool[int(rng.integers(len(pool)))]
        models.append(generic_instance(str(kind), index))
    return models


def row(
    known: Suite,
    task: Task,
    names: Sequence[str],
    number: int,
    rng: np.random.Generator,
) -> EpisodeRow:
    """An episode of the task with these objects in new places; any of the category is its target.

    Raises: ValueError when they do not fit.
    """
    if FILMED[known.name].pairs:
        return pairs.row(known, task, names, number, rng)
    n_things = len(names) - bool(task.goal)
    same: list[str] = []
    distractors: list[str] = []
    for i in rng.permutation(n_things):
        is_same = objects.get_object(names[i]).category == task.category
        (same if is_same else distractors).append(names[i])
    things = same + distractors
    goals = [task.goal] if task.goal else []
    fixed: dict[str, Spot] = {}
    area = FILMED[known.name].area
    if task.goal and known.name == "tabletop":
        fixed[task.goal] = benchmarks.BOWLS[int(rng.integers(2))]
        area = benchmarks.REACH
    loose = [name for name in things + goals if name not in fixed]
    spots = dict(zip(loose, _spots(rng, area, loose, fixed), strict=True))
    spots.update(fixed)
    placed = []
    for name in things + goals:
        yaw = 0.0 if name == task.goal else random_yaw(rng)
        placed.append(place(name, spots[name], yaw))
    placements: tuple[Placement, ...] = (placed[0], *placed[n_things:], *placed[1:n_things])
    drawn = known.row(task, number, placements, seed=number)
    return replace(drawn, instruction=task.instruction)


def films(suite_name: str, seed: int, number: int) -> list[Film]:
    """The successful episodes of one stage.

    Raises: UnknownName for a suite that no registry holds.
    """
    known = suite(suite_name)
    rng = np.random.default_rng([71, seed, *suite_name.encode(), number])
    miss_rng = np.random.default_rng([72, seed, *suite_name.encode(), number])
    tasks = filmed_tasks(suite_name)
    task = tasks[number % len(tasks)]
    look = draw_look(rng)
    names = draw_objects(known, task, rng)
    found = []
    with build(known.robot, names, style=look) as scene:
        for i in range(EPISODES):
            try:
                episode = number * EPISODES + i
                start = row(known=known, task=task, names=names, number=episode, rng=rng)
                misses = start.rule != "selected" and miss_rng.random() < MISSES
                slips = miss_rng if misses else None
                film = shoot(known=known, scene=scene, start=start, rng=rng, slips=slips)
            except (OutOfReach, ValueError):
                # No grasp from here, or no room: another place will do.
                continue
            if film is not None:
                found.append(film)
    return found


def shoot(
    known: Suite,
    scene: Scene,
    start: EpisodeRow,
    rng: np.random.Generator,
    slips: np.random.Generator | None = None,
) -> Film | None:
    """The expert's episode, filmed; None when it fails.

    With `slips`, the film begins where a first grasp has missed.

    Raises: OutOfReach when the expert cannot reach its next pose; UnknownName when `start` places
        an object that the scene lacks.
    """
    env = make_env(scene, known.name, image_size=SEEN)
    expert = Expert()
    env.reset(start)
    names = [placed.model for placed in start.placements]
    state = expert.start(rng) if slips is None else _missed(env, expert, slips)

    def knock(action: Float32[np.ndarray, " a"]) -> Float32[np.ndarray, " a"]:
        return _knock(action, known, rng)

    pictures = []
    pictures_ids = []
    states = []
    actions = []
    places = []
    for judge, action in expert_steps(
        env=env, row=start, expert=expert, state=state, disturb=knock
    ):
        if action is None:
            break
        has_picture = judge.steps % every(known.name) == 0
        truth = env.truth(masks=has_picture)
        if has_picture:
            pictures.append(_stack_views(env.observe().images))
            pictures_ids.append(_stack_ids(known, truth.masks, names))
        states.append(env.state())
        actions.append(action)
        places.append(_stack_places(truth.objects_world, names))
    if not judge.outcome().success:
        return None
    return Film(
        images=np.stack(pictures),
        ids=np.stack(pictures_ids),
        state=np.stack(states),
        action=np.stack(actions),
        places=np.stack(places),
        names=tuple(names),
        task=start.task,
        goal=names.index(start.goal) if start.goal else -1,
    )


def after_a_miss(film: Film) -> bool:
    """Whether the film begins with a second try: its hand begins far below its highest point."""
    height = film.state[:, 2]
    return bool(height[0] + LOW_M < height.max())


def thinned(films: Sequence[Film], n: int) -> list[Film]:
    """The films with one picture in `n`, from the first on."""
    return [
        replace(film, images=film.images[::n].copy(), ids=film.ids[::n].copy()) for film in films
    ]


def small(rgb: Rgb) -> UInt8[np.ndarray, "s s 3"]:
    """As policies.lerobot scales a view for its policy: bilinear, antialiased."""
    image = Image.fromarray(rgb)
    return np.asarray(image.resize((SIDE, SIDE), Image.Resampling.BILINEAR))


def cached(folder: Path, suite_name: str, seed: int, number: int) -> list[Film]:
    """The stage's films from `folder`, shot first if they are not there.

    Raises: BadOutput when their file is damaged, was filmed by another recipe or cannot be written.
    """
    path = stage_file(folder, suite_name, seed, number)
    if not path.exists():
        started = time.process_time()
        made = films(suite_name, seed, number)
        _write_stage(path, made, time.process_time() - started)
    found = []
    with kept_arrays(path, "train") as arrays:
        for i in range(int(arrays["n"])):
            found.append(_read_film(arrays, i))
    for film in found:
        _require_pictures(film, every(suite_name), path)
    return found


def stage_file(folder: Path, suite_name: str, seed: int, number: int) -> Path:
    """The file of a stage's films."""
    return folder / f"{suite_name}-{seed}-{number:05d}.npz"


def _spots(
    rng: np.random.Generator, area: Area, loose: Sequence[str], fixed: Mapping[str, Spot]
) -> list[Spot]:
    """Anywhere in the area, clear of each other; where no such places are found, in its corners.

    Raises: ValueError when there are no corners to spare.
    """
    radii = [radius_m(name) for name in loose]
    kept = []
    for name, spot in fixed.items():
        kept.append((spot, radius_m(name) / 2**0.5))
    for gap in GAPS_M:
        try:
            return scatter(rng=rng, area=area, reach_m=radii, fixed=kept, gap_m=gap, tries=TRIES)
        except ValueError:
            if gap == GAPS_M[-1] and (fixed or len(loose) > 4):
                raise
    return _corner_spots(rng, area, len(loose))


def _corner_spots(rng: np.random.Generator, area: Area, n: int) -> list[Spot]:
    """`n` of the area's corners, jittered."""
    corners = []
    for x in (area.x0 + CORNER_M, area.x1 - CORNER_M):
        for y in (area.y0 + CORNER_M, area.y1 - CORNER_M):
            corners.append((x, y))
    chosen = rng.permutation(corners)[:n]
    jittered = chosen + rng.uniform(-CORNER_M, CORNER_M, (n, 2))
    spots = []
    for x, y in jittered:
        spots.append((float(x), float(y)))
    return spots


def _stack_views(images: Mapping[str, Rgb]) -> UInt8[np.ndarray, "c s s 3"]:
    """The views of all cameras, scaled down."""
    views = []
    for rgb in images.values():
        views.append(small(rgb))
    return np.stack(views)


def _stack_ids(
    known: Suite, masks: Mapping[str, Mapping[str, Mask]], names: Sequence[str]
) -> UInt8[np.ndarray, "c s s"]:
    """The object of every pixel of every camera, scaled down."""
    ids = []
    for camera in known.cameras:
        ids.append(_ids(masks[camera], names))
    return np.stack(ids)


def _stack_places(
    poses: Mapping[str, np.ndarray], names: Sequence[str]
) -> Float32[np.ndarray, "n 3"]:
    """x, y and z of every object in the world, metres."""
    places = []
    for name in names:
        places.append(poses[name][:3])
    return np.array(places, np.float32)


def _missed(env: Env, expert: Expert, rng: np.random.Generator) -> ExpertState:
    """Miss once, unfilmed, as far as the moment of beginning again.

    If the object is grasped by luck, that is no miss: the episode is reset.
    """
    state = expert.start_with_miss(env, rng)
    while True:
        (state,), (chunk,) = expert.plan_from_simulation([state], [env])
        if state.phase != "miss":
            break
        env.step(chunk[0])
    if env.row.target not in env.truth().held:
        return state
    env.reset(env.row)
    return expert.start(rng)


def _ids(masks: Mapping[str, Mask], names: Sequence[str]) -> UInt8[np.ndarray, "s s"]:
    """The object of every pixel of one camera, scaled down."""
    ids = np.zeros((SEEN, SEEN), np.uint8)
    for i, name in enumerate(names):
        ids[masks[name]] = i + 1
    return cv2.resize(ids, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)


def _knock(
    action: Float32[np.ndarray, " a"], known: Suite, rng: np.random.Generator
) -> Float32[np.ndarray, " a"]:
    """The action, now and then with a jolt that the expert did not ask for and corrects next."""
    if rng.random() > JOLT:
        return action
    jolt = rng.normal(size=len(action) - 1)
    knocked = action.copy()
    if known.control == "ee":
        knocked[:3] += jolt[:3] * JOLT_M
        knocked[5] += jolt[5] * JOLT_RAD
    else:
        knocked[: len(jolt)] += jolt * 2 * JOLT_M
    return knocked


def _write_stage(path: Path, made: Sequence[Film], cpu_s: float) -> None:
    """Keep the films of a stage in one file: arrays `<part><number>`, their count `n`, the cost."""
    arrays = {}
    for i, film in enumerate(made):
        for part in PARTS:
            arrays[f"{part}{i}"] = getattr(film, part)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, n=len(made), cpu_s=cpu_s, **arrays)
    with writing(path, "train"):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, buffer.getvalue())


def has_every(film: Film, interval: int) -> bool:
    """Whether there are as many pictures as one every `interval` steps makes."""
    return len(film.images) == -(-len(film.action) // interval)


def _require_pictures(film: Film, interval: int, path: Path) -> None:
    """Raises: BadOutput when there is not a picture every `interval` steps."""
    steps = len(film.action)
    if not has_every(film, interval):
        raise BadOutput(
            f"train: {path} holds films of another recipe ({len(film.images)} pictures of {steps} "
            f"steps, one is wanted every {interval}); choose another --cache, or delete it and run "
            "the same command again."
        )


def _read_film(arrays: Mapping[str, np.ndarray], i: int) -> Film:
    return Film(
        images=arrays[f"images{i}"],
        ids=arrays[f"ids{i}"],
        state=arrays[f"state{i}"],
        action=arrays[f"action{i}"],
        places=arrays[f"places{i}"],
        names=tuple(map(str, arrays[f"names{i}"])),
        task=str(arrays[f"task{i}"]),
        goal=int(arrays[f"goal{i}"]),
    )
