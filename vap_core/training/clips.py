"""Short videos with ground truth to test tracking on: one object is carried past its look-alikes and hidden for some frames."""

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from vap_core.sim import objects, robots, scenes
from vap_core.sim.objects import ObjectModel
from vap_core.track import Tracker
from vap_core.training.evaluation import Figures, share
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


def measure(tracker: Tracker, n: int = 30, seed: int = 0) -> Figures:
    """J (mask IoU) of the moving object before it is hidden and over the last 8 frames, identities kept, false pixels while hidden.

    Clip k is hidden for k mod 7 frames; every third one also jumps 12 cm meanwhile. `kept` is IoU > 0.5 in the last frame.
    """
    before, after, others, kept, false_px = [], [], [], [], []
    for number in range(n):
        film = clip(seed, number, hide=number % 7, jump_m=0.12 if number % 3 == 2 else 0.0)
        if not film.masks[0].any(axis=(1, 2)).all():
            continue
        states = tracker.start([film.rgb[0]], [film.masks[0]])
        rows = []
        for rgb, masks, hidden in zip(film.rgb[1:], film.masks[1:], film.hidden[1:], strict=True):
            states, (tracks,) = tracker.step(states, [rgb])
            found = np.stack([np.zeros_like(true) if t.mask is None else t.mask for t, true in zip(tracks, masks, strict=True)])
            union = (found | masks).sum(axis=(1, 2))
            rows.append(np.where(union > 0, (found & masks).sum(axis=(1, 2)) / np.maximum(union, 1), 1.0))
            if hidden:
                false_px.append(int(found[0].sum()))
        score = np.array(rows)
        before.append(score[: len(film.rgb) // 3 - 1, 0].mean())
        after.append(score[-8:, 0].mean())
        others.append(score[:, 1:].mean())
        kept.append(score[-1, 0] > 0.5)
    return {
        "j_before": round(float(np.mean(before)), 4),
        "j_last_8": round(float(np.mean(after)), 4),
        "j_others": round(float(np.mean(others)), 4),
        "identity_kept": share(int(np.sum(kept)), len(kept)),
        "false_px_while_hidden": round(float(np.mean(false_px)), 1),
    }


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
