"""Rendered training scenes of generic objects, with the object of every pixel.

A stage is one compiled scene: a robot at its table, a crew of look-alikes and some other objects,
seen in VIEWS views; the crew also sits for portraits in the studio, as reference photos do. Stages
are numbered; the same seed and number give the same pixels. Training stages draw generic instances
0..TRAIN_INSTANCES - 1, held-out stages instances from HELD_OUT on; personal instances and
look-alikes never appear (`only_generic` refuses them).
"""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt8

from vap_core.base.files import kept_folder, replacing, writing
from vap_core.base.types import value
from vap_core.simulation import robots, scenes
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.objects import ObjectModel
from vap_core.simulation.looks import DEFAULT_STYLE, Colour3, SceneStyle
from vap_core.simulation.studio import Shot, Stage
from vap_make.folder import kept_arrays
from vap_make.objects import dye_some, generic_instance

import mujoco  # isort: skip  (scenes has chosen a GL back end)

CACHE = kept_folder("cache")
"""Rendered films and scenes, in folders of it."""
SIZE = 224
"""Pixels, square, of a view."""
PORTRAIT = 256
"""Pixels, square, of a portrait."""
VIEWS = 12
"""Views of one stage."""
POSES = 3
"""Portraits of each member of a stage's crew."""
WORK = {
    "google": ((0.515, 0.0), (0.14, 0.25)),
    "panda": ((0.46, 0.0), (0.13, 0.20)),
    "so101": ((0.225, 0.0), (0.09, 0.19)),
    "wx250s": ((0.27, 0.0), (0.15, 0.20)),
}
"""Where each robot works: centre and half extents of a rectangle on its table, metres."""
TRAIN_INSTANCES = 400
HELD_OUT = 100_000
BURIED_M = -5.0
"""Height of the objects that a view leaves out."""
MIN_SHOT_PX = 60
"""Pixels of objects that a view shows."""
ANGLES = ((-0.3, 0.3), (0.26, 0.96), (0.45, 0.75), (-1.3, 1.3), (0.45, 0.8))
"""Ranges of a portrait's turn, elevation (radians), share of the frame, lamp's place and strength.

See studio.Shot.
"""
PARTS = ("rgb", "ids", "portraits", "portrait_ids", "names", "categories")
"""The fields of Shots, as files keep them."""
Generator = np.random.Generator
Look = Callable[[Generator], SceneStyle]


