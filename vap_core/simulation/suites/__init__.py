"""Suites: the four personalised benchmarks, shared scenes, and the demo's warm-up suites.

The episode lists of benchmarks and shared scenes are hashed files; those of the warm-up suites are
generated. Every benchmark has a development list, the suite NAME-dev. NAME-absent and
NAME-dev-absent are the same lists with the target left out; NAME-red and NAME-dev-red have a
look-alike that is red by nature. NAME-twins has the two hardest look-alikes in the places of those
that NAME draws. Where a suite's sensor has noise (tabletop), each of these draws
its own. A user's own suites come from files (own.py).
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from vap_core.base.errors import BadSuite, MissingPart, UnknownName, one_of
from vap_core.simulation import robots
from vap_core.simulation.assets import objects
from vap_core.simulation.suites import layout, lists, own, shared, starts
from vap_core.simulation.suites.benchmarks import BRIDGE, FRACTAL, TABLETOP, VLABENCH
from vap_core.simulation.suites.rules import Judge as Judge
from vap_core.simulation.suites.suite import VARIANTS as VARIANTS
from vap_core.simulation.suites.suite import Suite as Suite
from vap_core.simulation.suites.suite import Task as Task
from vap_core.simulation.types import AS_LISTED, EpisodeRow

BENCHMARKS: dict[str, Suite] = {
    "simpler-fractal": FRACTAL,
    "simpler-bridge": BRIDGE,
    "vlabench": VLABENCH,
    "tabletop": TABLETOP,
}
WARM_UPS: dict[str, Suite] = {"widowx-pick": layout.WIDOWX, "franka-pick": layout.FRANKA}
SHARED: dict[str, Suite] = shared.SUITES
"""Scenes that two people share: two objects in turn, or two at once."""
SUITES: dict[str, Suite] = {**BENCHMARKS, **SHARED, **WARM_UPS}
ELSEWHERE: dict[str, Suite] = {}
"""Suites of other libraries' environments; `vap_core.environments` enters them."""
DEVELOPMENT = "-dev"
"""Ends the name of a suite to tune on, beside each benchmark."""
ABSENT = "-absent"
"""Ends the name of a suite whose target is left out."""
RED = objects.RED
"""Ends the name of a suite whose first look-alike is red by nature; -absent may follow it."""
TWINS = "-twins"
"""Ends the name of a suite whose look-alikes are the two hardest."""
ENDINGS = (ABSENT, RED, DEVELOPMENT, TWINS)
"""No suite of one's own ends so."""


def suite(name: str) -> Suite:
    """The suite called `name`. Raises: UnknownName."""
    for known in (SUITES, ELSEWHERE):
        if name in known:
            return known[name]
    own_suite = _find_own(name)
    if own_suite is not None:
        return own_suite.suite
    if not is_listed(name):
        raise one_of(
            "suites.suite: suite (a benchmark also with -dev, -red, -twins, -absent; your own by "
            f"its file or {own.VARIABLE})",
            name,
            [*SUITES, *ELSEWHERE],
        )
    return replace(BENCHMARKS[benchmark_name(name)], name=name)


def list_name(name: str) -> str:
    """The list that a suite reads, whatever is left out of it, painted red or replaced."""
    return name.removesuffix(ABSENT).removesuffix(RED).removesuffix(TWINS)


def benchmark_name(name: str) -> str:
    """The benchmark of a suite: its own name, or that without -dev, -red, -twins and -absent.

    Of a shared scene, the benchmark whose robot and frozen policy it has.
    """
    return shared.LIKE.get(name) or list_name(name).removesuffix(DEVELOPMENT)


def is_listed(name: str) -> bool:
    """Whether a suite has a list on disk: a benchmark, its development list, or without targets.

    A shared scene has one, too.
    """
    if name.endswith(DEVELOPMENT + TWINS):  # a development list has its own look-alikes
        return False
    return name in (*SHARED, *ELSEWHERE) or benchmark_name(name) in BENCHMARKS


def open_file(path: Path) -> Suite:
    """Make the suite known that a Python file of the user's own defines. Raises: BadSuite."""
    return own.open_file(path, taken=SUITES, endings=ENDINGS)


def _find_own(name: str) -> own.OwnSuite | None:
    """A suite of the user's own. Raises: BadSuite."""
    return own.find(name, taken=SUITES, endings=ENDINGS)


def own_suites() -> tuple[Suite, ...]:
    """The user's own suites: those that are open, and those of VAP_SUITES. Raises: BadSuite."""
    own.open_listed(taken=SUITES, endings=ENDINGS)
    return tuple(opened.suite for opened in own.OPENED.values())


def own_files(names: Iterable[str]) -> tuple[str, ...]:
    """The files of the user's own suites among some, each once. Raises: BadSuite."""
    opened = filter(None, map(_find_own, names))
    return tuple(dict.fromkeys(str(own_suite.file) for own_suite in opened))


def has_list(name: str) -> bool:
    """Whether a suite's rows are a list, the same for every seed: all but the warm-up suites'."""
    return is_listed(name) or _find_own(name) is not None


def digest(name: str) -> str:
    """The sha256 of a suite's list. Raises: UnknownName; BadSuite."""
    own_suite = _find_own(name)
    if own_suite is not None:
        return own_suite.sha256
    suite(name)  # refuses a name that no suite has
    return lists.digest(list_name(name))


