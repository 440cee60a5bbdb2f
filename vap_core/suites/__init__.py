"""Suites: which robot, cameras, tasks and steps, and the episode rows they are made of. Reading them loads no simulator."""

import zlib

import numpy as np
from jaxtyping import Float64

from vap_core.errors import one_of
from vap_core.suites.pick import Judge as Judge
from vap_core.values import EpisodeRow, Placement, value


@value
class Task:
    """One task: a category, its personalised instruction, and how many control steps it may take."""

    name: str
    category: str
    instruction: str
    max_steps: int

    @property
    def models(self) -> tuple[str, str, str]:
        """Object models of an episode: the personal one, then its two look-alikes."""
        stem = self.category.replace(" ", "-")
        return f"{stem}-personal", f"{stem}-lookalike-1", f"{stem}-lookalike-2"


@value
class Arrangement:
    """Three places in a row across the table, as the front camera sees it: metres, world frame.

    Places lie `spread_m` apart around (`x_m`, 0); the row as a whole shifts by up to `shift_m` sideways and every object by up
    to `jitter_m` = (x, y); centres stay `clearance_m` apart, room for a gripper between them.
    """

    x_m: float
    spread_m: float
    shift_m: float
    jitter_m: tuple[float, float]
    clearance_m: float

    def __post_init__(self) -> None:
        if self.spread_m - 2 * self.jitter_m[1] < self.clearance_m - 1e-9:
            raise ValueError(
                f"Arrangement: places {self.spread_m} m apart that jitter by {self.jitter_m[1]} m cannot keep {self.clearance_m} m clear"
            )


@value
class Suite:
    """A set of tasks on one robot; `max_steps` and `hz` set the episode's length."""

    name: str
    robot: str
    hz: float
    cameras: tuple[str, ...]
    max_steps: int
    tasks: tuple[Task, ...]
    arrangement: Arrangement

    def task(self, name: str) -> Task:
        """The task called `name`. Raises: UnknownName."""
        for task in self.tasks:
            if task.name == name:
                return task
        raise one_of(f"suite {self.name}: task", name, [task.name for task in self.tasks])


CATEGORIES = ("cup", "bottle", "pen holder", "straw cup", "owl figurine", "vase", "camera", "shaver")


def _picks(max_steps: int) -> tuple[Task, ...]:
    return tuple(Task(f"pick-{c.replace(' ', '-')}", c, f"pick up my {c}", max_steps) for c in CATEGORIES)


SUITES: dict[str, Suite] = {
    "widowx-pick": Suite(
        name="widowx-pick",
        robot="wx250s",
        hz=5.0,
        cameras=("front",),
        max_steps=60,
        tasks=_picks(60),
        arrangement=Arrangement(x_m=0.27, spread_m=0.13, shift_m=0.015, jitter_m=(0.025, 0.02), clearance_m=0.09),
    ),
    "franka-pick": Suite(
        name="franka-pick",
        robot="panda",
        hz=10.0,
        cameras=("front", "side", "wrist"),
        max_steps=100,
        tasks=_picks(100),
        arrangement=Arrangement(x_m=0.48, spread_m=0.14, shift_m=0.015, jitter_m=(0.03, 0.015), clearance_m=0.11),
    ),
}


def suite(name: str) -> Suite:
    """The suite called `name`. Raises: UnknownName."""
    if name not in SUITES:
        raise one_of("suites.suite: suite", name, SUITES)
    return SUITES[name]


def rows(suite_name: str, task_name: str, n: int = 20, seed: int = 0) -> tuple[EpisodeRow, ...]:
    """The first `n` episodes of a task: the target stands in each of the three places equally often, in an order drawn by `seed`.

    Episode i depends on (suite, task, seed, i) alone: asking for more episodes leaves the first ones as they were.
    Raises: UnknownName for a suite or a task that no registry holds.
    """
    found = suite(suite_name)
    task = found.task(task_name)
    return tuple(_row(found, task, episode, seed) for episode in range(n))


def _row(suite: Suite, task: Task, episode: int, seed: int) -> EpisodeRow:
    name = zlib.crc32(f"{suite.name}.{task.name}".encode())
    block = np.random.default_rng([seed, episode // 3, name, 1]).permutation(3)
    rng = np.random.default_rng([seed, episode, name])
    target = int(block[episode % 3])
    others = rng.permutation([slot for slot in range(3) if slot != target])
    places = _places(suite.arrangement, rng)
    order = (target, *(int(slot) for slot in others))
    placements = tuple(
        Placement(model, round(float(places[slot, 0]), 4), round(float(places[slot, 1]), 4), round(float(rng.uniform(-np.pi, np.pi)), 4))
        for model, slot in zip(task.models, order, strict=True)
    )
    return EpisodeRow(suite.name, task.name, episode, seed, task.instruction, task.category, placements, task.max_steps)


def _places(arrangement: Arrangement, rng: np.random.Generator) -> Float64[np.ndarray, "3 2"]:
    """The three places of one episode, from the camera's left to its right (x, y metres)."""
    row = arrangement.spread_m * np.array([-1.0, 0.0, 1.0]) + rng.uniform(-arrangement.shift_m, arrangement.shift_m)
    jitter = rng.uniform(-1.0, 1.0, (3, 2)) * arrangement.jitter_m
    return np.stack([arrangement.x_m + jitter[:, 0], row + jitter[:, 1]], axis=1)
