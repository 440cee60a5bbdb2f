"""Suites: the four personalised benchmarks, whose episode lists are hashed files, and the demo's warm-up suites, made on the spot."""

from dataclasses import replace
from functools import cache

import numpy as np

from vap_core.base.errors import BadSuite, UnknownName, one_of
from vap_core.simulation.assets import objects
from vap_core.simulation.suites import lists, pick
from vap_core.simulation.suites.rules import Judge as Judge
from vap_core.simulation.suites.simpler import BRIDGE, FRACTAL
from vap_core.simulation.suites.suite import Suite as Suite
from vap_core.simulation.suites.suite import Task as Task
from vap_core.simulation.suites.tabletop import TABLETOP
from vap_core.simulation.suites.variants import VARIANTS as VARIANTS
from vap_core.simulation.suites.vlabench import VLABENCH
from vap_core.simulation.types import EpisodeRow

BENCHMARKS: dict[str, Suite] = {
    "simpler-fractal": FRACTAL,
    "simpler-bridge": BRIDGE,
    "vlabench": VLABENCH,
    "tabletop": TABLETOP,
}
WARM_UPS: dict[str, Suite] = {"widowx-pick": pick.WIDOWX, "franka-pick": pick.FRANKA}
SUITES: dict[str, Suite] = {**BENCHMARKS, **WARM_UPS}


def suite(name: str) -> Suite:
    """The suite called `name`. Raises: UnknownName."""
    if name not in SUITES:
        raise one_of("suites.suite: suite", name, SUITES)
    return SUITES[name]


@cache
def benchmark(name: str) -> tuple[EpisodeRow, ...]:
    """The whole list of a benchmark. Raises: BadSuite, naming row and field, also for a task, camera or object that does not exist."""
    listed, known = lists.read(name), suite(name)
    for i, row in enumerate(listed, 1):
        for field, odd, names in (
            ("task", {row.task}, {task.name for task in known.tasks}),
            ("cameras", set(row.cameras), set(known.cameras)),
        ):
            if odd - names:
                raise BadSuite(
                    f"suites: {name}.jsonl row {i}, field {field!r}: unknown {sorted(odd - names)}; known: {', '.join(sorted(names))}."
                )
        for place in row.placements:
            try:
                objects.get_object(place.model)
            except UnknownName as error:
                raise BadSuite(
                    f"suites: {name}.jsonl row {i}, field 'placements': no object {place.model!r}."
                ) from error
    return listed


def rows(
    suite_name: str, task_name: str, n: int | None = None, seed: int = 0
) -> tuple[EpisodeRow, ...]:
    """Episodes of a task: the whole list, or `n` of it spread evenly; of a warm-up suite the first `n` (20) of `seed`.

    A benchmark's list is the same for every seed; the seed reaches the policy and the sensor noise.
    Raises: UnknownName for a suite or a task that no registry holds; BadSuite for a list that is damaged.
    """
    found = suite(suite_name)
    task = found.task(task_name)
    if suite_name in WARM_UPS:
        return pick.rows(found, task, 20 if n is None else n, seed)
    listed = [row for row in benchmark(suite_name) if row.task == task_name]
    chosen = (
        range(len(listed))
        if n is None or n >= len(listed)
        else np.unique(np.linspace(0, len(listed) - 1, n).astype(int)).tolist()
    )
    return tuple(replace(listed[i], seed=seed) for i in chosen)


def listed(
    suite_name: str, task_name: str, n: int | None = None, seed: int = 0, seeds: int = 1
) -> tuple[EpisodeRow, ...]:
    """`rows` of `seeds` seeds from `seed` on, one seed after the other."""
    return tuple(
        row for one in range(seed, seed + seeds) for row in rows(suite_name, task_name, n, one)
    )
