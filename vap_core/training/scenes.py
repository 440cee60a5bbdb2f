"""Pictures to train perception on: generic objects around every robot, under random looks, lamps and cameras.

A *stage* is one compiled scene seen many times: objects, arm, lamp and camera move between its views. Stages are numbered;
the same seed and number give the same pixels. Training stages draw generic instances 0..`TRAIN_INSTANCES` - 1, held-out
stages instances from `HELD_OUT` on; personal instances and look-alikes never appear (`only_generic` refuses them).
"""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int64, UInt8

from vap_core.sim import objects, robots, scenes
from vap_core.sim.look import Look
from vap_core.sim.objects import ObjectModel
from vap_core.values import value

import mujoco  # isort: skip  (scenes has chosen a GL back end)

SIZE = 224
VIEWS = 12
"""Views of one stage."""
TRAIN_INSTANCES, HELD_OUT = 400, 100_000
BURIED_M = -5.0
Generator = np.random.Generator


@value
class Shots:
    """Views of one stage: `ids[v]` is 0 for the rest of the scene and i + 1 where `names[i]`, of `categories[i]`, is seen."""

    rgb: UInt8[np.ndarray, "v h w 3"]
    ids: UInt8[np.ndarray, "v h w"]
    names: tuple[str, ...]
    categories: tuple[str, ...]


def only_generic(models: Sequence[ObjectModel]) -> None:
    """Raises: ValueError when an evaluation object is about to be trained on."""
    wrong = sorted(model.name for model in models if model.split != "generic")
    if wrong:
        raise ValueError(f"training.scenes: {', '.join(wrong)} belong to evaluation and are never trained on; use objects.generic.")


def cast(rng: Generator, held_out: bool) -> list[ObjectModel]:
    """Two to four kinds of objects, one to three instances of each, as an episode's target, look-alikes and bystanders."""
    kinds = rng.permutation(np.array(objects.CATEGORIES + objects.CLUTTER))[: rng.integers(2, 5)]
    models = []
    for kind in kinds:
        picks = rng.choice(TRAIN_INSTANCES, size=int(rng.integers(1, 4)), replace=False)
        models += [objects.generic(str(kind), int(i) + (HELD_OUT if held_out else 0)) for i in picks]
    only_generic(models)
    return models


def look(rng: Generator) -> Look:
    """A room in random colours; one table in three is plain."""

    def tint(low: float, high: float) -> tuple[float, float, float]:
        r, g, b = np.clip(rng.uniform(low, high) + rng.uniform(-0.12, 0.12, 3), 0.02, 1)
        return float(r), float(g), float(b)

    light = tint(0.15, 0.95)
    shade = float(rng.uniform(0.7, 0.95))
    dark = light if rng.random() < 0.35 else (light[0] * shade, light[1] * shade, light[2] * shade)
    if rng.random() < 0.3:
        usual = scenes.LOOK
        return Look(usual.planks, usual.wall, usual.floor, shadows=bool(rng.random() < 0.2))
    return Look((light, dark), tint(0.3, 0.95), tint(0.15, 0.8), shadows=bool(rng.random() < 0.2))


def stage(seed: int, number: int, *, held_out: bool = False, views: int = VIEWS, size: int = SIZE) -> Shots:
    """Render one stage."""
    rng = np.random.default_rng([seed, number, int(held_out)])
    models = cast(rng, held_out)
    robot = sorted(robots.ROBOTS)[int(rng.integers(len(robots.ROBOTS)))]
    with scenes.build(robot, models, look=look(rng)) as scene, mujoco.Renderer(scene.model, size, size) as renderer:
        data = mujoco.MjData(scene.model)
        pictures = [_view(rng, scene, data, renderer) for _ in range(views)]
    rgb, ids = zip(*pictures, strict=True)
    return Shots(np.stack(rgb), np.stack(ids), scene.objects, tuple(model.category for model in models))


def owners(scene: scenes.Scene) -> Int64[np.ndarray, " g"]:
    """Of each geom, 1 + the index of its object, or 0."""
    roots = {int(scene.model.body(name).id): i + 1 for i, name in enumerate(scene.objects)}
    return np.array([roots.get(int(scene.model.body_rootid[body]), 0) for body in scene.model.geom_bodyid], np.int64)


