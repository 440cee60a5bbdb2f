"""Development lists: everything that is tuned is tuned on them, never on the benchmarks' lists.

`simpler-bridge-dev` has the robot, tasks and rules of simpler-bridge, and none of its layouts. Its
personal object is a generic instance that no training draws, its look-alikes are that instance's
twins; the benchmark's own personal object and look-alikes never appear.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import permutations, product

import numpy as np

from vap_core.simulation.suites import DEVELOPMENT
from vap_core.simulation.suites.layout import (
    Spot,
    nearest_m,
    place,
    place_at_random_yaws,
    radius_m,
    scatter,
    scattered,
)
from vap_core.simulation.suites.suite import Suite, Task
from vap_core.simulation.types import EpisodeRow, Placement
from vap_make.lists import benchmarks

INSTANCE = 9501
"""The personal object of every kind: training shows instances below 400, and from 100,000 on. (The
straw cup 9500 is too wide for the WidowX.)"""
TWINS = 6
"""Look-alikes of every personal object."""
TURNS_RAD = (np.deg2rad(5), np.deg2rad(12))
"""By how much the square of simpler-bridge is turned, to either side."""

type Layout = Callable[[np.random.Generator, Task, int, list[str]], tuple[Placement, ...]]
"""Places of one episode for the target, two look-alikes and the goal of a task."""


def rows(known: Suite) -> tuple[EpisodeRow, ...]:
    """The development list of a benchmark."""
    layout, episodes = LAYOUTS[known.name]
    tuned_on = replace(known, name=f"{known.name}{DEVELOPMENT}")
    listed = []
    for task, episode in product(known.tasks, range(episodes)):
        rng = np.random.default_rng([81, *f"{known.name} {task.name}".encode(), episode])
        twins = rng.permutation(np.arange(1, TWINS + 1))[:2].tolist()
        names = [instance(task, twin) for twin in (0, *twins)]
        listed.append(tuned_on.row(task, episode, layout(rng, task, episode, names)))
    return tuple(listed)


def instance(task: Task, twin: int = 0) -> str:
    """The personal object of a task, or one of its look-alikes."""
    return f"{task.stem}-generic-{INSTANCE}" + (f"-{twin}" if twin else "")


def _square(
    rng: np.random.Generator, task: Task, episode: int, names: list[str]
) -> tuple[Placement, ...]:
    """On the corners of simpler-bridge's square, turned; every ordered pair of corners in turn."""
    turn = float(rng.uniform(*TURNS_RAD)) * (-1) ** (episode // 12)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    corners: list[Spot] = []
    for corner in product((-benchmarks.CORNER_M, benchmarks.CORNER_M), repeat=2):
        x, y = rotation @ corner + benchmarks.CENTRE
        corners.append((float(x), float(y)))
    orders = list(permutations(range(4), 2))
    first, goal = orders[episode % 12]
    others = [corners[i] for i in range(4) if i not in (first, goal)]
    target, *rivals = place_at_random_yaws(rng, names, [corners[first], *others])
    if not task.goal:
        return (target, *rivals)
    return (target, place(task.goal, corners[goal], 0.0), *rivals)


def _desk(
    rng: np.random.Generator, task: Task, episode: int, names: list[str]
) -> tuple[Placement, ...]:
    """Between the places of simpler-fractal's grid, or around the goal."""
    if task.goal:
        return _around_the_goal(rng, task, episode, names)
    steps = benchmarks.GRID - 1
    cells = product(range(steps), repeat=2)
    grid = [benchmarks.DESK.at((i + 0.5) / steps, (j + 0.5) / steps) for i, j in cells]
    taken = [grid[episode % len(grid)]]
    for i in rng.permutation(len(grid)).tolist():
        if len(taken) < 3 and nearest_m(grid[i], taken) > benchmarks.BESIDE_M:
            taken.append(grid[i])
    return tuple(place_at_random_yaws(rng, names, taken))


def _around_the_goal(
    rng: np.random.Generator, task: Task, episode: int, names: list[str]
) -> tuple[Placement, ...]:
    """The target is the nearest to the goal, the middle one and the farthest in turn."""
    wide = max(map(radius_m, names))
    while True:
        goal, *spots = scatter(rng, benchmarks.DESK, [0.06, wide, wide, wide], gap_m=0.065)
        spots.sort(key=lambda spot: nearest_m(spot, [goal]))
        edge_m = min(goal[0] - benchmarks.DESK.x0, benchmarks.DESK.x1 - goal[0])
        if nearest_m(spots[0], [goal]) > benchmarks.APART_M and edge_m > 0.03:
            break
    first = spots.pop(episode % 3)
    target, *rivals = place_at_random_yaws(rng, names, [first, *spots])
    return (target, place(task.goal, goal, 0.0), *rivals)


def _table(
    rng: np.random.Generator, task: Task, episode: int, names: list[str]
) -> tuple[Placement, ...]:
    """Anywhere on vlabench's table."""
    return scattered(rng, benchmarks.VLABENCH_TABLE, names, gap_m=0.05)


def _tabletop(
    rng: np.random.Generator, task: Task, episode: int, names: list[str]
) -> tuple[Placement, ...]:
    """Anywhere on the desk of the SO-101, or within its reach beside the bowl."""
    if not task.goal:
        return scattered(rng, benchmarks.TABLETOP_TABLE, names, gap_m=0.035)
    bowl = benchmarks.BOWLS[episode % 2]
    fixed = [(bowl, radius_m(task.goal) / np.sqrt(2))]
    target, *rivals = scattered(rng, benchmarks.REACH, names, gap_m=0.03, fixed=fixed)
    return (target, place(task.goal, bowl, 0.0), *rivals)


LAYOUTS: Mapping[str, tuple[Layout, int]] = {
    "simpler-fractal": (_desk, 48),
    "simpler-bridge": (_square, 24),
    "vlabench": (_table, 20),
    "tabletop": (_tabletop, 12),
}
"""The layouts of every benchmark's development list, and its episodes per task."""