@value
class Shots:
    """Views and portraits of one stage.

    `ids[v]` is 0 for the rest of the scene and i + 1 where `names[i]`, of `categories[i]`, is seen.
    The crew are the first objects, look-alikes of each other; portrait j shows number j // POSES
    of them.
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
            f"training.scenes: {', '.join(wrong)} belong to evaluation and are never trained on; "
            "use vap_make.objects.generic_instance."
        )


def draw_objects(
    rng: Generator, held_out: bool, dyes: bool = False
) -> tuple[list[ObjectModel], int]:
    """A crew of two to four look-alikes, then bystanders, and the number of the crew.

    Bystanders are of one to three other kinds, mostly one of each. With `dyes`, most scenes have
    dyed objects.
    """
    leader = str(rng.choice(objects.CATEGORIES if rng.random() < 0.9 else objects.CLUTTER))
    kinds = rng.permutation(np.array(objects.CATEGORIES + objects.CLUTTER))
    other_kinds = [str(kind) for kind in kinds if kind != leader]
    first = HELD_OUT if held_out else 0
    crew = int(rng.choice([2, 3, 4], p=[0.2, 0.6, 0.2]))
    index = first + int(rng.integers(TRAIN_INSTANCES))
    stem = _draw_stem(rng, leader)
    models = []
    for twin in rng.permutation(6)[:crew]:
        models.append(generic_instance(stem, index, int(twin)))
    for kind in other_kinds[: int(rng.integers(1, 4))]:
        count = 1 + int(rng.random() < 0.3)
        for i in rng.choice(TRAIN_INSTANCES, size=count, replace=False):
            bystander = _draw_stem(rng, kind)
            models.append(generic_instance(bystander, first + int(i)))
    if dyes:
        models = dye_some(models, rng)
    only_generic(models)
    return models, crew


def draw_style(rng: Generator) -> SceneStyle:
    """A room in random colours; one table in three is plain."""
    light = _draw_tint(rng, 0.15, 0.95)
    shade = float(rng.uniform(0.7, 0.95))
    if rng.random() < 0.35:
        dark = light
    else:
        dark = (light[0] * shade, light[1] * shade, light[2] * shade)
    if rng.random() < 0.4:
        planks = DEFAULT_STYLE.planks
        wall = DEFAULT_STYLE.wall
        floor = DEFAULT_STYLE.floor
    else:
        planks = (light, dark)
        wall = _draw_tint(rng, 0.3, 0.95)
        floor = _draw_tint(rng, 0.15, 0.8)
    shadows = bool(rng.random() < 0.2)
    return SceneStyle(planks=planks, wall=wall, floor=floor, shadows=shadows)


def stage(
    seed: int,
    number: int,
    *,
    held_out: bool = False,
    views: int = VIEWS,
    look: Look = draw_style,
    dyes: bool = False,
) -> Shots:
    """Render one stage, in a room that `look` draws; with `dyes`, of dyed objects too."""
    rng = np.random.default_rng([seed, number, int(held_out)])
    models, crew = draw_objects(rng, held_out, dyes)
    robot = sorted(robots.ROBOTS)[int(rng.integers(len(robots.ROBOTS)))]
    with (
        scenes.build(robot, models, style=look(rng)) as scene,
        mujoco.Renderer(scene.model, SIZE, SIZE) as renderer,
    ):
        scene.model.opt.enableflags = 0  # else a lamp that is moved stays where it was
        data = mujoco.MjData(scene.model)
        rgb: list[np.ndarray] = []
        ids: list[np.ndarray] = []
        while len(rgb) < views:
            view_rgb, view_ids = _view(rng, scene, data, renderer)
            # An empty view is kept now and then.
            if (view_ids > 0).sum() >= MIN_SHOT_PX or rng.random() < 0.1:
                rgb.append(view_rgb)
                ids.append(view_ids)
    portraits, portrait_ids = _portraits(rng, models[:crew])
    return Shots(
        rgb=np.stack(rgb),
        ids=np.stack(ids),
        portraits=portraits,
        portrait_ids=portrait_ids,
        names=scene.objects,
        categories=tuple(model.category for model in models),
    )


def owners(scene: scenes.Scene) -> Int64[np.ndarray, " g"]:
    """Of each geom, 1 + the index of its object, or 0."""
    model = scene.model
    owner_of_body = np.zeros(model.nbody, np.int64)
    for i, name in enumerate(scene.objects):
        owner_of_body[int(model.body(name).id)] = i + 1
    roots = model.body_rootid[model.geom_bodyid]
    return owner_of_body[roots]


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
    ids = np.where(geom >= 0, owners(scene)[geom], 0)
    return rgb, ids.astype(np.uint8)


def scatter(
    rng: Generator, n: int, centre: tuple[float, float], half: tuple[float, float], gap_m: float
) -> np.ndarray:
    """n points (m) in a rectangle, at least `gap_m` apart.

    The gap gives way when the rectangle is full.
    """
    points: list[np.ndarray] = []
    while len(points) < n:
        point = np.array(centre) + rng.uniform(-1, 1, 2) * half
        if all(np.linalg.norm(point - other) >= gap_m for other in points):
            points.append(point)
        else:
            gap_m *= 0.98
    return np.array(points).reshape(-1, 2)


def cached(
    folder: Path,
    seed: int,
    number: int,
    *,
    held_out: bool = False,
    look: Look = draw_style,
    dyes: bool = False,
) -> Shots:
    """The stage from `folder`, rendered first if it is not there.

    Raises: BadOutput when its file is damaged or cannot be written.
    """
    path = stage_file(folder, seed, number, held_out)
    if not path.exists():
        started = time.process_time()
        shots = stage(seed, number, held_out=held_out, look=look, dyes=dyes)
        arrays: dict[str, Any] = {"cpu_s": np.array(time.process_time() - started)}
        for name in PARTS:
            arrays[name] = getattr(shots, name)
        with writing(path, "train"):
            folder.mkdir(parents=True, exist_ok=True)
            with replacing(path) as part, part.open("wb") as file:
                np.savez(file, **arrays)
    with kept_arrays(path, "train") as file:
        return Shots(
            rgb=file["rgb"],
            ids=file["ids"],
            portraits=file["portraits"],
            portrait_ids=file["portrait_ids"],
            names=tuple(map(str, file["names"])),
            categories=tuple(map(str, file["categories"])),
        )


def stage_file(folder: Path, seed: int, number: int, held_out: bool) -> Path:
    """The file of a stage."""
    kind = "held" if held_out else "train"
    return folder / f"{kind}-{seed}-{number:05d}.npz"


def boxes_of(
    ids: UInt8[np.ndarray, "_h _w"], n: int, least_px: int = 40
) -> Iterator[tuple[int, tuple[int, int, int, int]]]:
    """Index and visible box of every object with at least `least_px` visible pixels.

    A box is x0, y0, x1, y1 in pixels, the far corner exclusive.
    """
    for i in range(n):
        rows, cols = np.nonzero(ids == i + 1)
        if len(rows) >= least_px:
            yield i, (int(cols.min()), int(rows.min()), int(cols.max()) + 1, int(rows.max()) + 1)


def _draw_stem(rng: Generator, kind: str) -> str:
    """The name of a kind's instances; a cup may be a paper cup."""
    stems = ("cup", "paper-cup") if kind == "cup" else (kind,)
    return str(rng.choice(stems))


