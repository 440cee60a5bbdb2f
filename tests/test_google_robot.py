"""The Google Robot: Menagerie's kinematics and limits, every grasp on the object grid in reach, a firm hold at 3 Hz, a head that sees it all."""

import os
import xml.etree.ElementTree as ElementTree
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float64

from vap_core.base.errors import OutOfReach
from vap_core.simulation import cameras, robots, scenes
from vap_core.simulation.control import arm, rotation
from vap_core.simulation.env import Env
from vap_core.simulation.types import EpisodeRow, Placement

import mujoco  # isort: skip

ROBOT = robots.get("google")
GRID_X, GRID_Y = (0.40, 0.63), (-0.22, 0.22)
"""SIMPLER's grid of objects, 23 x 44 cm, where this robot reaches all of it; metres, world."""
UP = np.array([0.0, 0.0, 1.0])
CORNERS = list(product(GRID_X, GRID_Y))


def bare() -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_path(str(ROBOT.xml))
    return model, mujoco.MjData(model)


@pytest.fixture(scope="module")
def menagerie() -> mujoco.MjModel:
    """Menagerie's model, its meshes left out."""
    root = os.environ.get("MENAGERIE_ROOT")
    if root is None:
        pytest.skip("set MENAGERIE_ROOT to a folder that holds MuJoCo Menagerie's google_robot")
    tree = ElementTree.parse(Path(root) / "google_robot" / "robot.xml").getroot()
    for parent in list(tree.iter()):
        for child in list(parent):
            if child.tag in ("geom", "mesh", "material", "texture", "light"):
                parent.remove(child)
    compiler = tree.find("compiler")
    assert compiler is not None
    compiler.attrib.update(
        boundmass="0.01", boundinertia="0.0001"
    )  # links that had their mass from a mesh
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(tree, encoding="unicode"))


def test_every_link_stands_where_menagerie_has_it(menagerie):
    model, _ = bare()
    rng = np.random.default_rng(3)
    for _ in range(100):
        angles = {
            name: rng.uniform(*model.joint(name).range) for name in (*ROBOT.joints, *ROBOT.fingers)
        }
        poses = []
        for each in (model, menagerie):
            data = mujoco.MjData(each)
            for name, angle in angles.items():
                data.joint(name).qpos[0] = angle
            mujoco.mj_kinematics(each, data)
            foot = data.body("base_link").xpos
            poses.append(
                np.stack(
                    [
                        [*(data.body(link).xpos - foot), *data.body(link).xmat]
                        for link in ROBOT.links
                    ]
                )
            )
        assert poses[0] == pytest.approx(poses[1], abs=1e-5)


def test_limits_and_stroke_are_menageries(menagerie):
    model, _ = bare()
    for name in (*ROBOT.joints, *ROBOT.fingers):
        assert model.joint(name).range == pytest.approx(menagerie.joint(name).range, abs=1e-9), name
        assert model.actuator(name).ctrlrange == pytest.approx(model.joint(name).range), name


def pads(turn: float) -> Float64[np.ndarray, "2 8 3"]:
    """The corners of the right and left pad in the tcp's frame, metres, the fingers turned by `turn`."""
    model, data = bare()
    for name in ROBOT.fingers:
        data.joint(name).qpos[0] = turn
    mujoco.mj_kinematics(model, data)
    signs, tcp = np.array(list(product((-1, 1), repeat=3))), data.site("tcp")
    found = []
    for name in ("right_pad", "left_pad"):
        pad = data.geom(name)
        world = pad.xpos + (signs * model.geom(name).size) @ pad.xmat.reshape(3, 3).T
        found.append((world - tcp.xpos) @ tcp.xmat.reshape(3, 3))
    return np.stack(found)


def test_opening_is_the_clear_width_and_the_tips_stay_off_the_table():
    right, left = pads(ROBOT.fingers_open[0])
    assert right[:, 1].min() - left[:, 1].max() == pytest.approx(ROBOT.opening_m, abs=5e-4)
    right, left = pads(ROBOT.fingers_closed[0])
    assert right[:, 1].min() - left[:, 1].max() == pytest.approx(0.0, abs=2e-3)
    assert all(
        pads(turn)[..., 2].max() < 0.016
        for turn in np.linspace(ROBOT.fingers_open[0], ROBOT.fingers_closed[0], 20)
    )


def test_pads_lie_parallel_around_six_centimetres():
    right, left = pads(0.69)
    inner = np.sort(right[:, 1])[:4]
    assert np.ptp(inner) < 1e-3
    assert 2 * inner.mean() == pytest.approx(0.058, abs=0.003)
    assert right[:, 1].min() == pytest.approx(-left[:, 1].max(), abs=1e-6)


def reaches(pose: Float64[np.ndarray, "4 4"]) -> bool:
    try:
        arm(ROBOT.name).reach(pose)
    except OutOfReach:
        return False
    return True


@pytest.mark.parametrize(("x", "y"), [*CORNERS, (0.515, 0.0)])
def test_any_grasp_from_above_is_in_reach(x, y):
    for z, yaw in product((0.02, 0.16, 0.30), np.deg2rad(np.arange(-90, 91, 30))):
        pose, found = np.eye(4), []
        pose[:3, 3] = np.array([x, y, z]) - ROBOT.base_world[:3]
        for turn in (yaw, yaw + np.pi):
            pose[:3, :3] = rotation(np.array([0.0, 0.0, turn])) @ ROBOT.down_base
            found.append(reaches(pose))
        assert any(found), (x, y, z, np.rad2deg(yaw))


