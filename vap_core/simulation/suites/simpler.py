"""Personalised SIMPLER, protocol-matched in MuJoCo (P 4, tab:object_specs): Google Robot (Fractal) and WidowX (Bridge).

Fractal, pick: 3 orientations x 5 x 5 places x 4 robot colours = 300, and x 11 variants = 825; an orientation is a turn about the vertical
(SIMPLER also lays its can down). Move near: 40 layouts x 4 = 160, and x 10 variants = 400. The split 300 + 160 and 825 + 400 is inferred
from SIMPLER's scripts; the paper gives 460 and 1225. Bridge: 12 ordered pairs of the corners of a 15 cm square x 2 rotations = 24; look-alikes
take the other corners.
"""

from itertools import permutations

import numpy as np

from vap_core.simulation.assets import objects
from vap_core.simulation.suites.layout import Area, Spot, place, radius_m, rivals, scatter, turned
from vap_core.simulation.suites.suite import Suite, Task
from vap_core.simulation.suites.variants import AGGREGATION, MATCHING, VARIANTS
from vap_core.simulation.types import EpisodeRow, Placement

FRACTAL = Suite(
    name="simpler-fractal",
    robot="google",
    hz=3.0,
    cameras=("head",),
    tasks=(
        Task("pick-pen-holder", "pen holder", "pick my pen holder", 80),
        Task(
            "move-bottle-near-coke-can",
            "bottle",
            "move my bottle near coke can",
            80,
            "near",
            "coke-can-prop",
        ),
    ),
)
BRIDGE = Suite(
    name="simpler-bridge",
    robot="wx250s",
    hz=5.0,
    cameras=("front",),
    tasks=(
        Task("pick-shaver", "shaver", "pick up my shaver", 60),
        Task("put-camera", "camera", "put my camera on the plate", 60, "put", "plate-prop"),
        Task(
            "put-owl-figurine",
            "owl figurine",
            "put my owl figurine on the plate",
            60,
            "put",
            "plate-prop",
        ),
        Task(
            "put-straw-cup",
            "straw cup",
            "put my straw cup in the basket",
            120,
            "put",
            "basket-prop",
        ),
    ),
)
DESK = Area(0.40, 0.63, -0.22, 0.22)
"""The Google Robot's grid: 23 cm deep, 44 cm wide."""
GRID, ORIENTATIONS, LAYOUTS = 5, 3, 40
CENTRE, CORNER_M = (0.265, 0.0), 0.075
APART_M = 0.22
"""Every bottle starts at least this far from the can."""
BESIDE_M = 0.10
"""Places of the pick grid that are in use at once are at least this far apart."""
NOVEL = 9000
"""Distractors are generic instances from here on, which no training draws."""


def fractal_rows() -> tuple[EpisodeRow, ...]:
    """All 460 + 1225 episodes. The same layouts return under every variant, so that variants compare pairwise."""
    pick, near = FRACTAL.tasks
    picks = [_pick(pick, turn, i) for turn in range(ORIENTATIONS) for i in range(GRID * GRID)]
    nears = [_near(near, i) for i in range(LAYOUTS)]
    return (
        *_tracks(pick, picks, AGGREGATION),
        *_tracks(near, nears, tuple(name for name in AGGREGATION if name != "distractors-many")),
    )


def bridge_rows() -> tuple[EpisodeRow, ...]:
    """All 4 x 24 episodes."""
    return tuple(BRIDGE.row(task, i, _square(task, i)) for task in BRIDGE.tasks for i in range(24))


def _tracks(
    task: Task, layouts: list[tuple[Placement, ...]], aggregation: tuple[str, ...]
) -> list[EpisodeRow]:
    settings = [("visual matching", name) for name in MATCHING] + [
        ("variant aggregation", name) for name in aggregation
    ]
    return [
        FRACTAL.row(
            task,
            i * len(layouts) + j,
            _crowded(task, j, layout, VARIANTS[variant].distractors),
            split=split,
            variant=variant,
        )
        for i, (split, variant) in enumerate(settings)
        for j, layout in enumerate(layouts)
    ]