def changed_lists(digests: Mapping[str, str]) -> list[str]:
    """The suites whose lists are not those of these `digests` any more.

    Raises: as `digest`.
    """
    return [name for name, kept in digests.items() if digest(name) != kept]


@cache
def benchmark(name: str) -> tuple[EpisodeRow, ...]:
    """The whole list of a benchmark, or of its development list; for both without their targets, or
    with a red look-alike; of a benchmark with its hardest look-alikes. Of an own suite its whole
    list.

    Raises: BadSuite, naming row and field, also for a task, camera or object that does not exist.
    """
    if name.endswith(ABSENT):
        left_out = replace(AS_LISTED, absent=True)
        whole = benchmark(name.removesuffix(ABSENT))
        return tuple(replace(row, suite=name, start=left_out) for row in whole)
    for ending in (RED, TWINS):
        if name.endswith(ending):
            return tuple(_with_others(row, name) for row in benchmark(name.removesuffix(ending)))
    own_suite = _find_own(name)
    if own_suite is not None:
        return own_suite.rows
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
            except MissingPart:
                pass  # no episode runs, but what was run can be read
            except UnknownName as error:
                raise BadSuite(
                    f"suites: {where}, field 'placements': no object {place.model!r}."
                ) from error
    return episodes


def rows(
    suite_name: str, task_name: str, n: int | None = None, seed: int = 0, split: str = ""
) -> tuple[EpisodeRow, ...]:
    """Episodes of a task: the whole list or a split of it, or `n` of that spread evenly.

    Of a warm-up suite the first `n` (20) of `seed`. A benchmark's list is the same for every seed;
    a seed but 0 changes how its episodes start (starts.seeded), and every seed the policy's and
    the sensors' noise.
    Raises: UnknownName for a suite or a task that no registry holds; BadSuite for a damaged list.
    """
    known = suite(suite_name)
    task = known.task(task_name)
    if suite_name in WARM_UPS:
        return _of_split(layout.pick_rows(known, task, 20 if n is None else n, seed), split)
    episodes = _of_split(_seeded(suite_name, task_name, seed), split)
    if n is not None and n < len(episodes):
        spread = np.linspace(0, len(episodes) - 1, n).astype(int)
        return tuple(episodes[i] for i in np.unique(spread))
    return episodes


def _of_split(episodes: tuple[EpisodeRow, ...], split: str) -> tuple[EpisodeRow, ...]:
    """The episodes of one split; all of them where none is named."""
    if not split:
        return episodes
    return tuple(row for row in episodes if row.split == split)


@cache
def _seeded(suite_name: str, task_name: str, seed: int) -> tuple[EpisodeRow, ...]:
    """The list of a task under a seed."""
    joints = len(robots.get(suite(suite_name).robot).joints)
    of_task = (row for row in benchmark(suite_name) if row.task == task_name)
    if suite(suite_name).environment:  # an official start stays as it is
        return tuple(replace(row, seed=seed) for row in of_task)
    return tuple(starts.seeded(row, seed, joints) for row in of_task)


def tasks_of(suite_names: Iterable[str], own_target: str = "") -> tuple[tuple[str, str], ...]:
    """Suite and task of every task of some suites; with an own object, those of its category.

    Raises: UnknownName; BadObject.
    """
    category = objects.get_object(own_target).category if own_target else ""
    return tuple(
        (name, task.name)
        for name in suite_names
        for task in suite(name).tasks
        if not own_target or task.category == category
    )


def listed(
    suite_name: str,
    task_name: str,
    n: int | None = None,
    seed: int = 0,
    seeds: int = 1,
    own_target: str = "",
    split: str = "",
) -> tuple[EpisodeRow, ...]:
    """`rows` of `seeds` seeds from `seed` on, one seed after the other.

    `own_target` takes the listed target's place (own_object.with_object).
    """
    if own_target:
        everything = tuple(known for known in SUITES.values() if known.name not in SHARED)
        starts.check_category(own_target, suite(suite_name), task_name, everything)
    episodes: list[EpisodeRow] = []
    for row_seed in range(seed, seed + seeds):
        drawn = rows(suite_name, task_name, n, row_seed, split)
        if own_target:
            whole = rows(suite_name, task_name, seed=row_seed)
            drawn = starts.with_object(drawn, own_target, whole)
        episodes.extend(drawn)
    return tuple(episodes)


def _with_others(row: EpisodeRow, name: str) -> EpisodeRow:
    """The row of -red or -twins: other look-alikes in the places of its own."""
    alike = [
        place.model
        for place in row.placements[1:]
        if objects.get_object(place.model).category == row.category
    ]
    if name.endswith(RED):
        others: Iterable[str] = (f"{alike[0]}{RED}", *alike[1:])
    else:
        others = shared.hardest(row.target.removesuffix("-personal"))[:: (-1) ** row.episode]
    new = dict(zip(alike, others, strict=True))
    placements = [replace(each, model=new.get(each.model, each.model)) for each in row.placements]
    return replace(row, suite=name, placements=tuple(placements))


def _check_names(names: set[str], known: set[str], where: str) -> None:
    unknown = names - known
    if unknown:
        raise BadSuite(
            f"suites: {where}: unknown {sorted(unknown)}; known: {', '.join(sorted(known))}."
        )
