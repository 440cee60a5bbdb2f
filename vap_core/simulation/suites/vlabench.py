"""Personalised VLABench, protocol-matched in MuJoCo (P 4): select the personal object by touching it, three cameras, joint control, 5 x 50."""

import numpy as np

from vap_core.simulation.suites.layout import Area, place, radius_m, rivals, scatter, turned
from vap_core.simulation.suites.suite import Suite, Task
from vap_core.simulation.types import EpisodeRow, Placement


def _select(category: str, max_steps: int, slug: str = "") -> Task:
    return Task(
        f"select-{category.replace(' ', '-')}",
        category,
        f"select my {category}",
        max_steps,
        "selected",
        slug=slug,
    )


VLABENCH = Suite(
    name="vlabench",
    robot="panda",
    hz=10.0,
    cameras=("front", "side", "wrist"),
    control="joint",
    tasks=(
        _select("leather bag", 150),
        _select("shoe", 150),
        _select("cat figurine", 150),
        _select("miniature house", 150),
        _select("cup", 200, "paper-cup"),
    ),
)
TABLE = Area(0.38, 0.54, -0.17, 0.17)
EPISODES = 50


def rows() -> tuple[EpisodeRow, ...]:
    """All 5 x 50 episodes."""
    return tuple(
        VLABENCH.row(task, i, _scene(task, i)) for task in VLABENCH.tasks for i in range(EPISODES)
    )


def _scene(task: Task, episode: int) -> tuple[Placement, ...]:
    rng = np.random.default_rng([51, *task.name.encode(), episode])
    names = [task.personal, *rivals(rng, task.stem)]
    spots = scatter(rng, TABLE, [radius_m(name) for name in names], gap_m=0.05)
    return tuple(place(name, spot, turned(rng)) for name, spot in zip(names, spots, strict=True))
