"""The SO-101: Menagerie's kinematics, poses that five joints can meet, cameras that see the desk, and grasps that hold."""

import os
import xml.etree.ElementTree as ElementTree
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from jaxtyping import Float64

from vap_core.base.errors import OutOfReach
from vap_core.base.types import Rgb
from vap_core.simulation import scenes
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.shapes import Mesh, Solid
from vap_core.simulation.cameras import camera
from vap_core.simulation.control import arm, rotation, rotation_vector
from vap_core.simulation.env import Env
from vap_core.simulation.robots import ROBOTS
from vap_core.simulation.types import ROBOT, EpisodeRow, Placement

import mujoco  # isort: skip  (cameras has chosen a GL back end)

SO101 = ROBOTS["so101"]
X, Y = (0.17, 0.26), 0.12
"""The recommended workspace, metres."""


def pose(x: float, y: float, z: float, yaw: float = 0.0) -> Float64[np.ndarray, "4 4"]:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = rotation(np.array([0.0, 0.0, yaw])) @ SO101.down_base, (x, y, z)
    return made


def off(one: Float64[np.ndarray, "4 4"], other: Float64[np.ndarray, "4 4"]) -> tuple[float, float]:
    return float(np.linalg.norm(one[:3, 3] - other[:3, 3])), float(
        np.linalg.norm(rotation_vector(one[:3, :3] @ other[:3, :3].T))
    )


def reached(x: float, y: float, z: float, yaw: float) -> tuple[float, float]:
    """How far the arm stays from a pose, m and rad; with the jaws exchanged where that brings it nearer."""
    found = []
    for asked in (pose(x, y, z, yaw), pose(x, y, z, yaw + np.pi)):
        with suppress(OutOfReach):
            found.append(off(arm("so101").forward(arm("so101").reach(asked)), asked))
    return min(found, key=lambda place_turn: place_turn[1])


@pytest.fixture(scope="module")
def menagerie() -> mujoco.MjModel:
    """Menagerie's model without its meshes."""
    path = Path(os.environ.get("MENAGERIE_ROOT", "")) / "robotstudio_so101" / "so101.xml"
    if not path.is_file():
        pytest.skip("no Menagerie model; set MENAGERIE_ROOT to a checkout of mujoco_menagerie")
    root = ElementTree.parse(path).getroot()
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in ("geom", "mesh", "material"):
                parent.remove(child)
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))


def test_forward_kinematics_and_limits_are_menageries(menagerie: mujoco.MjModel) -> None:
    ours, rng = mujoco.MjModel.from_xml_path(str(SO101.xml)), np.random.default_rng(3)
    mine, theirs = mujoco.MjData(ours), mujoco.MjData(menagerie)
    names = (*SO101.joints, *SO101.fingers)
    for name in names:
        assert ours.joint(name).range == pytest.approx(menagerie.joint(name).range, abs=1e-6), name
    for _ in range(200):
        for name in names:
            mine.joint(name).qpos[0] = theirs.joint(name).qpos[0] = rng.uniform(
                *ours.joint(name).range
            )
        mujoco.mj_kinematics(ours, mine)
        mujoco.mj_kinematics(menagerie, theirs)
        for body in SO101.links:
            assert mine.body(body).xpos == pytest.approx(theirs.body(body).xpos, abs=1e-6), body
            assert mine.body(body).xmat == pytest.approx(theirs.body(body).xmat, abs=1e-6), body


def test_the_jaws_open_as_wide_as_the_registry_says_and_all_but_meet() -> None:
    model = mujoco.MjModel.from_xml_path(str(SO101.xml))
    data, fixed, moving = (
        mujoco.MjData(model),
        model.geom("fixed_pad").id,
        model.geom("moving_pad").id,
    )
    gaps = []
    for travel in (*SO101.fingers_open, *SO101.fingers_closed):
        data.joint("gripper").qpos[0] = travel
        mujoco.mj_forward(model, data)
        gaps.append(mujoco.mj_geomDistance(model, data, fixed, moving, 1.0, None))
    assert gaps[0] == pytest.approx(SO101.opening_m, abs=1e-3)
    assert 0 < gaps[1] < 0.005