def _draw_tint(rng: Generator, low: float, high: float) -> Colour3:
    grey = rng.uniform(low, high)
    r, g, b = np.clip(grey + rng.uniform(-0.12, 0.12, 3), 0.02, 1)
    return float(r), float(g), float(b)


def _portraits(rng: Generator, models: Sequence[ObjectModel]) -> tuple[np.ndarray, np.ndarray]:
    """Every model alone in the studio, POSES times, from around and 15 to 55 degrees above."""
    rgb = []
    ids = []
    with Stage(models, PORTRAIT) as studio:
        for i, model in enumerate(models):
            turns = rng.uniform(0, 2 * np.pi) + 2 * np.pi / POSES * np.arange(POSES)
            for turn in turns:
                shot = _draw_shot(rng, float(turn))
                rgb.append(studio.picture(model.name, shot))
                mask = studio.mask(model.name, shot)
                ids.append(np.where(mask, i + 1, 0).astype(np.uint8))
    return np.stack(rgb), np.stack(ids)


def _draw_shot(rng: Generator, turn: float) -> Shot:
    """A portrait's camera, lamp and table, seen from about `turn` radians."""
    grey = rng.uniform(0.35, 0.85)
    red, green, blue = np.clip(grey + rng.uniform(-0.06, 0.06, 3), 0, 1).tolist()
    drawn = []
    for low, high in ANGLES:
        drawn.append(float(rng.uniform(low, high)))
    azimuth, elevation, fill, lamp, bright = drawn
    return Shot(
        azimuth=turn + azimuth,
        elevation=elevation,
        fill=fill,
        lamp=lamp,
        bright=bright,
        table=(red, green, blue),
    )


def _view(
    rng: Generator, scene: scenes.Scene, data: mujoco.MjData, renderer: mujoco.Renderer
) -> tuple[np.ndarray, np.ndarray]:
    """Colour and object ids of a view of objects in new places.

    It is seen through one of the robot's own cameras, jittered, or from anywhere above the table.
    """
    own_camera = rng.random() < 0.6
    close = not own_camera and rng.random() < 0.5
    mujoco.mj_resetData(scene.model, data)
    _pose_robot(rng, scene, data)
    first = _place_objects(rng, scene, data, close)
    _draw_light(rng, scene.model)
    _update_kinematics(scene.model, data)
    if rng.random() < 0.12:
        _put_into_hand(rng, scene, data, first)
    camera: mujoco.MjvCamera | str
    if own_camera:
        camera = _jitter_camera(rng, scene, data)
    else:
        target = data.body(first).xpos
        camera = _draw_free_camera(rng, scene.model, target, close)
    return draw(
        scene=scene,
        data=data,
        renderer=renderer,
        camera=camera,
        shadows=scene.renderer.shadows,
    )


def _pose_robot(rng: Generator, scene: scenes.Scene, data: mujoco.MjData) -> None:
    """Joint angles at home or around it, and any opening of the fingers."""
    robot = scene.robot
    noise = rng.normal(0, 0.18, len(robot.home))
    home = robot.home + noise * (rng.random() < 0.7)
    for name, angle in zip(robot.joints, home, strict=True):
        data.joint(name).qpos[:] = angle
    fingers = zip(robot.fingers, robot.fingers_closed, robot.fingers_open, strict=True)
    for name, low, high in fingers:
        data.joint(name).qpos[:] = low + rng.random() * (high - low)


