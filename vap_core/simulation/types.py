"""What an episode starts from, what the simulator returns, and how an episode ends.

Poses are `x y z qw qx qy qz` in the world frame, z up.
"""

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64

from vap_core.base.types import Mask, Views, value

Pose = Float64[np.ndarray, "7"]
Action = Float32[np.ndarray, " a"]
"""One control step.

End-effector control, a = 7: `dx dy dz` (m) and the rotation vector `drx dry drz` (rad) in the robot
base frame, then `gripper` 0 closed .. 1 open. Joint control, a = n + 1: the change of every joint
angle (rad), then `gripper`.
"""
EE_ACTION = ("dx", "dy", "dz", "drx", "dry", "drz", "gripper")

ROBOT = "robot"
"""As a contact partner: the arm with its gripper."""
REST = "rest"
"""As a contact partner: the table, floor and walls."""


@value
class Observation:
    """What the robot's sensors give at one control step.

    `state` is `x y z` (m) of the gripper in the robot base frame, its rotation vector `rx ry rz`
    (rad) relative to pointing straight down (a turn about the vertical reads (0, 0, yaw)), gripper
    opening 0..1, then the joint angles (rad).
    """

    images: Views
    state: Float32[np.ndarray, " s"]


@value
class Truth:
    """Simulator ground truth after one control step.

    For metrics, recordings and tests, never for an evaluated policy. All but `succeeded` is empty
    where an environment of another library knows no more.
    """

    objects_world: Mapping[str, Pose]
    links_world: Mapping[str, Pose]
    touched: tuple[str, ...]
    """Objects that the robot touched during this control step, in the order of first contact."""
    pressed_s: Mapping[str, float]
    """Objects that the gripper touched in this step: longest unbroken contact so far, seconds."""
    contacts: Mapping[str, frozenset[str]]
    """At the end of the step: the partners of every touching object (objects, ROBOT, REST)."""
    masks: Mapping[str, Mapping[str, Mask]] = field(default_factory=dict)
    """`masks[camera][object]`: visible pixels; empty when masks were not asked for."""
    hand: Mapping[str, Mask] = field(default_factory=dict)
    """Visible pixels of the gripper by camera; empty when masks were not asked for."""
    succeeded: bool = False
    """What an environment with a rule of its own says (the rule "official")."""

    @property
    def held(self) -> frozenset[str]:
        """Objects that touch the robot and nothing else."""
        held = set()
        for name, partners in self.contacts.items():
            if partners == {ROBOT}:
                held.add(name)
        return frozenset(held)


@value
class Placement:
    """An object of an episode.

    `model` is its name in the object registry; it starts at (x, y) metres, turned by `yaw` radians.
    """

    model: str
    x: float
    y: float
    yaw: float


@value
class Start:
    """What differs at the start of an episode from its placements and its robot's home: by its
    seed (suites.starts), by an own suite's row, or for want of its target.

    `joints_rad` are added to the robot's home; `offsets` (x, y in metres, yaw in radians) to the
    placements, in their order. `lamp` and `ambient` multiply the lamp's and the room's light. An
    `absent` target is nowhere to be seen, so that the episode cannot succeed.
    """

    joints_rad: tuple[float, ...] = ()
    offsets: tuple[tuple[float, float, float], ...] = ()
    lamp: float = 1.0
    ambient: float = 1.0
    absent: bool = False


AS_LISTED = Start()
"""Nothing changed."""


SuccessRule = Literal["picked", "near", "put", "selected", "official"]
"""When an episode has succeeded (SPEC section 6); see simulation.suites.rules."""


@value
class Owned:
    """A remembered object of an episode, by its model, and its owner, who is also `known_as`."""

    model: str
    owner: str
    known_as: tuple[str, ...] = ()


@value
class SubGoal:
    """One step of an instruction that has several: a command of its own, and its rule.

    `target` and `goal` name placed objects, as those of an episode do.
    """

    instruction: str
    category: str
    target: str
    max_steps: int
    rule: SuccessRule
    goal: str = ""


