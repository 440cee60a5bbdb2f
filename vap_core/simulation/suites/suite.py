"""What a suite is: a robot, its cameras and control, the tasks and how long they may take.

This module loads no simulator.
"""

from collections.abc import Callable
from typing import Literal

from vap_core.base.errors import one_of
from vap_core.base.types import value
from vap_core.simulation.looks import DEFAULT_STYLE, PERFECT, SceneStyle, Sensor
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

    `control` says what an action is (types.Action), `sensor` how the cameras change their images,
    `environment` which library runs it; "" is ours.
    """

    name: str
    robot: str
    hz: float
    cameras: tuple[str, ...]
    tasks: tuple[Task, ...]
    control: Literal["ee", "joint"] = "ee"
    sensor: Sensor = PERFECT
    environment: str = ""

    def task(self, name: str) -> Task:
        """The task called `name`. Raises: UnknownName."""
        for task in self.tasks:
            if task.name == name:
                return task
        raise one_of(f"suite {self.name}: task", name, [task.name for task in self.tasks])

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
        return tuple(
            self.row(task, i, placements(task, i)) for task in self.tasks for i in range(episodes)
        )


@value
class Variant:
    """One setting of one axis; `distractors` more objects of other categories stand around."""

    axis: str
    style: SceneStyle = DEFAULT_STYLE
    distractors: int = 0


MARBLE = ((0.86, 0.86, 0.84), (0.86, 0.86, 0.84))
SLATE = ((0.33, 0.36, 0.40), (0.29, 0.32, 0.36))
VARIANTS: dict[str, Variant] = {
    "base": Variant("base"),
    "robot-dark": Variant("robot colour", SceneStyle(robot=(0.45, 0.47, 0.52))),
    "robot-sand": Variant("robot colour", SceneStyle(robot=(0.95, 0.82, 0.62))),
    "robot-blue": Variant("robot colour", SceneStyle(robot=(0.58, 0.72, 0.95))),
    "background-brick": Variant(
        "background", SceneStyle(wall=(0.58, 0.33, 0.27), floor=(0.30, 0.24, 0.20))
    ),
    "background-green": Variant(
        "background", SceneStyle(wall=(0.42, 0.55, 0.42), floor=(0.62, 0.57, 0.47))
    ),
    "table-marble": Variant("table", SceneStyle(planks=MARBLE)),
    "table-slate": Variant("table", SceneStyle(planks=SLATE)),
    "light-bright": Variant("lighting", SceneStyle(lamp=0.72, ambient=0.52)),
    "light-dim": Variant(
        "lighting", SceneStyle(lamp=0.30, ambient=0.20, lamp_pos_m=(-0.2, 1.0, 1.4))
    ),
    "camera-left": Variant("camera", SceneStyle(camera_shift_m=(0.0, 0.06, 0.03))),
    "camera-right": Variant("camera", SceneStyle(camera_shift_m=(-0.03, -0.06, -0.02))),
    "distractors-few": Variant("distractors", distractors=2),
    "distractors-many": Variant("distractors", distractors=3),
}
MATCHING = ("base", "robot-dark", "robot-sand", "robot-blue")
"""Visual matching: the usual room with four robot colours."""
AGGREGATION = tuple(name for name, variant in VARIANTS.items() if variant.axis != "robot colour")
"""Variant aggregation of the pick task: the usual room and two settings of each other axis."""
