"""A robot of one's own: what its MJCF lacks, and a camera that cannot look, are one line; it changes no other run's digest."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.command import refused
from tests.test_own_suite import DOCUMENTED
from vap_core.base.errors import BadOutput, BadRobot, BadSuite, UnknownName
from vap_core.policies.scripted.scripted import MOTIONS, Motion
from vap_core.simulation import suites
from vap_core.simulation.cameras import RIGS, Rig
from vap_core.simulation.control import Arm
from vap_core.simulation.robots import ROBOTS, mjcf
from vap_core.simulation.scenes import build
from vap_core.simulation.suites import own
from vap_core.study.store import open_run
from vap_core.study.trials import DEMO, Study

MJCF = ROBOTS["wx250s"].xml.read_text()
ENTERS = """
from dataclasses import replace
from pathlib import Path

import numpy as np

from vap_core.simulation.cameras import RIGS, Rig
from vap_core.simulation.robots import ROBOTS

ROBOTS["mine"] = replace(ROBOTS["wx250s"], name="mine", xml=Path(__file__).parent / "mine.xml")
RIGS["mine"] = (Rig("front", "world", (0.76, 0.0, 0.35), (0.24, 0.0, 0.105), 0.77),)
"""
TASK = ("my-desk", "pick-bottle")
WORLDS = {
    "simpler-fractal": "23c1d6750375f6b9",
    "simpler-bridge": "511899a55b532902",
    "vlabench": "73233e636b3f80a7",
    "tabletop": "092408fdc5542de1",
    "shared-sequence-bridge": "f7f0a1e2c0c0272a",
    "widowx-pick": "4cffababdfe94b7f",
}
"""The digests of the worlds of runs that there are."""


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The documented suite on a robot of its own; all that it enters is forgotten after a test."""
    monkeypatch.setattr(own, "OPENED", {})
    suites._seeded.cache_clear()
    suites.benchmark.cache_clear()
    rigs, robots, motions = dict(RIGS), dict(ROBOTS), dict(MOTIONS)
    (tmp_path / "mine.xml").write_text(MJCF)
    path = tmp_path / "desk.py"
    path.write_text(ENTERS + DOCUMENTED.replace('"wx250s"', '"mine"'))
    yield path
    for registry, before in ((RIGS, rigs), (ROBOTS, robots), (MOTIONS, motions)):
        registry.clear()
        registry.update(before)


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def refusal_of(file: Path) -> str:
    with pytest.raises(BadSuite) as refusal:
        suites.open_file(file)
    said = str(refusal.value)
    assert said.startswith(f"suites: {file}")
    assert "\n" not in said
    return said


def test_the_robot_of_a_suite_is_a_robot_like_any_other(file: Path) -> None:
    assert suites.open_file(file).robot == "mine"
    with build("mine", ["cup-personal"]) as scene:
        assert scene.cameras == ("front",)
    assert np.isfinite(Arm(ROBOTS["mine"]).forward(ROBOTS["mine"].home)).all()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('<site name="tcp"', '<site name="tip"', "lacks the site 'tcp' (it has tip); add it"),
        (
            '<position class="wx" name="elbow" joint="elbow"/>',
            "",
            "lacks the actuator 'elbow' (it has waist, shoulder, forearm_roll, ",
        ),
        ('body name="wrist_link"', 'body name="wrist"', "lacks the body 'wrist_link' (it has"),
        (
            'name="elbow"',
            'name="knee"',
            "lacks the joint 'elbow' (it has waist, shoulder, knee, ",
        ),
        ("<worldbody>", "<worldbody", "is no MJCF (XML parse error"),
        (
            '<joint name="elbow" range="-2.14675 1.6057"/>',
            '<joint name="elbow" range="-2.14675 1.6057"/><joint name="spare" range="0 1"/>',
            "has the joints waist, shoulder, elbow, spare, ",
        ),
    ],
)
def test_what_an_mjcf_lacks_is_one_line(file: Path, old: str, new: str, words: str) -> None:
    mjcf = file.parent / "mine.xml"
    edit(mjcf, old, new)
    if old == 'name="elbow"':
        edit(mjcf, 'joint="elbow"', 'joint="knee"')
    said = refusal_of(file)
    assert f"robot 'mine': {mjcf} {words}" in said
    for make in (lambda: Arm(ROBOTS["mine"]), lambda: build("mine", [])):
        with pytest.raises(BadRobot) as refusal:
            make()
        assert words in str(refusal.value)