@pytest.mark.parametrize("x", np.linspace(*X, 4).tolist())
@pytest.mark.parametrize("y", [-Y, 0.0, Y])
def test_straight_down_is_met_to_a_millimetre_and_a_degree_over_the_workspace(
    x: float, y: float
) -> None:
    """With the opening axis in every direction: the wrist does not turn all the way round, but one of the two ways to lay the axis fits."""
    for z in (0.02, 0.04, 0.06):
        for yaw in np.deg2rad([-90.0, -45.0, 0.0, 45.0]):
            place, turn = reached(x, y, z, float(yaw))
            assert place < 1e-3
            assert turn < np.deg2rad(1.0)


@pytest.mark.parametrize("z", [0.11, 0.15])
def test_higher_up_the_hand_leans_and_keeps_its_place(z: float) -> None:
    for x, y in ((X[0], 0.0), (X[1], 0.0), (X[0], Y), (X[1], -Y)):
        place, turn = off(arm("so101").forward(arm("so101").reach(pose(x, y, z))), pose(x, y, z))
        assert place < 1e-3
        assert turn < SO101.lean_rad + 0.01


def test_a_yaw_beyond_the_wrists_range_is_out_of_reach_however_far_the_hand_may_lean() -> None:
    with pytest.raises(OutOfReach, match="so101 stays"):
        arm("so101").reach(pose(0.2, 0.13, 0.05, -1.2))


@pytest.mark.parametrize("where", [(0.45, 0.0, 0.05), (0.09, 0.0, 0.15), (0.2, 0.0, 0.4)])
def test_out_of_reach_is_an_error_that_says_by_how_much(where: tuple[float, float, float]) -> None:
    with pytest.raises(OutOfReach, match=r"so101 stays .* mm and .* rad away"):
        arm("so101").reach(pose(*where))


@dataclass(frozen=True)
class Block:
    """A box that stands on the table, metres."""

    width: float
    depth: float
    height: float

    def mesh(self) -> Mesh:
        from trimesh import creation

        box = creation.box(extents=[self.width, self.depth, self.height])
        vertex = np.asarray(box.triangles, np.float64).reshape(-1, 3) + np.array(
            [0.0, 0.0, self.height / 2]
        )
        normal = np.repeat(np.asarray(box.face_normals, np.float64), 3, axis=0)
        return Mesh(
            vertex, normal, np.zeros((len(vertex), 2)), np.arange(len(vertex)).reshape(-1, 3)
        )

    def solids(self) -> tuple[Solid, ...]:
        return (
            Solid(
                "box", (self.width / 2, self.depth / 2, self.height / 2), (0, 0, self.height / 2)
            ),
        )

    def picture(self) -> Rgb:
        return np.zeros((8, 8, 3), np.uint8)


BLOCK = replace(
    objects.personal_instance("pen holder"),
    name="block",
    form=Block(0.05, 0.07, 0.07),
    mass_kg=0.1,
)
THINGS = {
    "cup": (objects.personal_instance("cup"), 0.04),
    "owl": (objects.personal_instance("owl figurine"), 0.03),
    "block": (BLOCK, 0.04),
}
"""What is grasped, and how high above the table, metres."""


@cache
def env(thing: str, control: Literal["ee", "joint"]) -> Env:
    return Env(scenes.build("so101", [THINGS[thing][0]]), control=control)


def drive(world: Env, goal: Float64[np.ndarray, "4 4"], gripper: float) -> None:
    """One action towards `goal`, in the language of the Env's control."""
    if world.control == "joint":
        delta = arm("so101").solve(world.command.joints, goal, 3 / world.hz) - world.command.joints
    else:
        now = world.command.tcp_base
        delta = np.concatenate(
            [goal[:3, 3] - now[:3, 3], rotation_vector(goal[:3, :3] @ now[:3, :3].T)]
        )
    world.step(np.array([*delta, gripper], np.float32))


