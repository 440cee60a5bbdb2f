"""Menagerie's meshes: they change what is seen of a robot and nothing else, and sit where Menagerie puts them."""

import os

import numpy as np
import pytest

from vap_core.base.errors import MissingMeshes
from vap_core.simulation.gl import ensure_gl
from vap_core.simulation.robots import ROBOTS
from vap_core.simulation.robots.mjcf import MODELS, replace_visuals
from vap_core.simulation.scenes import build

ensure_gl()
import mujoco  # noqa: E402

needs_meshes = pytest.mark.skipif(
    "MENAGERIE_ROOT" not in os.environ,
    reason="set MENAGERIE_ROOT to a folder that holds Menagerie's models",
)


@pytest.fixture(scope="module", params=sorted(ROBOTS))
def pair(request):
    """The same scene, plain and dressed."""
    with (
        build(request.param, ["cup-personal"]) as plain,
        build(request.param, ["cup-personal"], meshes="menagerie") as dressed,
    ):
        yield plain, dressed


def at_home(scene):
    data, robot = mujoco.MjData(scene.model), scene.robot
    for joint, angle in zip(
        (*robot.joints, *robot.fingers), (*robot.home, *robot.fingers_open), strict=True
    ):
        data.joint(joint).qpos[0] = angle
        data.actuator(joint).ctrl[0] = angle
    data.joint("cup-personal/free").qpos[:3] = 0.4, 0.0, 0.0
    mujoco.mj_forward(scene.model, data)
    return data


def worn(model, body):
    """Menagerie's geoms on a body."""
    geoms = [
        geom
        for geom in range(model.ngeom)
        if model.geom_bodyid[geom] == body and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
    ]
    return [geom for geom in geoms if model.geom_group[geom] == 2]


def box(model, data, geoms):
    """Bounding box of meshes in the world, metres."""
    points = []
    for geom in geoms:
        start, count = (
            model.mesh_vertadr[model.geom_dataid[geom]],
            model.mesh_vertnum[model.geom_dataid[geom]],
        )
        points.append(
            model.mesh_vert[start : start + count] @ data.geom_xmat[geom].reshape(3, 3).T
            + data.geom_xpos[geom]
        )
    return np.stack([np.concatenate(points).min(axis=0), np.concatenate(points).max(axis=0)])


@needs_meshes
def test_only_the_look_changes(pair):
    plain, dressed = (scene.model for scene in pair)
    for size in ("nq", "nv", "nu", "nbody", "njnt", "nsite", "ncam", "neq"):
        assert getattr(plain, size) == getattr(dressed, size), size
    for what in ("actuator", "joint", "body", "site", "camera"):
        count = {
            "actuator": plain.nu,
            "joint": plain.njnt,
            "body": plain.nbody,
            "site": plain.nsite,
            "camera": plain.ncam,
        }[what]
        assert [getattr(plain, what)(i).name for i in range(count)] == [
            getattr(dressed, what)(i).name for i in range(count)
        ]
    for field in (
        "jnt_range",
        "actuator_ctrlrange",
        "actuator_gainprm",
        "body_mass",
        "body_inertia",
        "body_ipos",
        "body_pos",
        "site_pos",
        "cam_pos",
    ):
        assert np.array_equal(getattr(plain, field), getattr(dressed, field)), field
    touchable = [model.geom_contype | model.geom_conaffinity for model in (plain, dressed)]
    forms = [
        np.concatenate([model.geom_size, model.geom_pos, model.geom_quat], axis=1)
        for model in (plain, dressed)
    ]
    ours, theirs = (form[touch > 0] for form, touch in zip(forms, touchable, strict=True))
    assert np.array_equal(ours, theirs)


@needs_meshes
def test_the_same_commands_lead_to_the_same_state(pair):
    plain, dressed = (at_home(scene) for scene in pair)
    assert plain.site("tcp").xpos == pytest.approx(dressed.site("tcp").xpos, abs=1e-12)
    for scene, data in zip(pair, (plain, dressed), strict=True):
        for joint in scene.robot.joints:
            data.actuator(joint).ctrl[0] += 0.1
        mujoco.mj_step(scene.model, data, 50)
    assert plain.qpos == pytest.approx(dressed.qpos, abs=1e-9)
    assert plain.qvel == pytest.approx(dressed.qvel, abs=1e-7)


@needs_meshes
def test_every_link_wears_meshes_where_menagerie_has_them(pair):
    import mujoco_menagerie

    scene, robot = pair[1], pair[1].robot
    original = mujoco_menagerie.get(MODELS[robot.name])
    model = original.model(original.default_model)
    ours, theirs = at_home(scene), mujoco.MjData(model)
    for joint, angle in zip(
        (*robot.joints, *robot.fingers), (*robot.home, *robot.fingers_open), strict=True
    ):
        theirs.joint(joint).qpos[0] = angle
    mujoco.mj_kinematics(model, theirs)
    body_of = {model.body(i).name.rpartition("/")[2]: i for i in range(model.nbody)}
    shift = ours.body(robot.links[0]).xpos - theirs.xpos[body_of[robot.links[0]]]
    for link in robot.links:
        mine, original_geoms = (
            worn(scene.model, scene.model.body(link).id),
            worn(model, body_of[link]),
        )
        assert len(mine) == len(original_geoms) > 0, link
        assert box(scene.model, ours, mine) == pytest.approx(
            box(model, theirs, original_geoms) + shift, abs=1e-4
        ), link


@needs_meshes
def test_the_robot_looks_different_and_the_rest_the_same(pair):
    pictures = []
    for scene in pair:
        data, camera = at_home(scene), mujoco.MjvCamera()
        camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (
            data.site("tcp").xpos,
            0.9,
            140,
            -15,
        )
        with mujoco.Renderer(scene.model, 224, 224, max_geom=500) as renderer:
            renderer.update_scene(data, camera)
            pictures.append(renderer.render().astype(int))
    differs = (np.abs(pictures[0] - pictures[1]).max(axis=2) > 8).mean()
    assert 0.01 < differs < 0.4
    masks = [
        scene.renderer.masks_and_hand(at_home(scene), scene.cameras[0], (224, 224))[0][
            "cup-personal"
        ]
        for scene in pair
    ]
    assert (masks[0] & masks[1]).sum() >= 0.8 * (masks[0] | masks[1]).sum() > 0


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_without_meshes_the_error_says_both_ways_to_get_them(name, monkeypatch, tmp_path):
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    ways = rf"no meshes of '{name}'.*go online once.*set MENAGERIE_ROOT to a folder that holds {MODELS[name]}/"
    with pytest.raises(MissingMeshes, match=ways) as caught:
        replace_visuals(mujoco.MjSpec.from_file(str(ROBOTS[name].xml)), ROBOTS[name])
    assert "\n" not in str(caught.value)


def test_without_a_network_the_error_is_the_same(monkeypatch, tmp_path):
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    monkeypatch.setenv("MENAGERIE_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("MENAGERIE_BASE_URL", "http://127.0.0.1:9/none")
    with pytest.raises(MissingMeshes, match="go online once"):
        build("wx250s", [], meshes="menagerie")