def test_fingers_that_the_mjcf_lacks_are_named(file: Path) -> None:
    edit(file, 'name="mine", xml', 'name="mine", fingers=("thumb", "right_finger"), xml')
    assert "lacks the joint 'thumb' (it has waist, " in refusal_of(file)
    with pytest.raises(BadRobot, match=r"'thumb' .*; correct Robot\.fingers or the file"):
        build("mine", [])


@pytest.mark.parametrize(
    ("field", "words"),
    [
        ("fingers_open=(0.037,)", "2 fingers, 1 open, 2 closed; one each, and at least one finger"),
        (
            "fingers_closed=(0.1, 0.1, 0.1)",
            "2 fingers, 2 open, 3 closed; one each, and at least one finger",
        ),
        (
            "fingers=(), fingers_open=(), fingers_closed=()",
            "0 fingers, 0 open, 0 closed; one each, and at least one finger",
        ),
        ("links=()", "links is empty; name the bodies from the base to the fingers"),
        ("hz=0.0", "hz is 0; give more than 0"),
        (
            "speed_rad_s=np.full(6, 180.0)",
            "speed_rad_s is [180.0, 180.0, 180.0, 180.0, 180.0, 180.0]; give radians a second, "
            "above 0 and at most 30",
        ),
        (
            "fingers_open=(0.037, -0.015)",
            "finger 'right_finger' is at -0.015 both open and closed",
        ),
    ],
)
def test_fingers_and_links_are_counted(file: Path, field: str, words: str) -> None:
    edit(file, 'name="mine", xml', f'name="mine", {field}, xml')
    assert f"Robot 'mine': {words}" in refusal_of(file)


def test_a_home_in_degrees_is_refused(file: Path) -> None:
    edit(file, 'name="mine", xml', 'name="mine", home=np.rad2deg(ROBOTS["wx250s"].home), xml')
    words = "home has -18.6108 for joint shoulder, outside its range -1.8"
    said = refusal_of(file)
    assert words in said
    assert said.endswith("; give radians.")