@value
class EpisodeRow:
    """One row of an episode list: how an episode starts, and when it has succeeded.

    `placements[0]` is the target; `goal` names the placed object that it goes to ("" when there is
    none). `split` is the track within the suite, `variant` the scene style (suites.VARIANTS),
    `cameras` the views that the policy gets, the suite's where it names none. `start` says what
    differs from the list.

    In a shared scene objects are `owned`, and `speaker` is whom "my" means. An instruction in
    several steps has ordered `subgoals`; target, category, rule and goal are then the first one's,
    and `max_steps` is the sum of all. `inside` names what earlier sub-goals put into the same
    receptacle (`at`).
    """

    suite: str
    task: str
    episode: int
    seed: int
    instruction: str
    category: str
    placements: tuple[Placement, ...]
    max_steps: int
    rule: SuccessRule = "picked"
    goal: str = ""
    split: str = ""
    variant: str = "base"
    cameras: tuple[str, ...] = ()
    start: Start = AS_LISTED
    speaker: str = ""
    owned: tuple[Owned, ...] = ()
    subgoals: tuple[SubGoal, ...] = ()
    inside: tuple[str, ...] = ()

    @property
    def target(self) -> str:
        return self.placements[0].model

    @property
    def stages(self) -> int:
        """How many sub-goals follow one another: 1 for a plain episode."""
        return max(1, len(self.subgoals))

    def at(self, stage: int) -> "EpisodeRow":
        """The row of one sub-goal alone, its target first; a plain episode's is the row itself."""
        if not self.subgoals:
            return self
        subgoal = self.subgoals[stage]
        rest = [place for place in self.placements if place.model != subgoal.target]
        (first,) = [place for place in self.placements if place.model == subgoal.target]
        inside = [
            earlier.target
            for earlier in self.subgoals[:stage]
            if earlier.rule == "put" and earlier.goal == subgoal.goal
        ]
        return replace(
            self,
            instruction=subgoal.instruction,
            category=subgoal.category,
            placements=(first, *rest),
            max_steps=subgoal.max_steps,
            rule=subgoal.rule,
            goal=subgoal.goal,
            subgoals=(),
            inside=tuple(inside),
        )

    @property
    def key(self) -> str:
        return f"{self.suite}.{self.task}.{self.episode:03d}"


@value
class Outcome:
    """How an episode ended (P 5.1).

    `success` at the end, `success_once` at any step, `held_steps` the longest run of steps in which
    the rule held. `cmr` is None where the paper defines none (selection); all about objects is None
    where the environment has no ground truth.
    """

    status: Literal["success", "failure", "error"]
    success: bool
    success_once: bool
    held_steps: int
    cmr: bool | None
    wrong_object: bool | None
    first_object_correct: bool | None
    steps: int
    detail: str = ""
    touched: bool | None = False
    """Whether the robot touched or moved any object but the goal."""
    subgoals: tuple["Outcome", ...] = ()
    """How each sub-goal ended, in order, where there were several; steps are its own."""


def of_subgoals(outcomes: Sequence[Outcome], stages: int, steps: int) -> Outcome:
    """How an episode of several sub-goals ended, of which these were begun.

    It succeeds where every sub-goal had succeeded at its own end, in order. A wrong object in any
    of them counts. `steps` are all, with the way home in between.
    """
    success = len(outcomes) == stages and all([outcome.success for outcome in outcomes])
    error = outcomes[-1].status == "error"
    moved = [outcome.cmr for outcome in outcomes if outcome.cmr is not None]
    status: Literal["success", "failure", "error"] = "success" if success else "failure"
    return Outcome(
        status="error" if error else status,
        success=success and not error,
        success_once=len(outcomes) == stages and all(each.success_once for each in outcomes),
        held_steps=outcomes[-1].held_steps,
        cmr=all(moved) if moved else None,
        wrong_object=any(outcome.wrong_object for outcome in outcomes),
        first_object_correct=outcomes[0].first_object_correct,
        steps=steps,
        detail=outcomes[-1].detail,
        touched=any(outcome.touched for outcome in outcomes),
        subgoals=tuple(outcomes),
    )