def draw(
    scene: scenes.Scene, data: mujoco.MjData, renderer: mujoco.Renderer, camera: "mujoco.MjvCamera | str", shadows: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Colour and object ids of one picture."""
    renderer.update_scene(data, camera=camera)
    for flag in (mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_SKYBOX, mujoco.mjtRndFlag.mjRND_HAZE):
        renderer.scene.flags[flag] = 0
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = int(shadows)
    rgb = renderer.render().copy()
    renderer.enable_segmentation_rendering()
    drawn = renderer.render()
    renderer.disable_segmentation_rendering()
    geom = np.where(drawn[..., 1] == mujoco.mjtObj.mjOBJ_GEOM, drawn[..., 0], -1)
    return rgb, np.where(geom >= 0, owners(scene)[geom], 0).astype(np.uint8)


def scatter(rng: Generator, n: int, centre: tuple[float, float], half: tuple[float, float], gap_m: float) -> np.ndarray:
    """n points (m) in a rectangle, at least `gap_m` apart; the gap gives way when the rectangle is full."""
    points: list[np.ndarray] = []
    while len(points) < n:
        point = np.array(centre) + rng.uniform(-1, 1, 2) * half
        if all(np.linalg.norm(point - other) >= gap_m for other in points):
            points.append(point)
        else:
            gap_m *= 0.98
    return np.array(points).reshape(-1, 2)


def _view(rng: Generator, scene: scenes.Scene, data: mujoco.MjData, renderer: mujoco.Renderer) -> tuple[np.ndarray, np.ndarray]:
    model, robot = scene.model, scene.robot
    rigged = rng.random() < 0.6  # through the robot's own cameras, jittered; else from anywhere above the table
    close = not rigged and rng.random() < 0.5
    aim_x = {"wx250s": 0.27}.get(robot.name, 0.48) + rng.uniform(-0.06, 0.06)
    mujoco.mj_resetData(model, data)
    home = robot.home + rng.normal(0, 0.25, len(robot.home)) * (rng.random() < 0.8)
    for name, angle in zip(robot.joints, home, strict=True):
        data.joint(name).qpos[:] = angle
    for name, low, high in zip(robot.fingers, robot.fingers_closed, robot.fingers_open, strict=True):
        data.joint(name).qpos[:] = low + rng.random() * (high - low)
    shown = rng.permutation(len(scene.objects))[: 1 if close and rng.random() < 0.6 else int(rng.integers(1, len(scene.objects) + 1))]
    spots = scatter(rng, len(shown), (float(aim_x), 0.0), (0.15, 0.2), float(rng.uniform(0.05, 0.12)))
    for i, name in enumerate(scene.objects):
        data.joint(f"{name}/free").qpos[:3] = (-3, 0.3 * i, BURIED_M)
    for (x, y), i in zip(spots, shown, strict=True):
        axis = np.array([0.0, 0.0, 1.0]) if rng.random() < 0.85 else rng.normal(size=3)
        quat = np.zeros(4)
        mujoco.mju_axisAngle2Quat(quat, axis / np.linalg.norm(axis), rng.uniform(-np.pi, np.pi))
        z = 0.0005 if axis[2] == 1 else rng.uniform(0.03, 0.16)
        data.joint(f"{scene.objects[i]}/free").qpos[:] = (x, y, z, *quat)
    held = shown[0]
    lamp = np.array([rng.uniform(-1, 1), rng.uniform(-1, 1), -rng.uniform(0.8, 2)])
    model.light_dir[0] = lamp / np.linalg.norm(lamp)
    model.light_diffuse[0] = rng.uniform(0.3, 0.75) * np.clip(rng.normal(1, 0.06, 3), 0.8, 1.2)
    model.vis.headlight.ambient[:] = rng.uniform(0.2, 0.5)
    mujoco.mj_forward(model, data)
    if rng.random() < 0.12:  # between the fingers
        tcp = data.site("tcp").xpos + rng.normal(0, 0.006, 3)
        data.joint(f"{scene.objects[held]}/free").qpos[:3] = tcp - (0, 0, rng.uniform(0.02, 0.06))
        mujoco.mj_forward(model, data)
    camera: mujoco.MjvCamera | str
    if rigged:
        camera = scene.cameras[int(rng.integers(len(scene.cameras)))]
        at = int(model.camera(camera).id)
        data.cam_xpos[at] += rng.normal(0, 0.025, 3)
        turn, spin = np.zeros(9), np.zeros(4)
        mujoco.mju_euler2Quat(spin, rng.normal(0, 0.05, 3), "xyz")
        mujoco.mju_quat2Mat(turn, spin)
        data.cam_xmat[at] = (data.cam_xmat[at].reshape(3, 3) @ turn.reshape(3, 3)).ravel()
    else:
        camera = mujoco.MjvCamera()
        target = data.body(scene.objects[shown[0]]).xpos
        camera.lookat[:] = target + np.array([*rng.normal(0, 0.01 if close else 0.06, 2), rng.uniform(0.03, 0.05)])
        camera.azimuth, camera.elevation = rng.uniform(-180, 180), -rng.uniform(15, 65)
        model.vis.global_.fovy = rng.uniform(30, 60)
        pixels = rng.uniform(90, 150) if close else rng.uniform(25, 90)
        camera.distance = 0.09 * SIZE / (pixels * 2 * np.tan(np.radians(model.vis.global_.fovy) / 2))
    return draw(scene, data, renderer, camera, scene.eyes.shadows)


def cached(folder: Path, seed: int, number: int, *, held_out: bool = False) -> Shots:
    """The stage from `folder`, rendered first if it is not there."""
    path = folder / f"{'held' if held_out else 'train'}-{seed}-{number:05d}.npz"
    if not path.exists():
        shots = stage(seed, number, held_out=held_out)
        folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part.npz")
        np.savez(part, rgb=shots.rgb, ids=shots.ids, names=shots.names, categories=shots.categories)
        os.replace(part, path)
    with np.load(path) as file:
        return Shots(file["rgb"], file["ids"], tuple(map(str, file["names"])), tuple(map(str, file["categories"])))


def boxes_of(ids: UInt8[np.ndarray, "h w"], n: int, least_px: int = 40) -> Iterator[tuple[int, tuple[int, int, int, int]]]:
    """Index and visible box (far corner exclusive) of every object with at least `least_px` visible pixels."""
    for i in range(n):
        rows, cols = np.nonzero(ids == i + 1)
        if len(rows) >= least_px:
            yield i, (int(cols.min()), int(rows.min()), int(cols.max()) + 1, int(rows.max()) + 1)
