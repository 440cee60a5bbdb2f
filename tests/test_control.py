"""Joint-delta control: deltas count from the commanded joints, within speeds, limits and the leash."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vap_core.base.errors import BadAction
from vap_core.simulation.control import LEAD_JOINT_RAD, Setpoint, arm, follow_joints
from vap_core.simulation.robots import ROBOTS

SECONDS = 1 / 30


def at_home(name: str) -> Setpoint:
    home = ROBOTS[name].home
    return Setpoint(arm(name).forward(home), home, 1.0)


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_small_deltas_are_done_exactly_and_the_pose_is_the_joints(name: str) -> None:
    start, delta = at_home(name), np.full(len(ROBOTS[name].joints), 0.01)
    after = follow_joints(
        arm(name), start, start.joints, np.array([*delta, 0.4], np.float32), SECONDS
    )
    assert after.joints == pytest.approx(start.joints + delta, abs=1e-7)
    assert after.gripper == pytest.approx(0.4)
    assert after.tcp_base == pytest.approx(arm(name).forward(after.joints))


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_a_deaf_arm_is_led_by_no_more_than_the_leash_nor_the_rated_speed(name: str) -> None:
    robot, start = ROBOTS[name], at_home(name)
    inward = np.where(arm(name).model.jnt_range.mean(axis=1) >= start.joints, 1.0, -1.0)
    command, push = start, np.array([*inward, -3.0], np.float32)
    for _ in range(10):
        after = follow_joints(arm(name), command, start.joints, push, SECONDS)
        assert (np.abs(after.joints - command.joints) <= robot.speed_rad_s * SECONDS + 1e-9).all()
        command = after
    assert np.abs(command.joints - start.joints) == pytest.approx(
        np.full(len(robot.joints), LEAD_JOINT_RAD)
    )
    assert command.gripper == 0.0


@given(st.integers(0, 10_000))
def test_commands_stay_within_the_limits(seed: int) -> None:
    solver, rng = arm("so101"), np.random.default_rng(seed)
    low, high = solver.model.jnt_range.T
    command = at_home("so101")
    push = np.array([*rng.choice([-0.2, 0.2], 5), 2.0], np.float32)
    for _ in range(40):
        command = follow_joints(solver, command, command.joints, push, SECONDS)
        assert (command.joints >= low).all()
        assert (command.joints <= high).all()
    assert command.gripper == 1.0


def test_an_arm_found_beyond_its_limit_is_called_back() -> None:
    solver = arm("so101")
    beyond = solver.model.jnt_range[:, 1] + 0.02
    start = replace(at_home("so101"), joints=beyond)
    after = follow_joints(solver, start, beyond, np.zeros(6, np.float32), SECONDS)
    assert after.joints == pytest.approx(solver.model.jnt_range[:, 1])


def test_a_wrong_number_of_joints_is_an_error_that_counts_them() -> None:
    start = at_home("so101")
    with pytest.raises(BadAction, match="7 numbers, but so101 takes 5 joint deltas"):
        follow_joints(arm("so101"), start, start.joints, np.zeros(7, np.float32), SECONDS)
