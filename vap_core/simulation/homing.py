"""The way home between two sub-goals: the hand lets go, rises, and returns to where it began.

No policy is asked meanwhile. The next sub-goal then begins as an episode does, and no view of the
table is hidden by the arm.
"""

from typing import Literal

import numpy as np

from vap_core.base.types import value
from vap_core.simulation.control import MotionLimits, action_towards, arm
from vap_core.simulation.env import Env
from vap_core.simulation.types import Action

SPEED_M_S = 0.20
TURN_RAD_S = 1.2
LIMITS = MotionLimits(SPEED_M_S, TURN_RAD_S)
JOINT_RAD_S = 0.8
GRIP_S = 3.0
"""Share of the gripper's travel in a second."""
RISE_M = 0.10
ARRIVED_M = 0.012
ARRIVED_RAD = 0.06
PATIENCE_S = 2.5
"""Longest time for each part of the way."""
Part = Literal["open", "rise", "home", "there"]
NEXT: dict[Part, Part] = {"open": "rise", "rise": "home", "home": "there"}


@value
class Homing:
    """The part of the way that the hand is on, for how long, and the height to rise to first.

    The height is of the tcp in the robot's base frame, metres.
    """

    height_m: float
    part: Part
    waited_s: float = 0.0


def begin(env: Env) -> Homing:
    """The way home from where the hand is now; after a touch it opens higher up."""
    part: Part = "rise" if env.row.rule == "selected" else "open"
    return Homing(float(env.command.tcp_base[2, 3]) + RISE_M, part)


def advance(homing: Homing, env: Env) -> Homing:
    """After one control step: the next part of the way where this one is done."""
    waited_s = homing.waited_s + 1.0 / env.hz
    if homing.part != "there" and (_is_done(homing, env) or waited_s > PATIENCE_S):
        return Homing(homing.height_m, NEXT[homing.part])
    return Homing(homing.height_m, homing.part, waited_s)


def action(homing: Homing, env: Env) -> Action:
    """One step of the way, in whichever control the suite has."""
    seconds = 1.0 / env.hz
    command = env.command
    gripper = command.gripper
    if homing.part != "rise":
        gripper = min(1.0, gripper + GRIP_S * seconds)
    if env.control == "joint" and homing.part in ("home", "there"):
        longest = JOINT_RAD_S * seconds
        turn = np.clip(env.robot.home - command.joints, -longest, longest)
        return np.array([*turn, gripper], np.float32)
    return action_towards(
        arm(env.robot.name),
        command,
        _goal(homing, env),
        gripper,
        control=env.control,
        seconds=seconds,
        limits=LIMITS,
    )


def _goal(homing: Homing, env: Env) -> np.ndarray:
    """The pose of the tcp at the end of this part of the way."""
    goal = env.command.tcp_base.copy()
    if homing.part == "rise":
        goal[2, 3] = homing.height_m
    elif homing.part != "open":
        goal = arm(env.robot.name).forward(env.robot.home)
    return goal


def _is_done(homing: Homing, env: Env) -> bool:
    command = env.command
    if homing.part == "open":
        return command.gripper > 0.99
    off = _goal(homing, env)[:3, 3] - env.tcp_base()[:3, 3]
    if homing.part == "rise":
        return bool(abs(off[2]) < ARRIVED_M)
    if env.control == "joint":
        return bool(np.abs(env.robot.home - command.joints).max() < ARRIVED_RAD)
    return bool(np.linalg.norm(off) < ARRIVED_M)
