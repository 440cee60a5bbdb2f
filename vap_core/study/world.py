"""The world of a study as one digest: cameras, styles, suites, robots and objects."""

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields, is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from vap_core.environments import gym
from vap_core.policies.scripted.scripted import MOTIONS, SHIPPED_MOTIONS
from vap_core.simulation import robots, suites
from vap_core.simulation.assets.objects import ObjectModel, get_object
from vap_core.simulation.cameras import RIGS, SHIPPED_RIGS, Rig
from vap_core.simulation.looks import SceneStyle, Sensor
from vap_core.simulation.robots import Robot, mjcf
from vap_core.simulation.suites import Suite, Task
from vap_core.simulation.suites.open_row import models_of
from vap_core.simulation.suites.suite import VARIANTS, Variant
from vap_core.simulation.types import EpisodeRow

SPELLINGS: dict[type, str] = {
    Rig: "Rig name body pos_m aim_m fovy_rad up",
    Variant: "Variant axis style distractors",
    SceneStyle: (
        "SceneStyle planks grain wall floor lamp_pos_m lamp ambient shadows robot camera_shift_m"
    ),
    Suite: "Suite name robot hz cameras tasks control sensor",
    Task: "Task name category instruction max_steps rule goal slug",
    Sensor: "Sensor jitter_m jitter_rad exposure balance noise",
    Robot: (
        "Robot name xml joints fingers home speed_rad_s fingers_open fingers_closed opening_m "
        "palm_m hz base_world links down_base fixed_jaw_m hand_m table_m floor_z_m turn_cost "
        "lean_rad"
    ),
    ObjectModel: "ObjectModel name category split shape texture mass_kg",
}
"""The kind of a value and the names of its parts, as digests of runs spell them: a class or a field
that is renamed keeps its name here."""


EDITION = "at rest objects sleep; one sample a pixel, four where objects are looked for"
"""How what a world consists of is simulated and drawn."""


def digest(listed: Sequence[tuple[str, Sequence[EpisodeRow]]], edition: str = "") -> str:
    """Over the cameras that ship and those of the robots used, styles, suites, robots, objects.

    `listed` has, task by task, its suite and its rows. A robot enters with every file that its MJCF
    includes or loads. What an own suite's file enters for its own robot changes no other suite's
    digest.
    """
    rigs = dict(SHIPPED_RIGS)
    for suite, _ in listed:
        robot_name = suites.suite(suite).robot
        rigs[robot_name] = RIGS[robot_name]
    found = hashlib.sha256(_canonical((rigs, VARIANTS)) + edition.encode())
    for suite, rows in listed:
        known = suites.suite(suite)
        robot = robots.get(known.robot)
        if known.environment == "gym":
            found.update(_canonical((known, gym.MAPS[suite].id, version("gymnasium"))))
            continue
        models = [get_object(name) for name in sorted(models_of(rows))]
        found.update(_canonical((known, robot, models)) + robot.xml.read_bytes())
        for name, file in mjcf.other_files(robot).items():
            found.update(_canonical((name, hashlib.sha256(file.read_bytes()).hexdigest())))
    return found.hexdigest()[:16]


def own_motions(of: Iterable[str]) -> dict[str, dict[str, float]]:
    """The scripted motions that do not ship, by robot, among those of the robots of some suites."""
    own = {}
    for suite in of:
        robot = suites.suite(suite).robot
        motion = MOTIONS.get(robot)
        if motion is not None and motion != SHIPPED_MOTIONS.get(robot):
            own[robot] = asdict(motion)
    return own


def _canonical(value: Any) -> bytes:
    """Every number in a value, whatever NumPy's print options are; of files their names."""
    return json.dumps(value, default=_spelled, sort_keys=True).encode()


def _spelled(part: Any) -> Any:
    """A value as the digest spells it."""
    if isinstance(part, tuple(SPELLINGS)):
        kind, *names = SPELLINGS[type(part)].split()
        return {"kind": kind, **{name: getattr(part, name) for name in names}}
    if is_dataclass(part) and not isinstance(part, type):  # a drawn shape or its texture
        names = [field.name for field in fields(part)]
        return {"kind": type(part).__name__, **{name: getattr(part, name) for name in names}}
    if isinstance(part, np.ndarray | np.generic):
        return part.tolist()
    if isinstance(part, Path):
        return part.name
    raise TypeError(
        f"Study: {type(part).__name__} cannot be hashed; give it a spelling, or add its kind here."
    )
