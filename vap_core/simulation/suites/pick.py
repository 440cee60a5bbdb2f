"""The warm-up suites of the demo: pick up one of three objects of the same category.

Any number of episodes is generated from the seed.
"""

import zlib

import numpy as np
from jaxtyping import Float64

from vap_core.base.types import value
from vap_core.simulation.suites.layout import place_at_random_yaws
from vap_core.simulation.suites.suite import Suite, Task
from vap_core.simulation.types import EpisodeRow

CATEGORIES = (
    "cup",
    "bottle",
    "pen holder",
    "straw cup",
    "owl figurine",
    "vase",
    "camera",
    "shaver",
)


@value
class Arrangement:
    """Three places in a row across the table, as the front camera sees it: metres, world frame.

    Places lie `spread_m` apart around (`x_m`, 0); the row as a whole shifts by up to `shift_m`
    sideways and every object by up to `jitter_m` = (x, y); centres stay `clearance_m` apart, room
    for a gripper between them.
    """

    x_m: float
    spread_m: float
    shift_m: float
    jitter_m: tuple[float, float]
    clearance_m: float

    def __post_init__(self) -> None:
        if self.spread_m - 2 * self.jitter_m[1] < self.clearance_m - 1e-9:
            raise ValueError(
                f"Arrangement: places {self.spread_m} m apart that jitter by {self.jitter_m[1]} m "
                f"cannot keep {self.clearance_m} m clear"
            )


def _pick_tasks(max_steps: int) -> tuple[Task, ...]:
    tasks = []
    for category in CATEGORIES:
        slug = category.replace(" ", "-")
        tasks.append(
            Task(
                name=f"pick-{slug}",
                category=category,
                instruction=f"pick up my {category}",
                max_steps=max_steps,
            )
        )
    return tuple(tasks)


WIDOWX = Suite(
    name="widowx-pick", robot="wx250s", hz=5.0, cameras=("front",), tasks=_pick_tasks(60)
)
FRANKA = Suite(
    name="franka-pick",
    robot="panda",
    hz=10.0,
    cameras=("front", "side", "wrist"),
    tasks=_pick_tasks(100),
)
ARRANGEMENTS = {
    WIDOWX.name: Arrangement(
        x_m=0.27, spread_m=0.13, shift_m=0.015, jitter_m=(0.025, 0.02), clearance_m=0.09
    ),
    FRANKA.name: Arrangement(
        x_m=0.48, spread_m=0.14, shift_m=0.015, jitter_m=(0.03, 0.015), clearance_m=0.11
    ),
}


def rows(suite: Suite, task: Task, n: int, seed: int) -> tuple[EpisodeRow, ...]:
    """The first `n` episodes; the target stands in each of the three places equally often.

    The order is drawn by `seed`. Episode i depends on (suite, task, seed, i) alone: asking for more
    episodes leaves the first ones as they were.
    """
    return tuple(_row(suite, task, episode, seed) for episode in range(n))


def _row(suite: Suite, task: Task, episode: int, seed: int) -> EpisodeRow:
    name = zlib.crc32(f"{suite.name}.{task.name}".encode())
    block = np.random.default_rng([seed, episode // 3, name, 1]).permutation(3)
    rng = np.random.default_rng([seed, episode, name])
    target = int(block[episode % 3])
    others = rng.permutation([slot for slot in range(3) if slot != target])
    places = _places(ARRANGEMENTS[suite.name], rng)
    slots = [target, *others.tolist()]
    models = [task.personal, f"{task.stem}-lookalike-1", f"{task.stem}-lookalike-2"]
    spots = [(places[slot, 0], places[slot, 1]) for slot in slots]
    placements = place_at_random_yaws(rng, models, spots)
    return suite.row(task, episode, tuple(placements), seed=seed)


def _places(arrangement: Arrangement, rng: np.random.Generator) -> Float64[np.ndarray, "3 2"]:
    """The three places of one episode, from the camera's left to its right (x, y metres)."""
    shift = rng.uniform(-arrangement.shift_m, arrangement.shift_m)
    row = arrangement.spread_m * np.array([-1.0, 0.0, 1.0]) + shift
    jitter = rng.uniform(-1.0, 1.0, (3, 2)) * arrangement.jitter_m
    return np.stack([arrangement.x_m + jitter[:, 0], row + jitter[:, 1]], axis=1)
