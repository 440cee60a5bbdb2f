"""A robot's MJCF file, checked: it holds every part that its `Robot` names."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import mujoco

from vap_core.base.errors import BadRobot, first_line
from vap_core.base.types import value
from vap_core.simulation.robots import Robot


@value
class Kind:
    """The parts of one kind that a robot `needs` of its file, those that `there` are, the mend."""

    name: str
    needs: tuple[str, ...]
    there: tuple[str, ...]
    mend: str


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
    for kind in _kinds(spec, robot):
        absent = [name for name in kind.needs if name not in kind.there]
        if absent:
            there = ", ".join(kind.there) or "none"
            raise BadRobot(
                f"{where} lacks the {kind.name} {absent[0]!r} (it has {there}); {kind.mend}."
            )
    _check_order(spec, robot, where)
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


def _kinds(spec: mujoco.MjSpec, robot: Robot) -> Iterator[Kind]:
    """What the file must hold, kind by kind."""
    joints = _names(spec.joints)
    yield Kind(
        name="body",
        needs=robot.links,
        there=_names(spec.bodies),
        mend="correct Robot.links or the file",
    )
    yield Kind(
        name="joint",
        needs=robot.joints,
        there=joints,
        mend="correct Robot.joints or the file",
    )
    yield Kind(
        name="joint",
        needs=robot.fingers,
        there=joints,
        mend="correct Robot.fingers or the file",
    )
    yield Kind(
        name="actuator",
        needs=(*robot.joints, *robot.fingers),
        there=_names(spec.actuators),
        mend="give every joint and finger a position actuator of its name",
    )
    yield Kind(
        name="site",
        needs=("tcp",),
        there=_names(spec.sites),
        mend="add it between the fingertips, z out of the gripper and y along its opening axis",
    )


def _check_order(spec: mujoco.MjSpec, robot: Robot, where: str) -> None:
    """The joints besides the fingers are those of the robot, in its order. Raises: BadRobot."""
    found = tuple(name for name in _names(spec.joints) if name not in robot.fingers)
    if found != robot.joints:
        raise BadRobot(
            f"{where} has the joints {', '.join(found)} besides the fingers, and Robot.joints has "
            f"{', '.join(robot.joints)}; name all of them there, in the order of the file."
        )


def _names(parts: Sequence[Any]) -> tuple[str, ...]:
    """The names of parts of a spec, in its order."""
    return tuple(part.name for part in parts)