def go(world: Env, goal: Float64[np.ndarray, "4 4"], gripper: float, seconds: float) -> None:
    """In a straight line."""
    start, steps = world.command.tcp_base[:3, 3].copy(), round(seconds * world.hz)
    for i in range(steps):
        between = goal.copy()
        between[:3, 3] = start + (i + 1) / steps * (goal[:3, 3] - start)
        drive(world, between, gripper)


SPOTS = [
    (0.18, 0.0, 0.0),
    (0.2, 0.1, 0.5),
    (0.24, -0.1, -0.5),
    (0.27, 0.05, 1.0),
    (0.17, -0.13, -1.0),
    (0.22, 0.13, 0.2),
]


GRASPED = [("cup", "joint"), ("owl", "joint"), ("block", "joint"), ("cup", "ee")]


def grasps() -> list[object]:
    """Every thing at every spot; each spot once in the daily tests, the rest in the sweeps."""
    found = []
    for i, spot in enumerate(SPOTS):
        for j, grasped in enumerate(GRASPED):
            marks = () if i % len(GRASPED) == j else pytest.mark.sweep
            found.append(pytest.param(*grasped, *spot, marks=marks))
    return found


@pytest.mark.parametrize(("thing", "control", "x", "y", "yaw"), grasps())
def test_a_scripted_grasp_lifts_shakes_and_holds(
    thing: str, control: Literal["ee", "joint"], x: float, y: float, yaw: float
) -> None:
    world, (model, z) = env(thing, control), THINGS[thing]
    turned = yaw + (np.pi / 2 if thing == "block" else 0.0)
    world.reset(
        EpisodeRow(
            "t",
            "t",
            0,
            0,
            "pick it up",
            model.category,
            (Placement(model.name, x, y, turned),),
            1000,
        )
    )
    go(world, pose(x, y, z + 0.07, yaw), 1.0, 1.5)
    go(world, pose(x, y, z, yaw), 1.0, 1.5)
    for i in range(24):
        drive(world, pose(x, y, z, yaw), 1.0 - i / 24)
    go(world, pose(x, y, z, yaw), 0.0, 0.4)
    go(world, pose(x, y, z + 0.1, yaw), 0.0, 1.5)
    for i in range(30):
        drive(world, pose(x, y + 0.02 * np.sin(0.6 * i), z + 0.1, yaw), 0.0)
    lifted = world.truth().objects_world[model.name][2]
    for _ in range(150):
        drive(world, pose(x, y, z + 0.1, yaw), 0.0)
    truth = world.truth()
    assert truth.contacts[model.name] == frozenset({ROBOT})
    assert truth.objects_world[model.name][2] > 0.08
    assert abs(truth.objects_world[model.name][2] - lifted) < 0.015


def test_fixed_cameras_see_the_workspace_and_the_arm_at_home_hides_none_of_it_from_the_front() -> (
    None
):
    model = env("cup", "joint").scene.model
    data = mujoco.MjData(model)
    for name, angle in zip(
        (*SO101.joints, *SO101.fingers), (*SO101.home, *SO101.fingers_open), strict=True
    ):
        data.joint(name).qpos[0] = angle
    mujoco.mj_forward(model, data)
    corners = np.array(
        [
            (x, y, z)
            for x in (X[0] - 0.02, X[1] + 0.02)
            for y in (-Y - 0.02, Y + 0.02)
            for z in (0.0, 0.12)
        ]
    )
    for name in ("front", "side"):
        seen = camera(model, data, name, (224, 224))
        local = (corners - seen.pose_world[:3, 3]) @ seen.pose_world[:3, :3]
        pixels = (local / local[:, 2:] @ seen.k.T)[:, :2]
        assert ((pixels > 0) & (pixels < 224)).all(), name
    eye, met = (
        camera(model, data, "front", (224, 224)).pose_world[:3, 3].copy(),
        np.zeros(1, np.int32),
    )
    robot = model.body("base").id
    for corner in np.concatenate([corners, corners * [1, 0, 1]]):
        share = mujoco.mj_ray(model, data, eye, corner - eye, None, 1, -1, met)
        assert (
            share < 0 or share >= 0.999 or model.body_rootid[model.geom_bodyid[met[0]]] != robot
        ), corner
