"""When an object counts as picked, and who was moved: a pure function over the ground truth of every step (SPEC 6, SIMPLER's thresholds).

*Picked*: raised more than 1 cm above where it settled and touching nothing but the robot, for at least 5 steps in a row.
*CMR* (P 5.1): the target moved more than 3 cm from where it settled, at least once, whatever the outcome.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from vap_core.values import EpisodeRow, Event, Outcome, Pose, Truth, value

LIFT_M = 0.01
HELD_STEPS = 5
MOVED_M = 0.03
LIFTED_M = 0.05
"""A held target this high is clear of the table: the lift is done and the episode may end."""


@value
class Judge:
    """What is known of one episode so far. `step` returns the next state; `events` are those of the last step alone.

    `run` counts the current unbroken run of held steps, `held_steps` the longest; `first` names the objects of the first
    step in which any object was touched by the robot or moved: the target alone, or the first object was not the right one.
    """

    row: EpisodeRow
    start_world: Mapping[str, Pose]
    steps: int = 0
    run: int = 0
    held_steps: int = 0
    lift_m: float = 0.0
    success_once: bool = False
    first: frozenset[str] = frozenset()
    moved: frozenset[str] = frozenset()
    events: tuple[Event, ...] = ()

    @staticmethod
    def start(row: EpisodeRow, truth: Truth) -> "Judge":
        """Before the first action, with everything settled."""
        return Judge(row, {place.model: truth.objects_world[place.model].copy() for place in row.placements})

    def step(self, truth: Truth) -> "Judge":
        """The state after one more control step."""
        lift = float(truth.objects_world[self.row.target][2] - self.start_world[self.row.target][2])
        run = self.run + 1 if lift > LIFT_M and self.row.target in truth.held else 0
        moved = self.moved | {name for name, start in self.start_world.items() if _distance(truth.objects_world[name], start) > MOVED_M}
        first = self.first or frozenset((truth.touched | moved) & set(self.start_world))
        after = replace(
            self, steps=self.steps + 1, run=run, held_steps=max(self.held_steps, run), lift_m=lift,
            success_once=self.success_once or run >= HELD_STEPS, first=first, moved=moved, events=(),
        )  # fmt: skip
        return replace(after, events=_news(self, after))

    @property
    def success(self) -> bool:
        """Picked now."""
        return self.run >= HELD_STEPS

    @property
    def done(self) -> bool:
        """Picked, and lifted clear of the table: nothing is left to do."""
        return self.success and self.lift_m > LIFTED_M

    def outcome(self, status: Literal["success", "failure", "error"] | None = None, detail: str = "") -> Outcome:
        """How it ended; without `status` the target's being picked now decides. An error is never a success."""
        if status is None:
            status = "success" if self.success else "failure"
        return Outcome(
            status=status,
            success=status == "success",
            success_once=self.success_once,
            held_steps=self.held_steps,
            cmr=self.row.target in self.moved,
            wrong_object=bool(self.moved - {self.row.target}),
            first_object_correct=self.first == {self.row.target},
            steps=self.steps,
            detail=detail,
        )


def _distance(pose: Pose, start: Pose) -> float:
    return float(np.linalg.norm(pose[:3] - start[:3]))


def _news(before: Judge, after: Judge) -> tuple[Event, ...]:
    target, at = after.row.target, after.steps
    news: list[tuple[bool, Literal["INFO", "WARN"], str]] = [
        (bool(after.first and not before.first), "INFO" if after.first == {target} else "WARN", f"first object: {', '.join(sorted(after.first))}"),
        *((True, "INFO" if name == target else "WARN", f"moved: {name}") for name in sorted(after.moved - before.moved)),
        (after.run == HELD_STEPS, "INFO", f"picked: {target}"),
        (before.run > 0 and after.run == 0, "WARN", f"lost after {before.run} held steps: {target}"),
    ]
    return tuple(Event(at, level, text) for happened, level, text in news if happened)
