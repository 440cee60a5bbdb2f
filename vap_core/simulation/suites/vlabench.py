"""Personalised VLABench, protocol-matched in MuJoCo (P 4): 5 tasks x 50 episodes.

The personal object is selected by touching it; three cameras, joint control.
"""

import numpy as np

from vap_core.simulation.suites.layout import Area, draw_lookalikes, scattered
from vap_core.simulation.suites.suite import Suite, Task
from vap_core.simulation.types import EpisodeRow, Placement


def _select(category: str, max_steps: int, slug: str = "") -> Task:
    return Task(
        name=f"select-{category.replace(' ', '-')}",
        category=category,
        instruction=f"select my {category}",
        max_steps=max_steps,
        rule="selected",
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
TABLE = Area(x0=0.38, x1=0.54, y0=-0.17, y1=0.17)
EPISODES = 50


def rows() -> tuple[EpisodeRow, ...]:
    """All 5 x 50 episodes."""
    return VLABENCH.rows_of(EPISODES, _placements)


def _placements(task: Task, episode: int) -> tuple[Placement, ...]:
    rng = np.random.default_rng([51, *task.name.encode(), episode])
    names = [task.personal, *draw_lookalikes(rng, task.stem)]
    return scattered(rng, TABLE, names, gap_m=0.05)
