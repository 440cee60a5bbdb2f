"""Another coat for a robot: the meshes of MuJoCo Menagerie, hung on our bodies. What can be touched, moved or measured stays ours.

The package mujoco-menagerie downloads a model on first use, or takes it from the folder that MENAGERIE_ROOT names.
"""

from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float64

from vap_core.base.errors import MissingMeshes, one_of
from vap_core.simulation.robots import Robot

MODELS = {
    "wx250s": "trossen_wx250s",
    "panda": "franka_emika_panda",
    "google": "google_robot",
    "so101": "robotstudio_so101",
}
"""Our robots by their names in Menagerie; bodies have the same names there, behind a prefix at most."""
SHELL = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
SHOWN, UNSEEN = 2, 3
"""Geom groups: the first is drawn, the second is not."""
Frame = Float64[np.ndarray, "4 4"]
"""A pose relative to the robot's first link at the zero configuration."""


def dress(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Show Menagerie's visual meshes in place of our own geoms, which go on colliding unseen.

    Raises:
        MissingMeshes: they are not on this machine, and cannot be downloaded.
    """
    theirs = mujoco.MjSpec.from_file(str(_model(robot.name)))
    assets = Path(theirs.modelfiledir) / theirs.meshdir
    ours = {_short(body): frame for body, frame in _frames(spec.body(robot.links[0]))}
    root = next(body for body in theirs.bodies if _short(body) == robot.links[0])
    for body in (spec.body(name) for name in ours):
        for geom in body.geoms:
            geom.group = UNSEEN
    _paint(spec, theirs)
    hung: set[str] = set()
    for body, frame in _frames(root):
        name = _short(body)
        for i, geom in enumerate(
            geom for geom in body.geoms if geom.meshname and geom.group == SHOWN
        ):
            if geom.meshname not in hung:
                mesh = theirs.mesh(geom.meshname)
                spec.add_mesh(
                    name=_ours(mesh.name),
                    file=str(assets / mesh.file),
                    scale=mesh.scale,
                    inertia=SHELL,
                )
                hung.add(geom.meshname)
            pose = np.linalg.inv(ours[name]) @ frame @ _matrix(geom.pos, geom.quat)
            quat = np.zeros(4)
            mujoco.mju_mat2Quat(quat, pose[:3, :3].ravel())
            spec.body(name).add_geom(
                name=_ours(f"{name}/{i}"), type=mujoco.mjtGeom.mjGEOM_MESH, meshname=_ours(geom.meshname), material=_ours(geom.material),
                pos=pose[:3, 3], quat=quat, group=SHOWN, contype=0, conaffinity=0, density=0, mass=0,
            )  # fmt: skip


def _model(name: str) -> Path:
    """The MJCF file of Menagerie's model of a robot, downloaded if need be."""
    import mujoco_menagerie

    if name not in MODELS:
        raise one_of("menagerie: robot", name, MODELS)
    model = mujoco_menagerie.get(MODELS[name])
    try:
        return Path(model.xml(model.default_model, mujoco_menagerie.Cache()))
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        raise MissingMeshes(
            f"menagerie: no meshes of {name!r} ({' '.join(str(error).split())}); go online once, so that the mujoco-menagerie package can fetch "
            f"{MODELS[name]}, or set MENAGERIE_ROOT to a folder that holds {MODELS[name]}/, or keep the plain robots."
        ) from error


def _paint(spec: mujoco.MjSpec, theirs: mujoco.MjSpec) -> None:
    """Their materials and pictures, under names of their own."""
    folder = Path(theirs.modelfiledir) / theirs.texturedir
    for texture in theirs.textures:
        if texture.file:
            spec.add_texture(
                name=_ours(texture.name), type=texture.type, file=str(folder / texture.file)
            )
    for material in theirs.materials:
        copy = spec.add_material(
            name=_ours(material.name),
            rgba=material.rgba,
            specular=material.specular,
            shininess=material.shininess,
        )
        for role, texture in enumerate(material.textures):
            if texture:
                copy.textures[role] = _ours(texture)


def _ours(name: str) -> str:
    return f"menagerie/{name}"


def _short(body: mujoco.MjsBody) -> str:
    return body.name.rpartition("/")[2]


def _frames(
    body: mujoco.MjsBody, here: Frame | None = None
) -> Iterator[tuple[mujoco.MjsBody, Frame]]:
    """A body, taken as the origin, and all that hangs on it, with their frames."""
    here = np.eye(4) if here is None else here
    yield body, here
    for child in body.bodies:
        yield from _frames(child, here @ _matrix(child.pos, child.quat))


def _matrix(pos: np.ndarray, quat: np.ndarray) -> Frame:
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.asarray(quat) / np.linalg.norm(quat))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.reshape(3, 3), pos
    return pose
