"""The paper's real desk (P 4) in simulation: SO-101 with three cameras, 8 tasks x 20 episodes.

Four selections and four pick-and-places. Sensor noise, exposure and displaced cameras are drawn per
episode (sensor.DESK).
"""

import numpy as np

from vap_core.simulation.sensor import DESK
from vap_core.simulation.suites.layout import (
    Area,
    Spot,
    draw_lookalikes,
    place,
    radius_m,
    scattered,
)
from vap_core.simulation.suites.suite import Suite, Task
from vap_core.simulation.types import EpisodeRow, Placement

BOWL = "plastic-bowl-prop"


def _select(category: str) -> Task:
    return Task(
        name=f"select-{category}",
        category=category,
        instruction=f"select my {category}",
        max_steps=150,
        rule="selected",
    )


def _put(category: str) -> Task:
    return Task(
        name=f"put-{category.replace(' ', '-')}",
        category=category,
        instruction=f"put my {category} into the plastic bowl",
        max_steps=300,
        rule="put",
        goal=BOWL,
    )


TABLETOP = Suite(
    name="tabletop",
    robot="so101",
    hz=30.0,
    cameras=("front", "side", "wrist"),
    control="joint",
    sensor=DESK,
    tasks=(
        *map(_select, ("vase", "plushie", "cup", "slipper")),
        *map(_put, ("plant", "stuffed toy", "pouch", "scrubber")),
    ),
)
TABLE = Area(x0=0.15, x1=0.30, y0=-0.19, y1=0.19)
REACH = Area(x0=0.165, x1=0.275, y0=-0.145, y1=0.145)
"""Where the SO-101 grasps from above.

All three objects of a put stand here, so that their places do not reveal the target.
"""
BOWLS = ((0.215, 0.16), (0.215, -0.16))
"""The bowl stands on one side or the other."""
EPISODES = 20


def rows() -> tuple[EpisodeRow, ...]:
    """All 8 x 20 episodes."""
    return TABLETOP.rows_of(EPISODES, _placements)


def _placements(task: Task, episode: int) -> tuple[Placement, ...]:
    rng = np.random.default_rng([61, *task.name.encode(), episode])
    names = [task.personal, *draw_lookalikes(rng, task.stem)]
    bowl = BOWLS[int(rng.integers(2))]
    area = TABLE
    gap_m = 0.035
    fixed: list[tuple[Spot, float]] = []
    goal = []
    if task.goal:
        area = REACH
        gap_m = 0.03
        fixed = [(bowl, radius_m(BOWL) / np.sqrt(2))]
        goal = [place(BOWL, bowl, 0.0)]
    target, *lookalikes = scattered(rng, area, names, gap_m=gap_m, fixed=fixed)
    return (target, *goal, *lookalikes)
