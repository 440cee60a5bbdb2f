"""What a suite is: a robot, its cameras and control, the tasks and how long they may take.

This module loads no simulator.
"""

from collections.abc import Callable
from typing import Literal

from vap_core.base.errors import one_of
from vap_core.base.types import value
from vap_core.simulation.sensor import PERFECT, Sensor
from vap_core.simulation.types import EpisodeRow, Placement, SuccessRule


@value
class Task:
    """One task: a category, its personalised instruction, its rule of success and step limit.

    `max_steps` are control steps; `stem` begins the names of its objects in the registry; `goal`
    names the object that the target goes to.
    """

    name: str
    category: str
    instruction: str
    max_steps: int
    rule: SuccessRule = "picked"
    goal: str = ""
    slug: str = ""

    @property
    def stem(self) -> str:
        return self.slug or self.category.replace(" ", "-")

    @property
    def personal(self) -> str:
        return f"{self.stem}-personal"


@value
class Suite:
    """A set of tasks on one robot.

    `control` says what an action is (types.Action), `sensor` how the cameras change their images.
    """

    name: str
    robot: str
    hz: float
    cameras: tuple[str, ...]
    tasks: tuple[Task, ...]
    control: Literal["ee", "joint"] = "ee"
    sensor: Sensor = PERFECT

    def task(self, name: str) -> Task:
        """The task called `name`. Raises: UnknownName."""
        for task in self.tasks:
            if task.name == name:
                return task
        names = [task.name for task in self.tasks]
        raise one_of(f"suite {self.name}: task", name, names)

    def row(
        self,
        task: Task,
        episode: int,
        placements: tuple[Placement, ...],
        *,
        seed: int = 0,
        split: str = "",
        variant: str = "base",
    ) -> EpisodeRow:
        """An episode of `task` that starts with `placements`, the target first."""
        return EpisodeRow(
            suite=self.name,
            task=task.name,
            episode=episode,
            seed=seed,
            instruction=task.instruction,
            category=task.category,
            placements=placements,
            max_steps=task.max_steps,
            rule=task.rule,
            goal=task.goal,
            split=split,
            variant=variant,
            cameras=self.cameras,
        )

    def rows_of(
        self, episodes: int, placements: Callable[[Task, int], tuple[Placement, ...]]
    ) -> tuple[EpisodeRow, ...]:
        """So many episodes of every task; `placements` are those of a task's i-th episode."""
        rows = []
        for task in self.tasks:
            for i in range(episodes):
                rows.append(self.row(task, i, placements(task, i)))
        return tuple(rows)
