"""Suites: the four personalised benchmarks, and the demo's warm-up suites.

The episode lists of the benchmarks are hashed files; those of the warm-up suites are generated.
"""

from functools import cache

import numpy as np

from vap_core.base.errors import BadSuite, UnknownName, one_of
from vap_core.simulation import robots
from vap_core.simulation.assets import objects
from vap_core.simulation.suites import lists, pick, starts
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
    """The whole list of a benchmark.

    Raises: BadSuite, naming row and field, also for a task, camera or object that does not exist.
    """
    episodes = lists.read(name)
    known = suite(name)
    tasks = {task.name for task in known.tasks}
    cameras = set(known.cameras)
    for i, row in enumerate(episodes, 1):
        where = f"{name}.jsonl row {i}"
        _check_names({row.task}, tasks, f"{where}, field 'task'")
        _check_names(set(row.cameras), cameras, f"{where}, field 'cameras'")
        for place in row.placements:
            try:
                objects.get_object(place.model)
            except UnknownName as error:
                raise BadSuite(
                    f"suites: {where}, field 'placements': no object {place.model!r}."
                ) from error
    return episodes


def rows(
    suite_name: str, task_name: str, n: int | None = None, seed: int = 0
) -> tuple[EpisodeRow, ...]:
    """Episodes of a task: the whole list, or `n` of it spread evenly.

    Of a warm-up suite the first `n` (20) of `seed`. A benchmark's list is the same for every seed;
    a seed but 0 changes how its episodes start (starts.seeded), and every seed the policy's and
    the sensors' noise.
    Raises: UnknownName for a suite or a task that no registry holds; BadSuite for a damaged list.
    """
    known = suite(suite_name)
    task = known.task(task_name)
    if suite_name in WARM_UPS:
        return pick.rows(known, task, 20 if n is None else n, seed)
    episodes = [row for row in benchmark(suite_name) if row.task == task_name]
    if n is not None and n < len(episodes):
        spread = np.linspace(0, len(episodes) - 1, n).astype(int)
        episodes = [episodes[i] for i in np.unique(spread)]
    joints = len(robots.get(known.robot).joints)
    return tuple(starts.seeded(row, seed, joints) for row in episodes)


def listed(
    suite_name: str, task_name: str, n: int | None = None, seed: int = 0, seeds: int = 1
) -> tuple[EpisodeRow, ...]:
    """`rows` of `seeds` seeds from `seed` on, one seed after the other."""
    episodes: list[EpisodeRow] = []
    for row_seed in range(seed, seed + seeds):
        episodes.extend(rows(suite_name, task_name, n, row_seed))
    return tuple(episodes)


def _check_names(names: set[str], known: set[str], where: str) -> None:
    unknown = names - known
    if unknown:
        raise BadSuite(
            f"suites: {where}: unknown {sorted(unknown)}; known: {', '.join(sorted(known))}."
        )
