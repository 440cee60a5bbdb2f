"""A robot's MJCF file, checked: it holds every part that its `Robot` names."""

import os
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float64

from vap_core.base.errors import BadRobot, MissingMeshes, first_line, one_of
from vap_core.simulation.robots import Robot


def load(robot: Robot) -> mujoco.MjSpec:
    """The MJCF of a robot, with every part that the robot names.

    Raises: BadRobot, which names the file, what it lacks, and the mend.
    """
    where = f"robot {robot.name!r}: {robot.xml}"
    if not robot.xml.is_file():
        raise BadRobot(f"{where} is no file; give Robot.xml the path of its MJCF.")
    try:
        spec = mujoco.MjSpec.from_file(str(robot.xml))
    except ValueError as error:
        raise BadRobot(f"{where} is no MJCF ({first_line(error)}); correct the file.") from error
    joints = [joint.name for joint in spec.joints]
    needed = (
        ("body", robot.links, spec.bodies, "correct Robot.links or the file"),
        ("joint", robot.joints, spec.joints, "correct Robot.joints or the file"),
        ("joint", robot.fingers, spec.joints, "correct Robot.fingers or the file"),
        (
            "actuator",
            (*robot.joints, *robot.fingers),
            spec.actuators,
            "give every joint and finger a position actuator of its name",
        ),
        (
            "site",
            ("tcp",),
            spec.sites,
            "add it between the fingertips, z out of the gripper and y along its opening axis",
        ),
    )
    for kind, names, parts, mend in needed:
        there = [part.name for part in parts]
        for name in names:
            if name not in there:
                held = ", ".join(there) or "none"
                raise BadRobot(f"{where} lacks the {kind} {name!r} (it has {held}); {mend}.")
    found = tuple(name for name in joints if name not in robot.fingers)
    if found != robot.joints:
        raise BadRobot(
            f"{where} has the joints {', '.join(found)} besides the fingers, and Robot.joints has "
            f"{', '.join(robot.joints)}; name all of them there, in the order of the file."
        )
    return spec


def other_files(robot: Robot) -> dict[str, Path]:
    """The files that a robot's MJCF includes or loads, by their paths from its folder, in order.

    Raises: BadRobot, as `load`, and for a file that is not there.
    """
    spec = load(robot)
    xml = Path(os.path.abspath(robot.xml))
    fields = {}
    for field in spec.hfields:  # MuJoCo lists them without the folder that the compiler names
        fields[str(xml.parent / field.file)] = Path(spec.meshdir, field.file)
    files = {}
    for path in mujoco.mju_getXMLDependencies(str(xml)):
        file = Path(os.path.normpath(xml.parent / fields.get(path, path)))
        if not file.is_file():
            raise BadRobot(
                f"robot {robot.name!r}: {robot.xml} loads {file}, which is no file; put it there, "
                "or correct the MJCF."
            )
        if file != xml:
            files[os.path.relpath(file, xml.parent)] = file
    return dict(sorted(files.items()))


MODELS = {
    "wx250s": "trossen_wx250s",
    "panda": "franka_emika_panda",
    "google": "google_robot",
    "so101": "robotstudio_so101",
}
"""The names of our robots in Menagerie; bodies have the same names there, with a prefix at most."""
SHELL = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
SHOWN = 2
"""A geom group that is drawn."""
UNSEEN = 3
"""A geom group that is not drawn."""
Frame = Float64[np.ndarray, "4 4"]
"""A pose relative to the robot's first link at the zero configuration."""


def replace_visuals(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Show Menagerie's visual meshes in place of our own geoms, which still collide unseen.

    Raises: MissingMeshes when they are not on this machine, and cannot be downloaded.
    """
    source = mujoco.MjSpec.from_file(str(_model(robot.name)))
    frames = {}
    for body, frame in _frames(spec.body(robot.links[0])):
        frames[_short(body)] = frame
        for geom in body.geoms:
            geom.group = UNSEEN
    _copy_materials(spec, source)
    root = next(body for body in source.bodies if _short(body) == robot.links[0])
    copied: set[str] = set()
    for body, frame in _frames(root):
        name = _short(body)
        meshes = [geom for geom in body.geoms if geom.meshname and geom.group == SHOWN]
        for i, geom in enumerate(meshes):
            copy = _copied_name(geom.meshname)
            if copy not in copied:
                mesh = source.mesh(geom.meshname)
                file = str(Path(source.modelfiledir) / source.meshdir / mesh.file)
                spec.add_mesh(name=copy, file=file, scale=mesh.scale, inertia=SHELL)
                copied.add(copy)
            pose = np.linalg.inv(frames[name]) @ frame @ _matrix(geom.pos, geom.quat)
            quat = np.zeros(4)
            mujoco.mju_mat2Quat(quat, pose[:3, :3].ravel())
            spec.body(name).add_geom(
                name=_copied_name(f"{name}/{i}"),
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=copy,
                material=_copied_name(geom.material),
                pos=pose[:3, 3],
                quat=quat,
                group=SHOWN,
                contype=0,
                conaffinity=0,
                density=0,
                mass=0,
            )


def _model(name: str) -> Path:
    """The MJCF file of Menagerie's model of a robot, downloaded if need be."""
    import mujoco_menagerie

    if name not in MODELS:
        raise one_of("menagerie: robot", name, MODELS)
    model = mujoco_menagerie.get(MODELS[name])
    try:
        return Path(model.xml(model.default_model, mujoco_menagerie.Cache()))
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        reason = " ".join(str(error).split())
        raise MissingMeshes(
            f"menagerie: no meshes of {name!r} ({reason}); go online once, so that the "
            f"mujoco-menagerie package can fetch {MODELS[name]}, or set MENAGERIE_ROOT to a folder "
            f"that holds {MODELS[name]}/, or keep the plain robots."
        ) from error


def _copy_materials(spec: mujoco.MjSpec, source: mujoco.MjSpec) -> None:
    """Copy materials and textures of `source` under other names."""
    folder = Path(source.modelfiledir) / source.texturedir
    for texture in source.textures:
        if texture.file:
            spec.add_texture(
                name=_copied_name(texture.name),
                type=texture.type,
                file=str(folder / texture.file),
            )
    for material in source.materials:
        copy = spec.add_material(
            name=_copied_name(material.name),
            rgba=material.rgba,
            specular=material.specular,
            shininess=material.shininess,
        )
        for role, texture in enumerate(material.textures):
            if texture:
                copy.textures[role] = _copied_name(texture)


def _copied_name(name: str) -> str:
    return f"menagerie/{name}"


def _short(body: mujoco.MjsBody) -> str:
    return body.name.rpartition("/")[2]


def _frames(
    body: mujoco.MjsBody, here: Frame | None = None
) -> Iterator[tuple[mujoco.MjsBody, Frame]]:
    """A body, taken as the origin, and all bodies below it, with their frames."""
    here = np.eye(4) if here is None else here
    yield body, here
    for child in body.bodies:
        yield from _frames(child, here @ _matrix(child.pos, child.quat))


def _matrix(pos: np.ndarray, quat: np.ndarray) -> Frame:
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.asarray(quat) / np.linalg.norm(quat))
    pose = np.eye(4)
    pose[:3, :3] = turn.reshape(3, 3)
    pose[:3, 3] = pos
    return pose
