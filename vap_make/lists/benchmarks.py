"""The benchmarks' lists.

simpler-fractal, pick: 3 orientations x 5 x 5 places x 4 robot colours = 300, and x 11 variants =
825; an orientation is a turn about the vertical (SIMPLER also lays its can down). Move near: 40
layouts x 4 = 160, and x 10 variants = 400. The split 300 + 160 and 825 + 400 is inferred from
SIMPLER's scripts; the paper gives 460 and 1225. simpler-bridge: 12 ordered pairs of the corners of
a 15 cm square x 2 rotations = 24; look-alikes take the other corners. vlabench: 5 tasks x 50
episodes. tabletop: 8 tasks x 20.
"""

from collections.abc import Sequence
from itertools import permutations, product

import numpy as np

from vap_core.simulation.suites.benchmarks import BOWL, BRIDGE, FRACTAL, TABLETOP, VLABENCH
from vap_core.simulation.suites.layout import (
    Area,
    draw_lookalikes,
    nearest_m,
    place,
    place_at_random_yaws,
    radius_m,
    random_yaw,
    scatter,
    scattered,
)
from vap_core.simulation.suites.suite import AGGREGATION, MATCHING, VARIANTS, Task
from vap_core.simulation.types import EpisodeRow, Placement

DESK = Area(x0=0.40, x1=0.63, y0=-0.22, y1=0.22)
"""The Google Robot's grid: 23 cm deep, 44 cm wide."""
GRID = 5
ORIENTATIONS = 3
LAYOUTS = 40
CENTRE = (0.265, 0.0)
CORNER_M = 0.075
APART_M = 0.22
"""Every bottle starts at least this far from the can."""
BESIDE_M = 0.10
"""Places of the pick grid that are in use at once are at least this far apart."""
NOVEL = 9000
"""Distractors are generic instances from here on, which no training draws."""


def fractal_rows() -> tuple[EpisodeRow, ...]:
    """All 460 + 1225 episodes.

    The layouts are the same under every variant, so that variants compare pairwise.
    """
    pick, near = FRACTAL.tasks
    cells = product(range(ORIENTATIONS), range(GRID * GRID))
    pick_layouts = [_pick(pick, turn, cell) for turn, cell in cells]
    near_layouts = [_near(near, i) for i in range(LAYOUTS)]
    near_variants = [name for name in AGGREGATION if name != "distractors-many"]
    return (
        *_rows_of_variants(pick, pick_layouts, AGGREGATION),
        *_rows_of_variants(near, near_layouts, near_variants),
    )


def bridge_rows() -> tuple[EpisodeRow, ...]:
    """All 4 x 24 episodes."""
    return BRIDGE.rows_of(24, _square)


def _rows_of_variants(
    task: Task, layouts: Sequence[tuple[Placement, ...]], aggregation: Sequence[str]
) -> list[EpisodeRow]:
    """Every layout under every variant of visual matching, then of variant aggregation."""
    settings = [("visual matching", variant) for variant in MATCHING]
    settings += [("variant aggregation", variant) for variant in aggregation]
    rows: list[EpisodeRow] = []
    for split, variant in settings:
        n_distractors = VARIANTS[variant].distractors
        for i, layout in enumerate(layouts):
            placements = _add_distractors(task, i, layout, n_distractors)
            rows.append(FRACTAL.row(task, len(rows), placements, split=split, variant=variant))
    return rows


def _pick(task: Task, turn: int, cell: int) -> tuple[Placement, ...]:
    """The target in one cell of the grid, the look-alikes in others.

    So neither place nor yaw reveals the target.
    """
    rng = np.random.default_rng([41, turn, cell])
    yaw = random_yaw(np.random.default_rng([45, cell])) + 2 * np.pi / ORIENTATIONS * turn
    shares = product(np.arange(GRID) / (GRID - 1), repeat=2)
    grid = [DESK.at(float(u), float(v)) for u, v in shares]
    taken = [grid[cell]]
    for i in rng.permutation(len(grid)).tolist():
        if len(taken) < 3 and nearest_m(grid[i], taken) > BESIDE_M:
            taken.append(grid[i])
    target = place(task.personal, grid[cell], yaw)
    return (target, *place_at_random_yaws(rng, draw_lookalikes(rng, task.stem), taken[1:]))


