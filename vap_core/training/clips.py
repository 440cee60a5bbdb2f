"""Short videos with ground truth to test tracking on: one object is carried past its look-alikes and hidden for some frames."""

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from vap_core.sim import objects, robots, scenes
from vap_core.sim.objects import ObjectModel
from vap_core.training.scenes import HELD_OUT, SIZE, draw, look, only_generic, scatter
from vap_core.values import value

import mujoco  # isort: skip  (scenes has chosen a GL back end)


@value
class Clip:
    """`masks[t, i]` are the visible pixels of object i at frame t; object 0 is the one that moves and, in `hidden` frames, is covered."""

    rgb: UInt8[np.ndarray, "t h w 3"]
    masks: Bool[np.ndarray, "t n h w"]
    hidden: Bool[np.ndarray, " t"]
    category: str


def clip(seed: int, number: int, *, frames: int = 34, hide: int = 4, jump_m: float = 0.0, size: int = SIZE, alike: int = 2) -> Clip:
    """Object 0 rests, rises, drifts sideways; from a third of the clip on it is covered for `hide` frames, and moves `jump_m` meanwhile."""
    rng = np.random.default_rng([seed, 9, number])
    category = str(rng.choice(objects.CATEGORIES))
    numbers = HELD_OUT + rng.choice(1000, alike + 1, replace=False)
    models: list[ObjectModel] = [objects.generic(category, int(i)) for i in numbers]
    only_generic(models)
    robot = sorted(robots.ROBOTS)[int(rng.integers(len(robots.ROBOTS)))]
    with scenes.build(robot, models, look=look(rng)) as scene, mujoco.Renderer(scene.model, size, size) as renderer:
        data = mujoco.MjData(scene.model)
        home = scene.robot.home + rng.normal(0, 0.1, len(scene.robot.home))
        aim = (0.27 if robot == "wx250s" else 0.48, 0.0)
        spots = scatter(rng, len(models), aim, (0.10, 0.15), 0.09)
        yaws = rng.uniform(-np.pi, np.pi, len(models))
        way = rng.normal(size=2)
        way *= 0.10 / np.linalg.norm(way)
        begin = frames // 3
        hidden = np.zeros(frames, bool)
        hidden[begin : begin + hide] = True
        camera = scene.cameras[0]
        rgb, masks = [], []
        for t in range(frames):
            mujoco.mj_resetData(scene.model, data)
            for joint, angle in zip(scene.robot.joints, home + 0.002 * t, strict=True):
                data.joint(joint).qpos[:] = angle
            for i, name in enumerate(scene.objects):
                xyz = np.array([*spots[i], 0.0005])
                if i == 0:
                    done = max(0.0, (t - 4) / (frames - 5))
                    xyz += (*(way * done), 0.05 * min(1.0, 4 * done))
                    xyz[1] += jump_m * (1 if spots[0, 1] < 0 else -1) * (t >= begin + hide)
                yaw = yaws[i] + (0.02 * t if i == 0 else 0)
                data.joint(f"{name}/free").qpos[:] = (*xyz, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))
            mujoco.mj_forward(scene.model, data)
            picture, ids = draw(scene, data, renderer, camera, False)
            if hidden[t]:
                ids, picture = _cover(ids, picture)
            rgb.append(picture)
            masks.append(ids[None] == np.arange(1, len(models) + 1)[:, None, None])
    return Clip(np.stack(rgb), np.stack(masks), hidden, category)


def _cover(ids: np.ndarray, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lay a grey bar, like a forearm, over object 0."""
    rows, cols = np.nonzero(ids == 1)
    if not len(rows):
        return ids, picture
    middle, low = int(cols.mean()), int(rows.max()) + 4
    thick = max(int(np.ptp(cols)) + 14, 12)
    bar = np.zeros(ids.shape, np.uint8)
    cv2.line(bar, (middle, 0), (middle, low), 1, thick)
    shade = np.clip(120 + 60 * np.cos((np.arange(ids.shape[1]) - middle) / thick * np.pi), 0, 255)
    covered = np.where(bar[..., None] > 0, np.broadcast_to(shade[None, :, None], picture.shape), picture)
    return np.where(bar > 0, 0, ids), covered.astype(np.uint8)
