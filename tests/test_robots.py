"""The authored robots: forward kinematics, limits and strokes against the Menagerie models, and inverse kinematics that reaches."""

import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from vap_core.base.errors import MissingGL, OutOfReach, UnknownName
from vap_core.simulation import gl, robots
from vap_core.simulation.control import (
    MotionLimits,
    Setpoint,
    arm,
    follow,
    rotation,
    rotation_vector,
)
from vap_core.simulation.gl import REMEDY, ensure_gl
from vap_core.simulation.robots import ROBOTS

ensure_gl()
import mujoco  # noqa: E402

PEERS = {
    "wx250s": (
        "trossen_wx250s",
        "wx250s.xml",
        "wx250s/gripper_link",
        "gripper_link",
        ("left_finger", "right_finger"),
    ),
    "panda": (
        "franka_emika_panda",
        "panda.xml",
        "hand",
        "hand",
        ("finger_joint1", "finger_joint2"),
    ),
}


def menagerie(name: str) -> mujoco.MjModel:
    """The kinematics of a Menagerie model, its meshes left out."""
    folder, file, *_ = PEERS[name]
    path = Path(os.environ.get("MENAGERIE_ROOT", "")) / folder / file
    if not path.exists():
        pytest.skip(f"no {folder}/{file}; set MENAGERIE_ROOT to a folder that holds it")
    root = ElementTree.parse(path).getroot()
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in ("geom", "mesh", "material", "texture", "light", "exclude"):
                parent.remove(child)
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))


@pytest.fixture(params=sorted(PEERS))
def robot(request):
    return ROBOTS[request.param]


def test_forward_kinematics_match_menagerie_within_a_tenth_of_a_millimetre(robot):
    ours, theirs = mujoco.MjModel.from_xml_path(str(robot.xml)), menagerie(robot.name)
    *_, their_hand, our_hand, _ = PEERS[robot.name]
    rng = np.random.default_rng(3)
    for _ in range(200):
        low, high = np.array([ours.joint(name).range for name in robot.joints]).T
        joints = rng.uniform(low, high)
        poses = []
        for model, hand in ((ours, our_hand), (theirs, their_hand)):
            data = mujoco.MjData(model)
            for joint, angle in zip(robot.joints, joints, strict=True):
                data.joint(joint).qpos[0] = angle
            mujoco.mj_kinematics(model, data)
            poses.append((data.body(hand).xpos.copy(), data.body(hand).xmat.copy()))
        (p, r), (q, s) = poses
        assert np.abs(p - q).max() < 1e-4
        assert np.abs(r - s).max() < 1e-4


def test_limits_and_strokes_match_menagerie(robot):
    ours, theirs = mujoco.MjModel.from_xml_path(str(robot.xml)), menagerie(robot.name)
    for joint in (*robot.joints, *PEERS[robot.name][-1]):
        assert ours.joint(joint).range == pytest.approx(theirs.joint(joint).range, abs=1e-6), joint


def test_opening_and_palm_are_what_the_registry_says(robot):
    """Clear width between the open pads, and from the tcp back to the palm."""
    model = mujoco.MjModel.from_xml_path(str(robot.xml))
    data = mujoco.MjData(model)
    for joint, travel in zip(robot.fingers, robot.fingers_open, strict=True):
        data.joint(joint).qpos[0] = travel
    mujoco.mj_kinematics(model, data)
    tcp, axes = data.site("tcp").xpos, data.site("tcp").xmat.reshape(3, 3)
    pads = {side: (data.geom(f"{side}_pad").xpos - tcp) @ axes for side in ("left", "right")}
    half = model.geom("left_pad").size[1]
    assert abs(pads["left"][1] - pads["right"][1]) - 2 * half == pytest.approx(
        robot.opening_m, abs=5e-4
    )
    assert pads["left"][1] == pytest.approx(-pads["right"][1], abs=1e-6)
    assert all(abs(pad[2]) < 0.02 for pad in pads.values())


def test_home_points_straight_down(robot):
    tcp = arm(robot.name).forward(robot.home)
    assert tcp[:3, :3] == pytest.approx(robot.down_base, abs=1e-4)


def test_inverse_kinematics_reach_known_poses(robot):
    solver, rng = arm(robot.name), np.random.default_rng(5)
    for _ in range(20):
        pose = np.eye(4)
        centre = (0.27, 0.0, 0.14) if robot.name == "wx250s" else (0.48, 0.0, 0.2)
        pose[:3, 3] = centre + rng.uniform(-1, 1, 3) * (0.04, 0.15, 0.10)
        pose[:3, :3] = rotation(np.array([0.0, 0.0, rng.uniform(-1.2, 1.2)])) @ robot.down_base
        found = solver.forward(solver.reach(pose))
        assert np.abs(found[:3, 3] - pose[:3, 3]).max() < 1e-3
        assert np.linalg.norm(rotation_vector(found[:3, :3] @ pose[:3, :3].T)) < 1e-2


def test_unreachable_pose_is_an_error_that_says_so(robot):
    far = np.eye(4)
    far[:3, :3], far[:3, 3] = robot.down_base, (2.0, 0.0, 0.2)
    with pytest.raises(OutOfReach, match=r"mm and .* rad away"):
        arm(robot.name).reach(far)


