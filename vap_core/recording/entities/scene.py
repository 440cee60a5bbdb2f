"""Ground truth in three dimensions: table, robot, objects and cameras.

Shapes are drawn once; columns of poses move them.
"""

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from vap_core.base.errors import UnknownName
from vap_core.recording.colours import camera_colour, image_root, object_colours
from vap_core.recording.stream import log_row
from vap_core.rollout.types import EpisodeHeader, Frame
from vap_core.simulation import robots
from vap_core.simulation.assets.objects import get_object, mesh_of, texture_image
from vap_core.simulation.suites import suite
from vap_core.simulation.types import EpisodeRow, Pose, Truth

TEXTURE_PX = 96
"""Side of an object's picture in a recording; the simulator's is five times as large."""


@lru_cache(maxsize=256)
def object_mesh(name: str) -> rr.Mesh3D | None:
    """An object's shape and decoration; None for one that the registry does not hold, or that is
    another library's."""
    try:
        model = get_object(name)
    except UnknownName:
        return None
    if model.split == "foreign":
        return None
    mesh = mesh_of(model)
    picture = texture_image(model)
    side = (TEXTURE_PX, TEXTURE_PX)
    small = cv2.resize(picture, side, interpolation=cv2.INTER_AREA)
    return rr.Mesh3D(
        vertex_positions=mesh.vertex.astype(np.float32),
        triangle_indices=mesh.face.astype(np.uint32),
        vertex_normals=mesh.normal.astype(np.float32),
        vertex_texcoords=mesh.uv.astype(np.float32),
        albedo_texture=small.astype(np.uint8),
    )


ROBOT = (170, 178, 196)
TABLE = (92, 78, 64)
JOINT_HALF_SIZE_M = 0.016
MIN_BONE_M = 5e-3
"""Shorter bones are not drawn."""
FRUSTUM_M = 0.05
"""Distance from a camera to its picture in the scene."""
FINGERTIPS = ("finger", "jaw", "tip", "grip")
"""Links whose names contain one of these share the last link before them as their parent."""


def link_entity(name: str) -> str:
    """The entity of a robot link."""
    if name.startswith("link"):
        return f"/world/robot/{name}"
    return f"/world/robot/link_{name}"


def log_table(rec: rr.RecordingStream, row: EpisodeRow) -> None:
    """The table's top is z = 0."""
    box = rr.Boxes3D(
        centers=[[*mean_placement(row), -0.01]],
        half_sizes=[[0.45, 0.55, 0.01]],
        colors=[TABLE],
        fill_mode="solid",
    )
    log_row(rec, "/world/table", box)


def mean_placement(row: EpisodeRow) -> np.ndarray:
    """The middle of the objects' starting places, x and y in metres."""
    return np.array([[p.x, p.y] for p in row.placements]).mean(axis=0)


def log_objects(rec: rr.RecordingStream, header: EpisodeHeader) -> None:
    """Every object's own mesh and its bounding box; `log_roles` colours the boxes.

    An object's origin is the centre of its base. Without a mesh in the registry its box is solid.
    """
    for name, size in header.object_sizes_m.items():
        fill_mode = rr.components.FillMode.MajorWireframe
        mesh = object_mesh(name)
        if mesh is None:
            fill_mode = rr.components.FillMode.Solid
        else:
            log_row(rec, f"/world/objects/{name}/mesh", mesh)
        half = np.asarray(size) / 2
        box = rr.Boxes3D(
            centers=[[0, 0, half[2]]],
            half_sizes=[half],
            radii=rr.components.Radius.ui_points([1.5]),
            fill_mode=fill_mode,
        )
        log_row(rec, f"/world/objects/{name}", box)


def log_roles(
    rec: rr.RecordingStream, header: EpisodeHeader, at: Sequence[rr.TimeColumn] = ()
) -> None:
    """The colour and the label of every object by its part in the task, from a moment on."""
    row = header.row
    colours = object_colours(list(header.object_sizes_m), row.target, row.goal)
    labels = {row.target: f"target: {row.target}", row.goal: f"goal: {row.goal}"}
    for name, colour in colours.items():
        box = rr.Boxes3D.from_fields(
            colors=[colour],
            labels=[labels.get(name, name)],
            show_labels=object_mesh(name) is None and name in labels,
        )
        log_row(rec, f"/world/objects/{name}", box, at=at)


def log_links(rec: rr.RecordingStream, truth: Truth) -> None:
    """A joint at each link's origin and a capsule to the next link.

    Both are rigid in the link's frame, because joints only rotate there.
    """
    children = _children(list(truth.links_world))
    for name, pose in truth.links_world.items():
        entity = link_entity(name)
        joint = rr.Boxes3D(half_sizes=[[JOINT_HALF_SIZE_M] * 3], colors=[ROBOT], fill_mode="solid")
        log_row(rec, f"{entity}/joint", joint)
        bones = _bones(pose, [truth.links_world[child] for child in children[name]])
        if len(bones):
            log_row(rec, entity, _capsules(bones))


