"""Rendered training scenes of generic objects on the robots' tables, with the object behind every pixel.

A stage is one compiled scene: a robot, a crew of look-alikes and some other objects, seen in `VIEWS` views; the crew also sits for portraits
in the studio, as reference photos do. Stages are numbered; the same seed and number give the same pixels. Training stages draw generic
instances 0..`TRAIN_INSTANCES` - 1, held-out stages instances from `HELD_OUT` on; personal instances and look-alikes never appear
(`only_generic` refuses them).
"""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int64, UInt8

from vap_core.base.types import value
from vap_core.simulation import robots, scenes
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.objects import ObjectModel
from vap_core.simulation.scene_style import DEFAULT_STYLE, SceneStyle
from vap_core.simulation.studio import Shot, Stage

import mujoco  # isort: skip  (scenes has chosen a GL back end)

SIZE, PORTRAIT = 224, 256
"""Pixels, square, of a view and of a portrait."""
VIEWS, POSES = 12, 3
"""Views of one stage; portraits of each member of its crew."""
WORK = {
    "google": ((0.515, 0.0), (0.14, 0.25)),
    "panda": ((0.46, 0.0), (0.13, 0.20)),
    "so101": ((0.225, 0.0), (0.09, 0.19)),
    "wx250s": ((0.27, 0.0), (0.15, 0.20)),
}
"""Where each robot works: centre and half extents of a rectangle on its table, metres."""
TRAIN_INSTANCES, HELD_OUT = 400, 100_000
BURIED_M = -5.0
LEAST_PX = 60
"""Pixels of objects that a view shows."""
ANGLES = ((-0.3, 0.3), (0.26, 0.96), (0.45, 0.75), (-1.3, 1.3), (0.45, 0.8))
"""Of a portrait: turn and elevation (radians), share of the frame, lamp's place and strength; see studio.Shot."""
Generator = np.random.Generator


@value
class Shots:
    """Views of one stage: `ids[v]` is 0 for the rest of the scene and i + 1 where `names[i]`, of `categories[i]`, is seen.

    The crew are the first objects, look-alikes of each other; portrait j shows number j // `POSES` of them.
    """

    rgb: UInt8[np.ndarray, "v h w 3"]
    ids: UInt8[np.ndarray, "v h w"]
    portraits: UInt8[np.ndarray, "p s s 3"]
    portrait_ids: UInt8[np.ndarray, "p s s"]
    names: tuple[str, ...]
    categories: tuple[str, ...]


def only_generic(models: Sequence[ObjectModel]) -> None:
    """Raises: ValueError when an evaluation object is about to be trained on."""
    wrong = sorted(model.name for model in models if model.split != "generic")
    if wrong:
        raise ValueError(
            f"training.scenes: {', '.join(wrong)} belong to evaluation and are never trained on; use objects.generic_instance."
        )


def cast(rng: Generator, held_out: bool) -> tuple[list[ObjectModel], int]:
    """A crew of two to four look-alikes, then bystanders: one to three other kinds, mostly one of each. Also the crew's number."""
    leader = str(rng.choice(objects.CATEGORIES if rng.random() < 0.9 else objects.CLUTTER))
    others = [
        str(kind)
        for kind in rng.permutation(np.array(objects.CATEGORIES + objects.CLUTTER))
        if kind != leader
    ]
    stems = {"cup": ("cup", "paper-cup")}
    first = HELD_OUT if held_out else 0
    crew = int(rng.choice([2, 3, 4], p=[0.2, 0.6, 0.2]))
    index = first + int(rng.integers(TRAIN_INSTANCES))
    chief = str(rng.choice(stems.get(leader, (leader,))))
    models = [
        objects.generic_instance(chief, index, int(twin)) for twin in rng.permutation(6)[:crew]
    ]
    for kind in others[: int(rng.integers(1, 4))]:
        picks = rng.choice(TRAIN_INSTANCES, size=1 + int(rng.random() < 0.3), replace=False)
        models += [
            objects.generic_instance(str(rng.choice(stems.get(kind, (kind,)))), first + int(i))
            for i in picks
        ]
    only_generic(models)
    return models, crew