def test_unreachable_action_gives_a_bounded_step_and_never_runs_away(robot):
    solver, seconds = arm(robot.name), 1 / robot.hz
    command = Setpoint(solver.forward(robot.home), robot.home, 1.0)
    outward = np.array([9.0, 0, 0, 0, 0, 0, 1], np.float32)
    for _ in range(40):
        after = follow(solver, command, solver.forward(command.joints), outward, seconds)
        assert (np.abs(after.joints - command.joints) <= robot.speed_rad_s * seconds + 1e-6).all()
        command = after
    assert np.linalg.norm(command.tcp_base[:3, 3]) < 1.2


def test_command_never_leads_an_arm_that_is_held_up_by_more_than_the_leash(robot):
    solver, seconds = arm(robot.name), 1 / robot.hz
    stuck = solver.forward(robot.home)
    command = Setpoint(stuck, robot.home, 1.0)
    for _ in range(30):
        command = follow(
            solver, command, stuck, np.array([0, 0, -0.02, 0, 0, 0.2, 1], np.float32), seconds
        )
        assert np.linalg.norm(command.tcp_base[:3, 3] - stuck[:3, 3]) < 0.05 + 0.02 + 1e-3
        assert (
            np.linalg.norm(rotation_vector(command.tcp_base[:3, :3] @ stuck[:3, :3].T))
            < 0.5 + 0.2 + 1e-2
        )


def test_small_actions_add_up_exactly_in_the_base_frame(robot):
    """Ten centimetres out in ten steps and back, with a turn: the command returns to where it was."""
    solver = arm(robot.name)
    start = command = Setpoint(solver.forward(robot.home), robot.home, 1.0)
    for sign in (1, -1):
        for _ in range(10):
            action = np.array([0, sign * 0.01, 0, 0, 0, sign * 0.05, 0.25], np.float32)
            command = follow(solver, command, command.tcp_base, action, 1 / robot.hz)
        if sign == 1:
            assert command.tcp_base[:3, 3] - start.tcp_base[:3, 3] == pytest.approx(
                [0, 0.1, 0], abs=1e-4
            )
            assert rotation_vector(
                command.tcp_base[:3, :3] @ start.tcp_base[:3, :3].T
            ) == pytest.approx([0, 0, 0.5], abs=1e-3)
    assert command.tcp_base == pytest.approx(start.tcp_base, abs=1e-4)
    assert command.gripper == 0.25


def test_actions_are_rate_limited(robot):
    solver = arm(robot.name)
    command = Setpoint(solver.forward(robot.home), robot.home, 1.0)
    limits = MotionLimits(speed_m_s=0.1)
    after = follow(
        solver, command, command.tcp_base, np.array([0, 0, -1, 0, 0, 0, 2], np.float32), 0.1, limits
    )
    assert after.tcp_base[2, 3] - command.tcp_base[2, 3] == pytest.approx(-0.01, abs=1e-4)
    assert after.gripper == 1.0


def test_unknown_robot_lists_the_known_ones():
    with pytest.raises(UnknownName, match="known: .*panda, .*wx250s"):
        robots.get("pr2")


def test_missing_gl_names_the_cause_and_the_line_to_run(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv(gl.PROVEN, raising=False)
    monkeypatch.setattr(gl, "fault", lambda backend: f"no {backend} here")
    with pytest.raises(MissingGL, match=f"egl: no egl here; osmesa: no osmesa here.*{REMEDY}"):
        ensure_gl()
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(MissingGL, match="MUJOCO_GL=osmesa cannot draw.*unset MUJOCO_GL"):
        ensure_gl()
    monkeypatch.setattr(gl.resource, "getrlimit", lambda kind: (400_000 * 1024, -1))
    with pytest.raises(MissingGL, match=r"raise the limit of memory \(ulimit -v\), or unset"):
        ensure_gl()


def test_a_back_end_that_works_is_kept_and_probed_once(monkeypatch):
    asked = []
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.delenv(gl.PROVEN, raising=False)
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")
    monkeypatch.setattr(gl, "fault", asked.append)
    assert (ensure_gl(), ensure_gl(), asked) == ("osmesa", "osmesa", ["osmesa"])
    assert os.environ["PYOPENGL_PLATFORM"] == "osmesa"


@pytest.mark.parametrize(
    ("variable", "value", "words"),
    [
        ("PYOPENGL_PLATFORM", "osmesa", ""),
        ("PYOPENGL_PLATFORM", "glx", ""),
        ("MUJOCO_EGL_DEVICE_ID", "97", "MUJOCO_EGL_DEVICE_ID.*must be an integer.*unset MUJOCO_EGL"),
        ("MUJOCO_GL", "nonsense", "invalid value for environment variable MUJOCO_GL: nonsense"),
    ],
)  # fmt: skip
def test_the_probe_says_what_the_run_will_meet(variable, value, words):
    """With PYOPENGL_PLATFORM the probe passed and every episode was an error."""
    code = "from vap_core.simulation.env import Env; from vap_core import open_row\n"
    code += "from vap_core.simulation import suites\n"
    code += "with open_row(suites.rows('simpler-bridge', 'put-camera')[0]) as env: env.observe()"
    kept = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", gl.PROVEN)}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env={**kept, variable: value}, capture_output=True, text=True)
    assert (done.returncode == 0) == (not words), done.stderr
    assert re.search(words, done.stderr.strip().splitlines()[-1] if words else "")
