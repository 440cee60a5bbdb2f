"""The simulator's truth in three dimensions: table, robot, objects and cameras, drawn once and moved by columns of poses."""

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from vap_core.record.blueprint import QUIET, TARGET, TRUTH
from vap_core.record.file import put
from vap_core.values import EpisodeRow, Frame, Opening, Pose, Truth

ROBOT = (170, 178, 196)
TABLE = (92, 78, 64)
FRUSTUM_M = 0.14
"""Distance from a camera to its picture in the scene."""
TIPS = ("finger", "jaw", "tip", "grip")
"""Links whose names hold one of these hang on the last link that does not, side by side."""


def link_entity(name: str) -> str:
    return f"/world/robot/{name if name.startswith('link') else f'link_{name}'}"


def log_table(rec: rr.RecordingStream, row: EpisodeRow) -> None:
    """The table's top is z = 0."""
    xy = np.array([[p.x, p.y] for p in row.placements]).mean(axis=0)
    box = rr.Boxes3D(centers=[[*xy, -0.01]], half_sizes=[[0.45, 0.55, 0.01]], colors=[TABLE], fill_mode="solid")
    put(rec, "/world/table", box)


def log_objects(rec: rr.RecordingStream, opening: Opening) -> None:
    """Bounding boxes: an object's origin is the centre of its base, so the box's centre is half its height above."""
    for name, size in opening.target_sizes_m.items():
        target, goal = name == opening.row.target, name == opening.row.goal
        half = np.asarray(size) / 2
        box = rr.Boxes3D(
            centers=[[0, 0, half[2]]],
            half_sizes=[half],
            colors=[TARGET if target else TRUTH if goal else QUIET],
            fill_mode="solid" if target else "transparentfillmajorwireframe",
            labels=[f"target: {name}" if target else f"goal: {name}" if goal else name],
            show_labels=target or goal,
        )
        put(rec, f"/world/objects/{name}", box)


def parents(names: Sequence[str]) -> dict[str, str]:
    """Which link each link hangs on: the one before it, except finger tips, which share the last link that is none."""
    found: dict[str, str] = {}
    last: str | None = None
    for name in names:
        if last is not None:
            found[name] = last
        if not any(tip in name.lower() for tip in TIPS):
            last = name
    return found


def log_links(rec: rr.RecordingStream, truth: Truth) -> None:
    """A joint at each link's origin and a capsule to the next: rigid in the link's frame, because joints only turn there."""
    children: dict[str, list[str]] = {}
    for child, parent in parents(list(truth.links_world)).items():
        children.setdefault(parent, []).append(child)
    for name, pose in truth.links_world.items():
        turn = Rotation.from_quat(pose[3:7], scalar_first=True).inv()
        bones = np.array([turn.apply(truth.links_world[child][:3] - pose[:3]) for child in children.get(name, ())]).reshape(-1, 3)
        lengths = np.linalg.norm(bones, axis=1)
        bones, lengths = bones[lengths > 5e-3], lengths[lengths > 5e-3]
        entity = link_entity(name)
        put(rec, f"{entity}/joint", rr.Boxes3D(half_sizes=[[0.016] * 3], colors=[ROBOT], fill_mode="solid"))
        if len(bones):
            turns = [Rotation.align_vectors([bone], [[0.0, 0.0, 1.0]])[0].as_quat() for bone in bones]
            radii = np.clip(lengths / 6, 0.008, 0.035)
            shape = rr.Capsules3D(lengths=lengths, radii=radii, quaternions=turns, colors=[ROBOT] * len(bones), fill_mode="solid")
            put(rec, entity, shape)


def send_poses(rec: rr.RecordingStream, entity: str, index: Sequence[rr.TimeColumn], xyz: np.ndarray, quaternion_xyzw: np.ndarray) -> None:
    rec.send_columns(entity, index, rr.Transform3D.columns(translation=xyz, quaternion=quaternion_xyzw))


def send_truth(rec: rr.RecordingStream, index: Sequence[rr.TimeColumn], truths: Sequence[Truth]) -> None:
    """Poses of every object and link, one row a step."""
    moving: list[tuple[str, list[Mapping[str, Pose]]]] = [
        *((f"/world/objects/{name}", [t.objects_world for t in truths]) for name in truths[0].objects_world),
        *((link_entity(name), [t.links_world for t in truths]) for name in truths[0].links_world),
    ]
    names = [*truths[0].objects_world, *truths[0].links_world]
    for name, (entity, poses) in zip(names, moving, strict=True):
        rows = np.stack([at[name] for at in poses])
        send_poses(rec, entity, index, rows[:, :3], rows[:, [4, 5, 6, 3]])


def log_cameras(rec: rr.RecordingStream, frame: Frame, colours: Sequence[tuple[int, int, int]]) -> None:
    """Intrinsics, once; poses travel with the pictures."""
    for i, camera in enumerate(frame.cameras):
        pinhole = rr.Pinhole(
            image_from_camera=camera.k,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=FRUSTUM_M,
            color=colours[i % len(colours)],
        )
        put(rec, f"/observation.images.{camera.name}", pinhole)