def _near(task: Task, layout: int) -> tuple[Placement, ...]:
    """The can with free space around it, and three bottles.

    The target is the nearest one to the can, the middle one and the farthest in turn.
    """
    rng = np.random.default_rng([42, layout])
    names = draw_lookalikes(rng, task.stem)
    wide = max(map(radius_m, [task.personal, *names]))
    while True:
        can, *bottles = scatter(rng, DESK, [0.06, wide, wide, wide], gap_m=0.065)
        distances = sorted((nearest_m(bottle, [can]), bottle) for bottle in bottles)
        if distances[0][0] > APART_M and DESK.x0 + 0.03 < can[0] < DESK.x1 - 0.03:
            break
    _, target = distances.pop(layout % 3)
    first, second = rng.permutation(2)
    spots = [target, can, distances[first][1], distances[second][1]]
    return tuple(place_at_random_yaws(rng, [task.personal, task.goal, *names], spots))


def _add_distractors(
    task: Task, layout: int, placements: tuple[Placement, ...], n_distractors: int
) -> tuple[Placement, ...]:
    """The same layout with more objects of other kinds around."""
    if not n_distractors:
        return placements
    rng = np.random.default_rng([43, layout, n_distractors, len(placements)])
    kinds = ["cup", "straw cup", "owl figurine", "camera", "vase"]
    if task.category in kinds:
        kinds.remove(task.category)
    names = []
    for kind in rng.permutation(kinds)[:n_distractors]:
        number = NOVEL + int(rng.integers(20))
        names.append(f"{str(kind).replace(' ', '-')}-generic-{number}")
    fixed = []
    for placed in placements:
        radius = 0.06 if placed.model == task.goal else radius_m(placed.model)
        fixed.append(((placed.x, placed.y), radius))
    radii = list(map(radius_m, names))
    spots = scatter(rng, DESK, radii, fixed=fixed, gap_m=0.05)
    return (*placements, *place_at_random_yaws(rng, names, spots))


def _square(task: Task, episode: int) -> tuple[Placement, ...]:
    """The target and the goal on two corners of a square, the look-alikes on the others."""
    name = task.name.encode()
    rng = np.random.default_rng([44, *name, episode])
    steps = product((-CORNER_M, CORNER_M), repeat=2)
    corners = [(CENTRE[0] + i, CENTRE[1] + j) for i, j in steps]
    orders = list(permutations(range(4), 2))
    target, goal = orders[episode % 12]
    others = [corners[i] for i in range(4) if i not in (target, goal)]
    turn = random_yaw(np.random.default_rng([46, *name, episode % 12]))
    yaw = turn + 0.5 * np.pi * (episode // 12)
    placements = [place(task.personal, corners[target], yaw)]
    if task.goal:
        placements.append(place(task.goal, corners[goal], 0.0))
    return (*placements, *place_at_random_yaws(rng, draw_lookalikes(rng, task.stem), others))


VLABENCH_TABLE = Area(x0=0.38, x1=0.54, y0=-0.17, y1=0.17)
VLABENCH_EPISODES = 50


def vlabench_rows() -> tuple[EpisodeRow, ...]:
    """All 5 x 50 episodes."""
    return VLABENCH.rows_of(VLABENCH_EPISODES, _on_table)


def _on_table(task: Task, episode: int) -> tuple[Placement, ...]:
    rng = np.random.default_rng([51, *task.name.encode(), episode])
    names = [task.personal, *draw_lookalikes(rng, task.stem)]
    return scattered(rng, VLABENCH_TABLE, names, gap_m=0.05)


TABLETOP_TABLE = Area(x0=0.15, x1=0.30, y0=-0.19, y1=0.19)
REACH = Area(x0=0.165, x1=0.275, y0=-0.145, y1=0.145)
"""Where the SO-101 grasps from above.

All three objects of a put stand here, so that their places do not reveal the target.
"""
BOWLS = ((0.215, 0.16), (0.215, -0.16))
"""The bowl stands on one side or the other."""
TABLETOP_EPISODES = 20


def tabletop_rows() -> tuple[EpisodeRow, ...]:
    """All 8 x 20 episodes."""
    return TABLETOP.rows_of(TABLETOP_EPISODES, _on_desk)


def _on_desk(task: Task, episode: int) -> tuple[Placement, ...]:
    rng = np.random.default_rng([61, *task.name.encode(), episode])
    names = [task.personal, *draw_lookalikes(rng, task.stem)]
    bowl = BOWLS[int(rng.integers(2))]
    if not task.goal:
        return scattered(rng, TABLETOP_TABLE, names, gap_m=0.035)
    fixed = [(bowl, radius_m(BOWL) / np.sqrt(2))]
    target, *lookalikes = scattered(rng, REACH, names, gap_m=0.03, fixed=fixed)
    return (target, place(BOWL, bowl, 0.0), *lookalikes)
