"""The simulated twin of the paper's real desk (P 4): SO-101 with three cameras, four selections and four pick-and-places, 8 x 20.

Sensor noise, exposure and knocked cameras are drawn per episode (sim.sensor.DESK).
"""

import numpy as np

from vap_core.simulation.sensor import DESK
from vap_core.simulation.suites.layout import Area, place, radius_m, rivals, scatter, turned
from vap_core.simulation.suites.suite import Suite, Task
from vap_core.simulation.types import EpisodeRow, Placement

BOWL = "plastic-bowl-prop"


def _select(category: str) -> Task:
    return Task(f"select-{category}", category, f"select my {category}", 150, "selected")


def _put(category: str) -> Task:
    return Task(
        f"put-{category.replace(' ', '-')}",
        category,
        f"put my {category} into the plastic bowl",
        300,
        "put",
        BOWL,
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
TABLE = Area(0.15, 0.30, -0.19, 0.19)
REACH = Area(0.165, 0.275, -0.145, 0.145)
"""Where the SO-101 takes things from above: all three objects of a put stand here, so that their places tell nothing."""
BOWLS = ((0.215, 0.16), (0.215, -0.16))
"""The bowl stands on one side or the other."""
EPISODES = 20


def rows() -> tuple[EpisodeRow, ...]:
    """All 8 x 20 episodes."""
    return tuple(
        TABLETOP.row(task, i, _scene(task, i)) for task in TABLETOP.tasks for i in range(EPISODES)
    )


def _scene(task: Task, episode: int) -> tuple[Placement, ...]:
    rng = np.random.default_rng([61, *task.name.encode(), episode])
    names = [task.personal, *rivals(rng, task.stem)]
    bowl = BOWLS[int(rng.integers(2))]
    fixed = [(bowl, radius_m(BOWL) / np.sqrt(2))] if task.goal else []
    spots = scatter(
        rng,
        REACH if task.goal else TABLE,
        [radius_m(name) for name in names],
        fixed,
        gap_m=0.03 if task.goal else 0.035,
    )
    placed = [place(name, spot, turned(rng)) for name, spot in zip(names, spots, strict=True)]
    return (placed[0], *([place(BOWL, bowl, 0.0)] if task.goal else []), *placed[1:])
