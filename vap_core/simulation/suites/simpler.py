"""Personalised SIMPLER, protocol-matched in MuJoCo (P 4, tab:object_specs).

Google Robot (Fractal), pick: 3 orientations x 5 x 5 places x 4 robot colours = 300, and x 11
variants = 825; an orientation is a turn about the vertical (SIMPLER also lays its can down). Move
near: 40 layouts x 4 = 160, and x 10 variants = 400. The split 300 + 160 and 825 + 400 is inferred
from SIMPLER's scripts; the paper gives 460 and 1225. WidowX (Bridge): 12 ordered pairs of the
corners of a 15 cm square x 2 rotations = 24; look-alikes take the other corners.
"""

from collections.abc import Sequence
from itertools import permutations, product

import numpy as np

from vap_core.simulation.suites.layout import (
    Area,
    draw_lookalikes,
    nearest_m,
    place,
    place_at_random_yaws,
    radius_m,
    random_yaw,
    scatter,
)
from vap_core.simulation.suites.suite import Suite, Task
from vap_core.simulation.suites.variants import AGGREGATION, MATCHING, VARIANTS
from vap_core.simulation.types import EpisodeRow, Placement

FRACTAL = Suite(
    name="simpler-fractal",
    robot="google",
    hz=3.0,
    cameras=("head",),
    tasks=(
        Task(
            name="pick-pen-holder",
            category="pen holder",
            instruction="pick my pen holder",
            max_steps=80,
        ),
        Task(
            name="move-bottle-near-coke-can",
            category="bottle",
            instruction="move my bottle near coke can",
            max_steps=80,
            rule="near",
            goal="coke-can-prop",
        ),
    ),
)
BRIDGE = Suite(
    name="simpler-bridge",
    robot="wx250s",
    hz=5.0,
    cameras=("front",),
    tasks=(
        Task(
            name="pick-shaver",
            category="shaver",
            instruction="pick up my shaver",
            max_steps=60,
        ),
        Task(
            name="put-camera",
            category="camera",
            instruction="put my camera on the plate",
            max_steps=60,
            rule="put",
            goal="plate-prop",
        ),
        Task(
            name="put-owl-figurine",
            category="owl figurine",
            instruction="put my owl figurine on the plate",
            max_steps=60,
            rule="put",
            goal="plate-prop",
        ),
        Task(
            name="put-straw-cup",
            category="straw cup",
            instruction="put my straw cup in the basket",
            max_steps=120,
            rule="put",
            goal="basket-prop",
        ),
    ),
)
DESK = Area(x0=0.40, x1=0.63, y0=-0.22, y1=0.22)
"""The Google Robot's grid: 23 cm deep, 44 cm wide."""
FILMED_AREA = Area(0.18, 0.35, -0.095, 0.095)
"""Where the films of simpler-bridge's policies show objects."""
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
    pick_layouts = []
    for turn, cell in product(range(ORIENTATIONS), range(GRID * GRID)):
        pick_layouts.append(_pick(pick, turn, cell))
    near_layouts = []
    for i in range(LAYOUTS):
        near_layouts.append(_near(near, i))
    near_variants = list(AGGREGATION)
    near_variants.remove("distractors-many")
    return (
        *_rows_of_variants(pick, pick_layouts, AGGREGATION),
        *_rows_of_variants(near, near_layouts, near_variants),
    )


def bridge_rows() -> tuple[EpisodeRow, ...]:
    """All 4 x 24 episodes."""
    rows = []
    for task, i in product(BRIDGE.tasks, range(24)):
        rows.append(BRIDGE.row(task, i, _square(task, i)))
    return tuple(rows)


def _rows_of_variants(
    task: Task, layouts: Sequence[tuple[Placement, ...]], aggregation: Sequence[str]
) -> list[EpisodeRow]:
    """Every layout under every variant of visual matching, then of variant aggregation."""
    settings = []
    for variant in MATCHING:
        settings.append(("visual matching", variant))
    for variant in aggregation:
        settings.append(("variant aggregation", variant))
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
    grid = []
    for i, j in product(range(GRID), range(GRID)):
        grid.append(DESK.at(i / (GRID - 1), j / (GRID - 1)))
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
        distances = []
        for x, y in bottles:
            distances.append((float(np.hypot(can[0] - x, can[1] - y)), (x, y)))
        distances.sort()
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
    corners = []
    for i, j in product((-1, 1), (-1, 1)):
        corners.append((CENTRE[0] + CORNER_M * i, CENTRE[1] + CORNER_M * j))
    orders = list(permutations(range(4), 2))
    target, goal = orders[episode % 12]
    others = [corners[i] for i in range(4) if i not in (target, goal)]
    turn = random_yaw(np.random.default_rng([46, *name, episode % 12]))
    yaw = turn + 0.5 * np.pi * (episode // 12)
    placements = [place(task.personal, corners[target], yaw)]
    if task.goal:
        placements.append(place(task.goal, corners[goal], 0.0))
    return (*placements, *place_at_random_yaws(rng, draw_lookalikes(rng, task.stem), others))
