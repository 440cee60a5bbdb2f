"""Scenes of films with two targets at once (P multi-object): "put my pouch near her vase".

Two generic objects of the target's category and two of the goal's; any of each is meant.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vap_core.simulation.assets.objects import ObjectModel
from vap_core.simulation.suites import Suite, Task
from vap_core.simulation.suites.layout import place_at_random_yaws
from vap_core.simulation.types import EpisodeRow
from vap_make.films.scenes import HELD_OUT, TRAIN_INSTANCES
from vap_make.lists import shared
from vap_make.objects import generic_instance

EACH = 2
"""Objects of either category."""
TRIES = 2000
"""How many layouts are drawn before there is no room."""


def draw_models(task: Task, rng: np.random.Generator, held_out: bool) -> list[ObjectModel]:
    """EACH objects of the target's category, then EACH of the goal's.

    Half of them are look-alikes of each other. Those `held_out` are in no film.
    """
    first = HELD_OUT if held_out else 0
    models: list[ObjectModel] = []
    for stem in (task.stem, task.goal.removesuffix("-personal")):
        instances = first + rng.choice(TRAIN_INSTANCES, EACH, replace=False)
        if rng.random() < 0.5:
            for twin in rng.permutation(6)[:EACH]:
                models.append(generic_instance(stem, int(instances[0]), int(twin)))
        else:
            for i in instances:
                models.append(generic_instance(stem, int(i)))
    return models


def row(
    known: Suite, task: Task, names: Sequence[str], number: int, rng: np.random.Generator
) -> EpisodeRow:
    """An episode with these objects in new places, laid out as the suite's own.

    Raises: ValueError when they do not fit.
    """
    target, *rivals = rng.permutation(list(names[:EACH])).tolist()
    goal, *others = rng.permutation(list(names[EACH:])).tolist()
    models = [target, goal, *rivals, *others]
    within = [target, *rivals]
    for _ in range(TRIES):
        spots = shared.try_desk(models, within, pair=(target, goal, rivals[0]), rng=rng)
        if spots is not None:
            break
    else:
        raise ValueError(f"films.pairs: no room for {', '.join(models)}")
    placed = place_at_random_yaws(rng, models, [spots[name] for name in models])
    drawn = known.row(replace(task, goal=goal), number, tuple(placed), seed=number)
    return replace(drawn, instruction=task.instruction)
