"""The twin of an SO-101 keeps what lerobot asks of a robot; lerobot's own commands drive and record it."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lerobot.robots.so_follower.config_so_follower import SO101FollowerConfig
from lerobot.robots.utils import make_robot_from_config
from lerobot.teleoperators.utils import make_teleoperator_from_config

from tests.test_lerobot_plugin import PLUGIN, ROOT, site
from vap_core.base.errors import BadAction, BadStudy, UnknownName
from vap_core.policies.lerobot.datasets import open_dataset
from vap_core.policies.lerobot.twin import VapExpertConfig, VapSo101Twin, VapSo101TwinConfig
from vap_core.simulation import suites

__all__ = ["site"]
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


@pytest.fixture
def twin(tmp_path: Path):
    robot = make_robot_from_config(
        VapSo101TwinConfig(task="tabletop/select-cup", image_size=64, calibration_dir=tmp_path)
    )
    assert isinstance(robot, VapSo101Twin)
    robot.connect()
    yield robot
    robot.disconnect()


def test_its_features_are_the_arms_and_its_cameras(twin: VapSo101Twin) -> None:
    assert tuple(twin.action_features) == tuple(f"{joint}.pos" for joint in JOINTS)
    seen = twin.get_observation()
    assert seen.keys() == twin.observation_features.keys()
    for camera in ("front", "side", "wrist"):
        assert seen[camera].shape == twin.observation_features[camera] == (64, 64, 3)
        assert seen[camera].dtype == np.uint8
    fields = SO101FollowerConfig.__dataclass_fields__
    assert fields["use_degrees"].default is True, "the arm's positions are degrees, too"


def test_it_starts_where_the_row_does_and_goes_where_it_is_sent(twin: VapSo101Twin) -> None:
    start = twin.get_observation()
    assert start["gripper.pos"] == pytest.approx(100, abs=1)
    home = np.rad2deg(twin.env.robot.home)
    assert [start[f"{joint}.pos"] for joint in JOINTS[:-1]] == pytest.approx(home, abs=1.5)
    goal = {f"{joint}.pos": start[f"{joint}.pos"] for joint in JOINTS}
    goal["shoulder_pan.pos"] += 10
    goal["gripper.pos"] = 40.0
    for _ in range(30):
        sent = twin.send_action(goal)
    assert sent["shoulder_pan.pos"] == pytest.approx(goal["shoulder_pan.pos"], abs=0.1)
    there = twin.get_observation()
    assert there["shoulder_pan.pos"] == pytest.approx(goal["shoulder_pan.pos"], abs=1.5)
    assert there["gripper.pos"] == pytest.approx(40, abs=3)


def test_a_far_goal_is_cut_to_the_joints_speed_and_what_was_sent_is_told(twin) -> None:
    here = twin.get_observation()["shoulder_pan.pos"]
    sent = twin.send_action({"shoulder_pan.pos": here + 90.0})
    most = np.rad2deg(twin.env.robot.speed_rad_s[0]) / twin.env.hz
    assert 0 < sent["shoulder_pan.pos"] - here < most + 2


def test_a_position_that_is_no_number_is_not_taken_for_one_that_is_not_named(twin) -> None:
    with pytest.raises(BadAction, match="finite"):
        twin.send_action({"shoulder_pan.pos": float("nan")})


def test_the_expert_leads_it_to_success(twin: VapSo101Twin, tmp_path: Path) -> None:
    leader = make_teleoperator_from_config(VapExpertConfig(calibration_dir=tmp_path))
    leader.connect()
    assert leader.action_features == twin.action_features
    for _ in range(twin.row.max_steps):
        twin.send_action(leader.get_action())
        if twin.outcome().success:
            break
    assert twin.outcome().success
    leader.disconnect()


def test_what_it_cannot_be_is_refused(tmp_path: Path, monkeypatch) -> None:
    find = suites.suite

    def made(**options) -> VapSo101Twin:
        return VapSo101Twin(VapSo101TwinConfig(calibration_dir=tmp_path, **options))

    with pytest.raises(UnknownName, match=r"vlabench has a panda under joint control; take a task"):
        made(task="vlabench/select-shoe")
    with pytest.raises(BadStudy, match=r"have sub-goals, and the outcome here is of one"):
        made(task="shared-sequence/put-plant-scrubber")
    monkeypatch.setattr(suites, "suite", lambda name: replace(find(name), control="ee"))
    with pytest.raises(UnknownName, match=r'so101 under ee control; .* and control="joint"'):
        made()
    monkeypatch.undo()
    with pytest.raises(BadStudy, match=r"no episode 20; tabletop/select-cup has 0 \.\. 19"):
        made(episode=20)
    with pytest.raises(ConnectionError, match="call connect first"):
        made().get_observation()
    leader = make_teleoperator_from_config(VapExpertConfig(calibration_dir=tmp_path))
    leader.connect()
    with pytest.raises(ConnectionError, match="no twin is connected"):
        leader.get_action()


def lerobot(site: Path, command: str, *words: str, cwd: Path) -> str:
    """What one of lerobot's commands says, run with the plugin in a folder of its own."""
    done = subprocess.run(
        [Path(sys.executable).with_name(command), *words],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(site), str(ROOT)]),
            "OMP_NUM_THREADS": "1",
            "HF_HUB_OFFLINE": "1",
            "HF_LEROBOT_HOME": str(cwd / "home"),
        },
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout + done.stderr


@pytest.mark.sweep
@pytest.mark.timeout(1800)
def test_lerobots_commands_teleoperate_record_and_roll_out_on_it(
    site: Path, tmp_path: Path
) -> None:
    """lerobot-teleoperate, lerobot-record into a dataset v3, and lerobot-rollout of a policy of its features."""
    from tests.tiny_lerobot import act_of

    assert PLUGIN.is_dir()
    robot = ("--robot.type=vap_so101_twin", "--robot.image_size=64")
    leader = "--teleop.type=vap_expert"
    lerobot(site, "lerobot-teleoperate", *robot, leader, "--teleop_time_s=1", cwd=tmp_path)
    lerobot(
        site, "lerobot-record", *robot, leader, "--dataset.repo_id=me/twin", f"--dataset.root={tmp_path / 'twin'}",
        "--dataset.single_task=select my cup", "--dataset.num_episodes=1", "--dataset.episode_time_s=2",
        "--dataset.reset_time_s=0", "--dataset.push_to_hub=false", "--play_sounds=false", "--dataset.video=false",
        cwd=tmp_path,
    )  # fmt: skip
    (folder,) = [path.parent.parent for path in tmp_path.rglob("meta/info.json")]
    recorded = open_dataset(folder)
    assert tuple(recorded.keys) == suites.suite("tabletop").cameras
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    names = [f"{joint}.pos" for joint in JOINTS]
    assert info["features"]["observation.state"]["names"] == names
    assert info["features"]["action"]["names"] == names
    act_of(tmp_path / "policy", tuple(recorded.keys), side=64, state=6, action=6)
    said = lerobot(
        site, "lerobot-rollout", *robot, f"--policy.path={tmp_path / 'policy'}", "--task=select my cup",
        "--duration=2", "--fps=30", "--device=cpu", cwd=tmp_path,
    )  # fmt: skip
    assert "Rollout finished" in said
