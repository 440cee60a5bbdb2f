"""An episode drawn by hand, for tests of recordings: three objects on a table, an arm of four bones, up to three cameras."""

import math
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from rerun.chunk import RrdReader

from vap_core.base.types import Ballot, Boxes, Camera, Event, Grounding, Mask, Rgb, Track
from vap_core.recording import Recorder
from vap_core.recording.stream import rerun_command
from vap_core.rollout.types import EpisodeHeader, Frame
from vap_core.simulation.types import ROBOT, EpisodeRow, Outcome, Placement, Truth
from vap_core.study.diagnosis import explain

SIDE, K = 224, 5
SIZES = {"owl_a": (0.07, 0.07, 0.11), "owl_b": (0.07, 0.07, 0.10), "owl_c": (0.06, 0.08, 0.11)}
PAINT = {"owl_a": (150, 95, 60), "owl_b": (165, 110, 70), "owl_c": (135, 90, 75)}
PLACES = tuple(
    Placement(model, 0.32, y, 0.0) for model, y in zip(SIZES, (0.0, 0.14, -0.15), strict=True)
)
ROW = EpisodeRow("tabletop", "pick-owl", 3, 7, "bring my owl", "owl", PLACES, 60)
TINT = np.array([230, 40, 40])


def look_at(
    name: str, eye: tuple[float, float, float], at: tuple[float, float, float] = (0.32, 0.0, 0.05)
) -> Camera:
    z = np.subtract(at, eye) / np.linalg.norm(np.subtract(at, eye))
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye
    return Camera(name, SIDE, SIDE, np.array([[210.0, 0, 112], [0, 210.0, 112], [0, 0, 1]]), pose)


def rig(step: int, n: int) -> tuple[Camera, ...]:
    """Front, side, and a wrist camera that travels."""
    s = step / 60
    return (
        look_at("front", (0.95, 0.0, 0.45)),
        look_at("side", (0.35, 0.75, 0.4)),
        look_at("wrist", (0.02 + 0.1 * s, 0.02, 0.42 - 0.1 * s)),
    )[:n]


def poses(step: int) -> dict[str, np.ndarray]:
    lift = max(0.0, (step - 35) / 25 * 0.15)
    return {
        p.model: np.array([p.x, p.y, lift if i == 0 else 0.0, 1, 0, 0, 0], np.float64)
        for i, p in enumerate(ROW.placements)
    }


def links(step: int) -> dict[str, np.ndarray]:
    """A planar arm of four bones and two fingers."""
    t = min(step / 35, 1.0)
    turns, bones = (
        np.array([0.1, 0.35 + 0.25 * t, 0.9 + 0.2 * t, 0.75 - 0.1 * t]),
        np.array([0.06, 0.2, 0.2, 0.1]),
    )
    found, at, angle = {}, np.zeros(3), 0.0
    for i, (turn, bone) in enumerate(zip(turns, bones, strict=True)):
        angle += turn
        found[f"link{i}"] = np.array([*at, math.cos(angle / 2), 0, math.sin(angle / 2), 0])
        at = at + bone * np.array([math.sin(angle), 0, math.cos(angle)])
    for side in (-1, 1):
        found[f"finger{side}"] = np.array(
            [at[0], at[1] + 0.03 * side, at[2], math.cos(angle / 2), 0, math.sin(angle / 2), 0]
        )
    return found


def draw(camera: Camera, step: int) -> tuple[Rgb, dict[str, Mask]]:
    """A table with a smooth light and a little grain, and every object as a shaded, patterned silhouette."""
    grain = np.random.default_rng([7, step]).normal(0, 1.5, (SIDE, SIDE, 1))
    v, u = np.mgrid[:SIDE, :SIDE]
    base = np.stack(
        [
            165 + 40 * np.sin(u / 90 + v / 160),
            140 + 30 * np.cos(u / 120),
            110 + 25 * np.sin(v / 70),
        ],
        axis=-1,
    )
    wood = 8 * np.sin(v / 3.0 + 3 * np.sin(u / 40.0))[..., None]
    image, masks = base + wood + grain, {}
    world_to_cam = np.linalg.inv(camera.pose_world)
    for name, pose in poses(step).items():
        sx, sy, sz = np.array(SIZES[name]) / 2
        corners = (
            np.array([[x, y, z] for x in (-sx, sx) for y in (-sy, sy) for z in (0, 2 * sz)])
            + pose[:3]
        )
        pixels = (corners @ world_to_cam[:3, :3].T + world_to_cam[:3, 3]) @ camera.k.T
        hull = cv2.convexHull((pixels[:, :2] / pixels[:, 2:]).astype(np.int32))
        mask = cv2.fillConvexPoly(np.zeros((SIDE, SIDE), np.uint8), hull, 1).astype(bool)
        pattern = (
            np.array(PAINT[name])
            + 25 * np.sin((u + v) / (3 + len(masks)))[..., None]
            + (v - v[mask].mean())[..., None] * -0.5
        )
        image = np.where(mask[..., None], pattern + grain, image)
        masks[name] = mask
    return np.clip(image, 0, 255).astype(np.uint8), masks