def test_a_file_that_is_not_there_is_named(file: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.xml").unlink()
    words = "mine.xml is no file; give Robot.xml the path of its MJCF."
    assert refusal_of(file).endswith(words)
    said = refused("eval", "--suite", file, "--policy", "expert", "--out", tmp_path / "run")
    assert said.endswith(words)
    with pytest.raises(BadRobot, match="is no file; give Robot.xml"):
        build("mine", [])


def test_a_robot_without_cameras_is_named(file: Path) -> None:
    edit(file, 'RIGS["mine"] =', "unused =")
    words = "robot 'mine' has no cameras; enter them in RIGS, which has those of google, panda"
    assert words in refusal_of(file)
    with pytest.raises(UnknownName, match=words):
        build("mine", [])


def test_a_camera_on_a_body_that_is_not_there_is_named(file: Path) -> None:
    edit(file, '"world", (0.76', '"hand", (0.76')
    said = refusal_of(file)
    assert "camera 'front' of mine is fixed to the body 'hand', which the robot's MJCF" in said


def test_a_camera_that_looks_along_its_up_is_refused_with_the_mend(file: Path) -> None:
    edit(file, "(0.24, 0.0, 0.105)", "(0.76, 0.0, 0.0)")
    said = refusal_of(file)
    assert said.endswith(": camera 'front' looks along its up; give up=(1, 0, 0).")


@pytest.mark.parametrize(
    ("aim_m", "up", "words"),
    [
        ((0.3, 0.0, 0.0), (0.0, 0.0, 1.0), r"looks along its up; give up=\(1, 0, 0\)"),
        ((0.3, 0.0, 0.9), (0.0, 0.0, -2.0), r"looks along its up; give up=\(1, 0, 0\)"),
        ((0.0, 0.0, 0.5), (1.0, 0.0, 0.0), r"looks along its up; give up=\(0, 0, 1\)"),
        ((0.0, 0.0, 0.5), (0.0, 0.0, 0.0), r"looks along its up; give up=\(0, 0, 1\)"),
        ((0.3, 0.0, 0.5), (0.0, 0.0, 1.0), r"stands where it aims, at .*; give another aim_m"),
    ],
)
def test_a_camera_without_an_upright_picture_is_refused(
    aim_m: tuple[float, float, float], up: tuple[float, float, float], words: str
) -> None:
    with pytest.raises(BadRobot, match=f"camera 'front' {words}"):
        Rig("front", "world", (0.3, 0.0, 0.5), aim_m, 0.7, up)


def test_the_mend_of_a_camera_that_looks_down_works() -> None:
    rig = Rig("front", "world", (0.3, 0.0, 0.5), (0.3, 0.0, 0.0), 0.7, (1.0, 0.0, 0.0))
    turn = rig.rotation()
    assert turn.T @ turn == pytest.approx(np.eye(3))
    assert turn[:, 2].tolist() == [0.0, 0.0, 1.0]


def test_worlds_are_those_of_the_runs_that_there_are_whatever_robots_are_entered(
    file: Path,
) -> None:
    suites.open_file(file)
    RIGS["panda"] = RIGS["panda"][:1]
    for name, digest in WORLDS.items():
        tasks = tuple((name, task.name) for task in suites.suite(name).tasks)
        if suites.suite(name).robot != "panda":
            study = Study(tasks, ("generic",), policy="random")
            assert study.configuration()["world"] == digest


def test_worlds_are_those_of_the_runs_that_there_are() -> None:
    for name, digest in WORLDS.items():
        tasks = tuple((name, task.name) for task in suites.suite(name).tasks)
        assert Study(tasks, ("generic",), policy="random").configuration()["world"] == digest
    assert DEMO.configuration()["world"] == "60fab9c07fd08b75"


def test_the_cameras_of_an_own_robot_are_in_its_runs_digest(file: Path) -> None:
    study = Study((TASK,), ("generic",), policy="random", suite_files=(str(file),))
    before = study.configuration()["world"]
    RIGS["other"] = RIGS["mine"]
    assert study.configuration()["world"] == before
    RIGS["mine"] = tuple(replace(rig, fovy_rad=0.9) for rig in RIGS["mine"])
    assert study.configuration()["world"] != before


LOADS = """<mujoco>
  <compiler meshdir="shapes" texturedir="shapes"/>
  <include file="part.xml"/>
  <asset>
    <mesh name="hull" file="hull.obj"/>
    <hfield name="hill" file="hill.png" size="1 1 1 1"/>
    <texture name="paint" type="2d" file="paint.png"/>
  </asset>
"""
HULL = "v 0 0 0\nv .01 0 0\nv 0 .01 0\nv 0 0 .01\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture
def loading(file: Path) -> Path:
    """The folder of a robot whose MJCF includes a file, and loads three more from another folder."""
    folder = file.parent
    (head,) = re.findall(r"^<mujoco.*$", MJCF, re.MULTILINE)
    (folder / "mine.xml").write_text(MJCF.replace(head, LOADS))
    (folder / "part.xml").write_text('<mujoco><default><geom density="900"/></default></mujoco>')
    (folder / "shapes").mkdir()
    (folder / "shapes" / "hull.obj").write_text(HULL)
    for name in ("hill", "paint"):
        Image.new("RGB", (8, 8)).save(folder / "shapes" / f"{name}.png")
    return folder


def test_a_file_that_an_own_robot_loads_is_in_its_runs_digest(loading: Path) -> None:
    """A run went on with another robot where a file that its MJCF includes was edited."""
    study = Study((TASK,), ("generic",), policy="random", suite_files=(str(loading / "desk.py"),))
    assert list(mjcf.other_files(ROBOTS["mine"])) == [
        "part.xml",
        "shapes/hill.png",
        "shapes/hull.obj",
        "shapes/paint.png",
    ]
    run = open_run(loading / "run", study.configuration())
    assert open_run(run, study.configuration()) == run
    for file in mjcf.other_files(ROBOTS["mine"]).values():
        before = file.read_bytes()
        file.write_bytes(before + b"\n")
        with pytest.raises(BadOutput, match=r"holds another run \(world \w+ there, \w+ now\)"):
            open_run(run, study.configuration())
        file.write_bytes(before)
    assert open_run(run, study.configuration()) == run


def test_a_file_that_the_mjcf_loads_and_that_is_gone_is_named(loading: Path) -> None:
    suites.open_file(loading / "desk.py")
    (loading / "shapes" / "hull.obj").unlink()
    with pytest.raises(BadRobot, match=r"loads .*hull\.obj, which is no file; put it there"):
        mjcf.other_files(ROBOTS["mine"])


def test_the_motion_of_an_own_robot_is_in_the_scripted_policys_runs(file: Path) -> None:
    """A run went on with another motion."""
    suites.open_file(file)
    MOTIONS["mine"] = Motion()
    scripted, other = (Study((TASK,), ("generic",), policy=name) for name in ("scripted", "random"))
    run = open_run(file.parent / "scripted", scripted.configuration())
    run_of_other = open_run(file.parent / "other", other.configuration())
    MOTIONS["mine"] = Motion(close_s=0.0)
    with pytest.raises(BadOutput, match=r"holds another run \(other motions\)"):
        open_run(run, scripted.configuration())
    assert open_run(run_of_other, other.configuration()) == run_of_other
    assert "motions" not in DEMO.configuration()