def _place_objects(rng: Generator, scene: scenes.Scene, data: mujoco.MjData, close: bool) -> str:
    """Put some objects on the table and the others out of sight; returns the first on the table."""
    n = len(scene.objects)
    order = rng.permutation(n)
    if close and rng.random() < 0.6:
        count = 1
    else:
        count = int(rng.integers(2, n + 1))
    shown = order[:count]
    (x_m, y_m), half_m = WORK[scene.robot.name]
    centre_m = (x_m + float(rng.uniform(-0.03, 0.03)), y_m)
    gap_m = float(rng.uniform(0.05, 0.12))
    spots = scatter(rng=rng, n=count, centre=centre_m, half=half_m, gap_m=gap_m)
    for i, name in enumerate(scene.objects):
        data.joint(f"{name}/free").qpos[:3] = (-3, 0.3 * i, BURIED_M)
    for (x, y), i in zip(spots, shown, strict=True):
        upright = rng.random() < 0.85
        axis = np.array([0.0, 0.0, 1.0]) if upright else rng.normal(size=3)
        quat = np.zeros(4)
        mujoco.mju_axisAngle2Quat(quat, axis / np.linalg.norm(axis), rng.uniform(-np.pi, np.pi))
        z = 0.0005 if axis[2] == 1 else rng.uniform(0.03, 0.16)
        data.joint(f"{scene.objects[i]}/free").qpos[:] = (x, y, z, *quat)
    return scene.objects[shown[0]]


def _draw_light(rng: Generator, model: mujoco.MjModel) -> None:
    """A new direction and new strengths of the lamp, and of the light from everywhere."""
    direction = np.array([rng.uniform(-1, 1), rng.uniform(-1, 1), -rng.uniform(0.8, 2)])
    model.light_dir[0] = direction / np.linalg.norm(direction)
    strength = rng.uniform(0.3, 0.75)
    model.light_diffuse[0] = strength * np.clip(rng.normal(1, 0.06, 3), 0.8, 1.2)
    model.vis.headlight.ambient[:] = rng.uniform(0.2, 0.5)


def _put_into_hand(rng: Generator, scene: scenes.Scene, data: mujoco.MjData, name: str) -> None:
    """Put an object between the fingers."""
    tcp = data.site("tcp").xpos + rng.normal(0, 0.006, 3)
    data.joint(f"{name}/free").qpos[:3] = tcp - (0, 0, rng.uniform(0.02, 0.06))
    _update_kinematics(scene.model, data)


def _update_kinematics(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Bring bodies, cameras and lamps where the joints say; what overlaps may overlap."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)


def _jitter_camera(rng: Generator, scene: scenes.Scene, data: mujoco.MjData) -> str:
    """One of the robot's own cameras, moved and turned a little in `data`."""
    camera = scene.cameras[int(rng.integers(len(scene.cameras)))]
    index = int(scene.model.camera(camera).id)
    data.cam_xpos[index] += rng.normal(0, 0.025, 3)
    turn = np.zeros(9)
    quat = np.zeros(4)
    mujoco.mju_euler2Quat(quat, rng.normal(0, 0.05, 3), "xyz")
    mujoco.mju_quat2Mat(turn, quat)
    turned = data.cam_xmat[index].reshape(3, 3) @ turn.reshape(3, 3)
    data.cam_xmat[index] = turned.ravel()
    return camera


def _draw_free_camera(
    rng: Generator, model: mujoco.MjModel, target: np.ndarray, close: bool
) -> mujoco.MjvCamera:
    """A camera anywhere above the table that looks about at `target`; sets the field of view."""
    camera = mujoco.MjvCamera()
    offset = rng.normal(0, 0.01 if close else 0.06, 2)
    camera.lookat[:] = target + np.array([*offset, rng.uniform(0.03, 0.05)])
    camera.azimuth = rng.uniform(-180, 180)
    camera.elevation = -rng.uniform(15, 65)
    model.vis.global_.fovy = rng.uniform(30, 60)
    pixels = rng.uniform(90, 150) if close else rng.uniform(25, 90)
    half_fovy = np.radians(model.vis.global_.fovy) / 2
    camera.distance = 0.09 * SIZE / (pixels * 2 * np.tan(half_fovy))
    return camera