def _pick(task: Task, turn: int, cell: int) -> tuple[Placement, ...]:
    """The look-alikes stand on other places of the grid, so that neither place nor yaw tells the target."""
    rng, spin = np.random.default_rng([41, turn, cell]), turned(np.random.default_rng([45, cell]))
    grid = [DESK.at(i / (GRID - 1), j / (GRID - 1)) for i in range(GRID) for j in range(GRID)]
    others: list[Spot] = []
    for i in rng.permutation(len(grid)).tolist():
        if len(others) < 2 and all(
            np.hypot(grid[i][0] - x, grid[i][1] - y) > BESIDE_M for x, y in (grid[cell], *others)
        ):
            others.append(grid[i])
    rest = (
        place(name, at, turned(rng))
        for name, at in zip(rivals(rng, task.stem), others, strict=True)
    )
    return place(task.personal, grid[cell], spin + 2 * np.pi / ORIENTATIONS * turn), *rest


def _near(task: Task, layout: int) -> tuple[Placement, ...]:
    """The can keeps clear all around, so that there is room beside it; the target is the nearest to it, the middle one and the farthest in turn."""
    rng = np.random.default_rng([42, layout])
    names = rivals(rng, task.stem)
    wide = max(radius_m(name) for name in (task.personal, *names))
    while True:
        can, *bottles = scatter(rng, DESK, [0.06, wide, wide, wide], gap_m=0.065)
        far = sorted((float(np.hypot(can[0] - x, can[1] - y)), (x, y)) for x, y in bottles)
        if far[0][0] > APART_M and DESK.x0 + 0.03 < can[0] < DESK.x1 - 0.03:
            break
    mine = far.pop(layout % 3)[1]
    others = [far[i][1] for i in rng.permutation(2)]
    placed = zip((task.personal, task.goal, *names), (mine, can, *others), strict=True)
    return tuple(place(name, spot, turned(rng)) for name, spot in placed)


def _crowded(
    task: Task, layout: int, placements: tuple[Placement, ...], distractors: int
) -> tuple[Placement, ...]:
    """The same layout with more objects of other kinds around."""
    if not distractors:
        return placements
    rng = np.random.default_rng([43, layout, distractors, len(placements)])
    kinds = [
        kind
        for kind in ("cup", "straw cup", "owl figurine", "camera", "vase")
        if kind != task.category
    ]
    models = [
        objects.generic_instance(str(kind), NOVEL + int(rng.integers(20)))
        for kind in rng.permutation(kinds)[:distractors]
    ]
    fixed = [((p.x, p.y), 0.06 if p.model == task.goal else radius_m(p.model)) for p in placements]
    spots = scatter(rng, DESK, [radius_m(model.name) for model in models], fixed, gap_m=0.05)
    return (
        *placements,
        *(place(model.name, spot, turned(rng)) for model, spot in zip(models, spots, strict=True)),
    )


def _square(task: Task, episode: int) -> tuple[Placement, ...]:
    rng = np.random.default_rng([44, *task.name.encode(), episode])
    mine, goal = list(permutations(range(4), 2))[episode % 12]
    corners = [
        (CENTRE[0] + CORNER_M * i, CENTRE[1] + CORNER_M * j) for i in (-1, 1) for j in (-1, 1)
    ]
    others = [i for i in range(4) if i not in (mine, goal)]
    yaw = turned(np.random.default_rng([46, *task.name.encode(), episode % 12])) + 0.5 * np.pi * (
        episode // 12
    )
    placed = [place(task.personal, corners[mine], yaw)]
    if task.goal:
        placed.append(place(task.goal, corners[goal], 0.0))
    return (
        *placed,
        *(
            place(name, corners[i], turned(rng))
            for name, i in zip(rivals(rng, task.stem), others, strict=True)
        ),
    )