def draw_style(rng: Generator) -> SceneStyle:
    """A room in random colours; one table in three is plain."""

    def tint(low: float, high: float) -> tuple[float, float, float]:
        r, g, b = np.clip(rng.uniform(low, high) + rng.uniform(-0.12, 0.12, 3), 0.02, 1)
        return float(r), float(g), float(b)

    light = tint(0.15, 0.95)
    shade = float(rng.uniform(0.7, 0.95))
    dark = light if rng.random() < 0.35 else (light[0] * shade, light[1] * shade, light[2] * shade)
    if rng.random() < 0.4:
        usual = DEFAULT_STYLE
        return SceneStyle(usual.planks, usual.wall, usual.floor, shadows=bool(rng.random() < 0.2))
    return SceneStyle(
        (light, dark), tint(0.3, 0.95), tint(0.15, 0.8), shadows=bool(rng.random() < 0.2)
    )


def stage(
    seed: int, number: int, *, held_out: bool = False, views: int = VIEWS, size: int = SIZE
) -> Shots:
    """Render one stage."""
    rng = np.random.default_rng([seed, number, int(held_out)])
    models, crew = cast(rng, held_out)
    robot = sorted(robots.ROBOTS)[int(rng.integers(len(robots.ROBOTS)))]
    with (
        scenes.build(robot, models, style=draw_style(rng)) as scene,
        mujoco.Renderer(scene.model, size, size) as renderer,
    ):
        data = mujoco.MjData(scene.model)
        pictures: list[tuple[np.ndarray, np.ndarray]] = []
        while len(pictures) < views:
            picture = _view(rng, scene, data, renderer)
            if (
                picture[1] > 0
            ).sum() >= LEAST_PX or rng.random() < 0.1:  # an empty view now and then
                pictures.append(picture)
    rgb, ids = (np.stack(part) for part in zip(*pictures, strict=True))
    portraits, portrait_ids = _portraits(rng, models[:crew])
    return Shots(
        rgb, ids, portraits, portrait_ids, scene.objects, tuple(model.category for model in models)
    )


def _portraits(rng: Generator, models: Sequence[ObjectModel]) -> tuple[np.ndarray, np.ndarray]:
    """Every model alone in the studio, `POSES` times, from around and 15 to 55 degrees above."""
    rgb, ids = [], []
    with Stage(models, PORTRAIT) as studio:
        for i, model in enumerate(models):
            for turn in rng.uniform(0, 2 * np.pi) + 2 * np.pi / POSES * np.arange(POSES):
                grey = rng.uniform(0.35, 0.85)
                red, green, blue = np.clip(grey + rng.uniform(-0.06, 0.06, 3), 0, 1).tolist()
                azimuth, elevation, fill, lamp, bright = (
                    float(rng.uniform(*span)) for span in ANGLES
                )
                shot = Shot(
                    float(turn) + azimuth, elevation, fill, lamp, bright, (red, green, blue)
                )
                rgb.append(studio.picture(model.name, shot))
                ids.append(np.where(studio.mask(model.name, shot), i + 1, 0).astype(np.uint8))
    return np.stack(rgb), np.stack(ids)


def owners(scene: scenes.Scene) -> Int64[np.ndarray, " g"]:
    """Of each geom, 1 + the index of its object, or 0."""
    roots = {int(scene.model.body(name).id): i + 1 for i, name in enumerate(scene.objects)}
    return np.array(
        [roots.get(int(scene.model.body_rootid[body]), 0) for body in scene.model.geom_bodyid],
        np.int64,
    )