def ground(camera: Camera, none: bool = False) -> Grounding:
    _, masks = draw(camera, 0)
    if none:
        return Grounding(
            camera.name,
            "owl_a",
            Boxes.empty("owl"),
            np.zeros((0, K), np.float32),
            Ballot(np.zeros(0, np.int64), np.zeros(0, bool), None, 0.0, 0.0),
            None,
            np.zeros((0, SIDE, SIDE), bool),
        )
    boxes = [
        [*np.argwhere(m).min(0)[::-1], *(np.argwhere(m).max(0)[::-1] + 1)] for m in masks.values()
    ]
    cos = np.array(
        [[0.83, 0.81, 0.62, 0.9, 0.85], [0.7, 0.72, 0.66, 0.71, 0.6], [0.5, 0.61, 0.6, 0.55, 0.52]],
        np.float32,
    )
    votes = np.bincount(cos.argmax(0), minlength=3)
    scores = np.array([0.71, 0.83, 0.64], np.float32)
    means = cos.mean(1)
    boxes_found, best = Boxes(np.array(boxes, np.float32), scores, "owl"), votes == votes.max()
    return Grounding(
        camera.name,
        "owl_a",
        boxes_found,
        cos,
        Ballot(votes, best, 0, 0.6, float(means[0] - means[1])),
        0,
        np.stack(list(masks.values())),
    )


def opening(cameras: int = 3, none: str = "") -> EpisodeHeader:
    rig0 = rig(0, cameras)
    groundings = {c.name: (ground(c, c.name == none),) for c in rig0}
    return EpisodeHeader(
        ROW, "vap", "mini-pi0", 10.0, rig0, ROW.instruction, "bring the red owl", groundings, SIZES
    )


def frame(step: int, start: EpisodeHeader, lost: range = range(0)) -> Frame:
    cameras = rig(step, len(start.cameras))
    images, prompted, tracks, truths = {}, {}, {}, {}
    for camera in cameras:
        image, masks = draw(camera, step)
        seen = (
            masks["owl_a"]
            if start.groundings[camera.name][0].winner is not None and step not in lost
            else None
        )
        track = None if seen is None else np.roll(seen, 2, axis=1)
        images[camera.name] = image
        shown = image
        if track is not None:
            shown = image.copy()
            shown[track] = (0.5 * image[track] + 0.5 * TINT).astype(np.uint8)
        prompted[camera.name], truths[camera.name] = shown, masks
        tracks[camera.name] = (
            Track(
                track,
                0.0
                if track is None
                else 0.9 - 0.12 * len(tracks) + 0.05 * math.sin(step / 5 + len(tracks)),
            ),
        )
    touched = ("owl_a",) if step > 30 else ("owl_b",) if 20 < step < 24 else ()
    contacts = {"owl_a": frozenset({ROBOT})} if step > 35 else {}
    events = (
        (Event(0, "INFO", "grounded in every view"),)
        if step == 0
        else (Event(step, "WARN", "front: track lost"),)
        if step in lost[:1]
        else ()
    )
    state = np.array(
        [0.3, 0, 0.3, 0, 0, 0, step < 33, *np.sin(np.arange(6) + step / 20)], np.float32
    )
    action = np.array([*0.02 * np.sin(np.arange(6) + step / 9), step < 33], np.float32)
    return Frame(
        step,
        step / 10,
        images,
        prompted,
        tracks,
        cameras,
        state,
        action,
        Truth(poses(step), links(step), touched, {}, contacts, truths),
        events,
    )


SUCCESS = Outcome("success", True, True, 20, True, False, True, 60)


def record(
    path: Path, start: EpisodeHeader, steps: int = 12, lost: range = range(0)
) -> list[Frame]:
    frames = [frame(step, start, lost) for step in range(steps)]
    with Recorder(path, start, flush_every=5, explain=explain) as recorder:
        for one in frames:
            recorder.frame(one)
        recorder.close(replace(SUCCESS, steps=steps))
    return frames


def columns(path: Path, entity: str, name: str) -> dict[int | None, object]:
    """Every value of one component by frame_index; None is static."""
    found: dict[int | None, object] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and name in batch.schema.names:
            timed = "frame_index" in batch.schema.names
            steps = batch["frame_index"].to_pylist() if timed else [None] * batch.num_rows
            found |= dict(zip(steps, batch[name].to_pylist(), strict=True))
    return found


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(path).stream()}


def rerun(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        rerun_command(*map(str, words)), capture_output=True, text=True, check=False
    )
