"""What a suite is: which robot, cameras and control, which tasks and how long they may take. Reading one loads no simulator."""

from typing import Literal

from vap_core.base.errors import one_of
from vap_core.base.types import value
from vap_core.simulation.sensor import PERFECT, Sensor
from vap_core.simulation.types import EpisodeRow, Placement, SuccessRule


@value
class Task:
    """One task: a category, its personalised instruction, when it has succeeded, and how many control steps it may take.

    `stem` begins the names of its objects in the registry; `goal` names the object that the target goes to.
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
    """A set of tasks on one robot. `control` says what an action is (values.Action), `sensor` what the cameras do to what they see."""

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
        raise one_of(f"suite {self.name}: task", name, [task.name for task in self.tasks])

    def row(
        self, task: Task, episode: int, placements: tuple[Placement, ...], *, seed: int = 0, split: str = "", variant: str = "base"
    ) -> EpisodeRow:  # fmt: skip
        """An episode of `task` that starts with `placements`, the target first."""
        return EpisodeRow(
            self.name, task.name, episode, seed, task.instruction, task.category, placements, task.max_steps, task.rule, task.goal, split, variant,
            self.cameras,
        )  # fmt: skip