def draw(
    scene: scenes.Scene,
    data: mujoco.MjData,
    renderer: mujoco.Renderer,
    camera: "mujoco.MjvCamera | str",
    shadows: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Colour and object ids of one picture."""
    renderer.update_scene(data, camera=camera)
    for flag in (
        mujoco.mjtRndFlag.mjRND_REFLECTION,
        mujoco.mjtRndFlag.mjRND_SKYBOX,
        mujoco.mjtRndFlag.mjRND_HAZE,
    ):
        renderer.scene.flags[flag] = 0
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = int(shadows)
    rgb = renderer.render().copy()
    renderer.enable_segmentation_rendering()
    drawn = renderer.render()
    renderer.disable_segmentation_rendering()
    geom = np.where(drawn[..., 1] == mujoco.mjtObj.mjOBJ_GEOM, drawn[..., 0], -1)
    return rgb, np.where(geom >= 0, owners(scene)[geom], 0).astype(np.uint8)


def scatter(
    rng: Generator, n: int, centre: tuple[float, float], half: tuple[float, float], gap_m: float
) -> np.ndarray:
    """n points (m) in a rectangle, at least `gap_m` apart; the gap gives way when the rectangle is full."""
    points: list[np.ndarray] = []
    while len(points) < n:
        point = np.array(centre) + rng.uniform(-1, 1, 2) * half
        if all(np.linalg.norm(point - other) >= gap_m for other in points):
            points.append(point)
        else:
            gap_m *= 0.98
    return np.array(points).reshape(-1, 2)


def _pose(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Bring bodies, cameras and lamps where the joints say; what overlaps may overlap."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)


def _view(
    rng: Generator, scene: scenes.Scene, data: mujoco.MjData, renderer: mujoco.Renderer
) -> tuple[np.ndarray, np.ndarray]:
    model, robot = scene.model, scene.robot
    rigged = (
        rng.random() < 0.6
    )  # through the robot's own cameras, jittered; else from anywhere above the table
    close = not rigged and rng.random() < 0.5
    (x_m, y_m), half_m = WORK[robot.name]
    mujoco.mj_resetData(model, data)
    home = robot.home + rng.normal(0, 0.18, len(robot.home)) * (rng.random() < 0.7)
    for name, angle in zip(robot.joints, home, strict=True):
        data.joint(name).qpos[:] = angle
    for name, low, high in zip(
        robot.fingers, robot.fingers_closed, robot.fingers_open, strict=True
    ):
        data.joint(name).qpos[:] = low + rng.random() * (high - low)
    shown = rng.permutation(len(scene.objects))[
        : 1 if close and rng.random() < 0.6 else int(rng.integers(2, len(scene.objects) + 1))
    ]
    spots = scatter(
        rng,
        len(shown),
        (x_m + float(rng.uniform(-0.03, 0.03)), y_m),
        half_m,
        float(rng.uniform(0.05, 0.12)),
    )
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
    _pose(model, data)
    if rng.random() < 0.12:  # between the fingers
        tcp = data.site("tcp").xpos + rng.normal(0, 0.006, 3)
        data.joint(f"{scene.objects[held]}/free").qpos[:3] = tcp - (0, 0, rng.uniform(0.02, 0.06))
        _pose(model, data)
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
        camera.lookat[:] = target + np.array(
            [*rng.normal(0, 0.01 if close else 0.06, 2), rng.uniform(0.03, 0.05)]
        )
        camera.azimuth, camera.elevation = rng.uniform(-180, 180), -rng.uniform(15, 65)
        model.vis.global_.fovy = rng.uniform(30, 60)
        pixels = rng.uniform(90, 150) if close else rng.uniform(25, 90)
        camera.distance = (
            0.09 * SIZE / (pixels * 2 * np.tan(np.radians(model.vis.global_.fovy) / 2))
        )
    return draw(scene, data, renderer, camera, scene.renderer.shadows)


PARTS = ("rgb", "ids", "portraits", "portrait_ids", "names", "categories")


def cached(folder: Path, seed: int, number: int, *, held_out: bool = False) -> Shots:
    """The stage from `folder`, rendered first if it is not there."""
    path = folder / f"{'held' if held_out else 'train'}-{seed}-{number:05d}.npz"
    if not path.exists():
        shots = stage(seed, number, held_out=held_out)
        folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part.npz")
        np.savez(part, **{name: getattr(shots, name) for name in PARTS})
        os.replace(part, path)
    with np.load(path) as file:
        names, categories = (tuple(map(str, file[part])) for part in ("names", "categories"))
        return Shots(
            file["rgb"], file["ids"], file["portraits"], file["portrait_ids"], names, categories
        )


def boxes_of(
    ids: UInt8[np.ndarray, "h w"], n: int, least_px: int = 40
) -> Iterator[tuple[int, tuple[int, int, int, int]]]:
    """Index and visible box (far corner exclusive) of every object with at least `least_px` visible pixels."""
    for i in range(n):
        rows, cols = np.nonzero(ids == i + 1)
        if len(rows) >= least_px:
            yield i, (int(cols.min()), int(rows.min()), int(cols.max()) + 1, int(rows.max()) + 1)