def row(*places: tuple[str, float, float, float]) -> EpisodeRow:
    return EpisodeRow(
        "none",
        "hold",
        0,
        0,
        "pick up the cup",
        "cup",
        tuple(Placement(*place) for place in places),
        80,
    )


@pytest.fixture(scope="module")
def scene():
    with scenes.build(ROBOT.name, ("cup-personal", "cup-lookalike-1", "cup-lookalike-2")) as built:
        yield built


def drive(
    env: Env, goal_world: Float64[np.ndarray, "3"], yaw: float, grip: float, steps: int
) -> None:
    """At most `steps` actions of up to 6 cm and 0.4 rad towards a goal."""
    goal = goal_world - env.robot.base_world[:3]
    for _ in range(steps):
        here, action = env.state(), np.zeros(7, np.float32)
        off = goal - here[:3]
        action[:3] = off * min(1.0, 0.06 / max(float(np.linalg.norm(off)), 1e-9))
        action[5], action[6] = np.clip(yaw - here[5], -0.4, 0.4), grip
        env.step(action)


@pytest.mark.parametrize(
    ("x", "y", "yaw"),
    [(0.40, 0.22, 0.3), (0.63, -0.22, -0.9), (0.63, 0.22, 1.2), (0.515, 0.0, -0.2)],
)
def test_a_cup_is_lifted_shaken_and_held(scene, x, y, yaw):
    """Moves end within 3 mm; the cup slips less than 5 mm while shaken and 0.5 mm in the 5 s after."""
    env, cup = Env(scene), "cup-personal"
    env.reset(row((cup, x, y, yaw)))
    spot = env.truth().objects_world[cup][:3] + 0.042 * UP
    drive(env, spot + 0.12 * UP, yaw, 1.0, 14)
    drive(env, spot, yaw, 1.0, 4)
    assert env.state()[:3] + ROBOT.base_world[:3] == pytest.approx(spot, abs=3e-3)
    drive(env, spot, yaw, 0.0, 3)
    in_hand = [env.truth().objects_world[cup][:3] - env.state()[:3]]
    drive(env, spot + 0.15 * UP, yaw, 0.0, 5)
    for sign in (1, -1, 1, -1):
        env.step(np.array([0.03 * sign, 0.06 * sign, 0.02 * sign, 0, 0, 0.3 * sign, 0], np.float32))
    for steps in (2, 15):
        drive(env, spot + 0.15 * UP, yaw, 0.0, steps)
        in_hand.append(env.truth().objects_world[cup][:3] - env.state()[:3])
    assert cup in env.truth().held
    assert env.truth().objects_world[cup][2] > 0.13
    assert np.linalg.norm(in_hand[1] - in_hand[0]) < 5e-3
    assert np.linalg.norm(in_hand[2] - in_hand[1]) < 5e-4


def test_the_grip_presses_with_twenty_newtons(scene):
    env, cup = Env(scene), "cup-personal"
    env.reset(row((cup, 0.5, 0.0, 0.0)))
    spot = env.truth().objects_world[cup][:3] + 0.042 * UP
    for rise, grip in ((0.1, 1.0), (0.0, 1.0), (0.0, 0.0)):
        drive(env, spot + rise * UP, 0.0, grip, 10)
    model, data, force = scene.model, mujoco.MjData(scene.model), np.zeros(6)
    mujoco.mj_setState(model, data, env.snapshot().state, mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_forward(model, data)
    pressed = {"left_pad": 0.0, "right_pad": 0.0}
    for i, contact in enumerate(data.contact):
        for name in {model.geom(int(geom)).name for geom in contact.geom} & pressed.keys():
            mujoco.mj_contactForce(model, data, i, force)
            pressed[name] += force[0]
    assert list(pressed.values()) == pytest.approx([22, 22], abs=4)


def test_the_head_sees_the_whole_grid(scene):
    """What is ten centimetres tall and six wide, at any corner, fits the picture and fills its width; cups at the corners show in full."""
    env = Env(scene)
    env.reset(
        row(*((name, x, y, 0.5) for name, (x, y) in zip(scene.objects, CORNERS[:3], strict=True)))
    )
    (head,) = env.cameras()
    boxes = np.array(
        [
            [x + a, y + b, z]
            for x, y in CORNERS
            for a, b in product((-0.03, 0.03), repeat=2)
            for z in (0.0, 0.1)
        ]
    )
    pixels = cameras.project(head, boxes)
    assert pixels.min() > 0
    assert pixels.max() < 224
    assert np.ptp(pixels[:, 0]) > 200
    assert all(mask.sum() > 250 for mask in env.truth(masks=True).masks["head"].values())


def test_the_arm_never_hides_what_it_reaches_for(scene):
    """The elbow stays out to the right: with the open hand 16 cm above a cup anywhere, most of the cup is in view."""
    env, cup = Env(scene), "cup-personal"
    for x, y in CORNERS:
        env.reset(row((cup, x, y, 0.0)))
        before = env.truth(masks=True).masks["head"][cup].sum()
        drive(env, np.array([x, y, 0.16]), 0.0, 1.0, 14)
        assert env.truth(masks=True).masks["head"][cup].sum() > 0.6 * before, (x, y)