def send_poses(
    rec: rr.RecordingStream,
    entity: str,
    index: Sequence[rr.TimeColumn],
    xyz: np.ndarray,
    quaternion_xyzw: np.ndarray,
) -> None:
    """One pose per step."""
    columns = rr.Transform3D.columns(translation=xyz, quaternion=quaternion_xyzw)
    rec.send_columns(entity, index, columns)


def send_truth(
    rec: rr.RecordingStream, index: Sequence[rr.TimeColumn], frames: Sequence[Frame]
) -> None:
    """Poses of every object and link."""
    for name in frames[0].truth.objects_world:
        poses = np.stack([frame.truth.objects_world[name] for frame in frames])
        send_poses(rec, f"/world/objects/{name}", index, poses[:, :3], poses[:, [4, 5, 6, 3]])
    for name in frames[0].truth.links_world:
        poses = np.stack([frame.truth.links_world[name] for frame in frames])
        send_poses(rec, link_entity(name), index, poses[:, :3], poses[:, [4, 5, 6, 3]])


def log_cameras(rec: rr.RecordingStream, frame: Frame) -> None:
    """Intrinsics and the style of names, once; `send_camera_poses` sends the rest."""
    for i, camera in enumerate(frame.cameras):
        pinhole = rr.Pinhole(
            image_from_camera=camera.k,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=FRUSTUM_M,
            color=camera_colour(i),
        )
        log_row(rec, image_root(camera.name), pinhole)
        names = rr.Points2D.from_fields(radii=0, show_labels=True)
        log_row(rec, f"{image_root(camera.name)}/identity/labels", names)


def send_camera_poses(
    rec: rr.RecordingStream, index: Sequence[rr.TimeColumn], frames: Sequence[Frame]
) -> None:
    """Where every camera was."""
    for i, camera in enumerate(frames[0].cameras):
        poses = np.stack([frame.cameras[i].pose_world for frame in frames])
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        send_poses(rec, image_root(camera.name), index, poses[:, :3, 3], quaternions)


def _children(names: Sequence[str]) -> dict[str, list[str]]:
    """A link's parent is the last link before it that is no fingertip."""
    children: dict[str, list[str]] = {}
    parent: str | None = None
    for name in names:
        children[name] = []
        if parent is not None:
            children[parent].append(name)
        if not _is_fingertip(name):
            parent = name
    return children


def _is_fingertip(link: str) -> bool:
    return any(part in link.lower() for part in FINGERTIPS)


def _bones(parent: Pose, children: Sequence[Pose]) -> np.ndarray:
    """Vectors from a link's origin to its children's, in the link's frame."""
    rotation = Rotation.from_quat(parent[3:7], scalar_first=True).inv()
    bones = np.empty((len(children), 3))
    for i, child in enumerate(children):
        bones[i] = rotation.apply(child[:3] - parent[:3])
    return bones[np.linalg.norm(bones, axis=1) > MIN_BONE_M]


def _capsules(bones: np.ndarray) -> rr.Capsules3D:
    """One capsule along each bone; a capsule points along z."""
    lengths = np.linalg.norm(bones, axis=1)
    rotations = []
    for bone in bones:
        rotation, _ = Rotation.align_vectors([bone], [[0.0, 0.0, 1.0]])
        rotations.append(rotation.as_quat())
    return rr.Capsules3D(
        lengths=lengths,
        radii=np.clip(lengths / 6, 0.008, 0.035),
        quaternions=rotations,
        colors=[ROBOT] * len(bones),
        fill_mode="solid",
    )


def nearest_other_m(header: EpisodeHeader, frames: Sequence[Frame]) -> np.ndarray | None:
    """From the tcp to the nearest bounding box of an object that is neither target nor goal.

    Metres, one number per frame; None where there is no such object.
    """
    row = header.row
    names = []
    for name in frames[0].truth.objects_world:
        if name not in (row.target, row.goal):
            names.append(name)
    if not names:
        return None
    tcp = tcp_world(header, frames)
    gaps = [
        box_gaps_m(tcp, poses_world(frames, name), header.object_sizes_m[name]) for name in names
    ]
    return np.min(gaps, axis=0)


def tcp_world(header: EpisodeHeader, frames: Sequence[Frame]) -> np.ndarray:
    """The tcp in the world frame, metres, a row per frame."""
    base = robots.get(suite(header.row.suite).robot).base_world
    tcp = np.array([frame.state[:3] for frame in frames], np.float64)
    return Rotation.from_quat(base[[4, 5, 6, 3]]).apply(tcp) + base[:3]


def poses_world(frames: Sequence[Frame], name: str) -> np.ndarray:
    """An object's poses, a row per frame."""
    return np.stack([frame.truth.objects_world[name] for frame in frames])


def box_gaps_m(
    points: np.ndarray, poses: np.ndarray, size: tuple[float, float, float]
) -> np.ndarray:
    """From every point to an object's bounding box at that step, metres; 0 inside.

    The object's origin is the centre of its base.
    """
    turns = Rotation.from_quat(poses[:, [4, 5, 6, 3]])
    local = turns.inv().apply(points - poses[:, :3]) - [0.0, 0.0, size[2] / 2]
    outside = np.maximum(np.abs(local) - np.asarray(size) / 2, 0.0)
    return np.asarray(np.linalg.norm(outside, axis=1))
