"""What lerobot's command line says about the twin of an SO-101, and about its expert.

lerobot finds the device of `NameConfig` as `Name` in this module's package.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from lerobot.robots import Robot
from lerobot.robots.config import RobotConfig
from lerobot.teleoperators import Teleoperator
from lerobot.teleoperators.config import TeleoperatorConfig

from vap_core.base.errors import BadStudy, UnknownName
from vap_core.policies.scripted.expert import Expert, ExpertState
from vap_core.simulation import robots, suites
from vap_core.simulation.env import Env
from vap_core.simulation.scenes import Scene
from vap_core.simulation.suites import Judge
from vap_core.simulation.suites.open_row import build_scene, make_env
from vap_core.simulation.types import EpisodeRow, Outcome


@RobotConfig.register_subclass("vap_so101_twin")
@dataclass(kw_only=True)
class VapSo101TwinConfig(RobotConfig):
    """An SO-101 on the desk of a tabletop episode.

    `task` is SUITE/TASK of a suite whose robot is an SO-101, `episode` the number of its row.
    Pictures are `image_size` pixels a side. `object` takes the target's place, as in `rollout
    --object`.
    """

    task: str = "tabletop/select-cup"
    episode: int = 0
    image_size: int = 224
    object: str = ""


@TeleoperatorConfig.register_subclass("vap_expert")
@dataclass(kw_only=True)
class VapExpertConfig(TeleoperatorConfig):
    """The scripted expert, which reads the simulator, in place of a leader arm."""


ROBOT = "so101"
GRIPPER = "gripper"
OPEN = 100.0
"""lerobot's number for an open gripper; 0 is closed."""

logger = logging.getLogger(__name__)


class VapSo101Twin(Robot):
    """One episode of a suite, from `connect` to `disconnect`. Reads and acts in one thread.

    Raises: UnknownName for a suite, a task or an object that it cannot take; BadStudy for an
        episode that the list does not have, one with sub-goals, or an object that does not fit the
        task; BadObject for a damaged scan.
    """

    config_class = VapSo101TwinConfig
    name = "vap_so101_twin"

    def __init__(self, config: VapSo101TwinConfig) -> None:
        super().__init__(config)
        self.config = config
        self.row = _row(config)
        self.suite = suites.suite(self.row.suite)
        self._scene: Scene | None = None
        self._env: Env | None = None
        self._judge: Judge | None = None
        self._joints = _joints()
        side = config.image_size
        # What lerobot asks of a robot's camera, which here is no device.
        camera = SimpleNamespace(
            height=side, width=side, fps=round(self.suite.hz), is_connected=True
        )
        self.cameras = dict.fromkeys(self.suite.cameras, camera)

    @property
    def observation_features(self) -> dict[str, Any]:
        pictures = {name: (camera.height, camera.width, 3) for name, camera in self.cameras.items()}
        return {**self.action_features, **pictures}

    @property
    def action_features(self) -> dict[str, Any]:
        return {f"{joint}.pos": float for joint in _joints()}

    @property
    def env(self) -> Env:
        """The running simulation. Raises: ConnectionError before `connect`."""
        if self._env is None:
            raise ConnectionError("vap_so101_twin: not connected; call connect first.")
        return self._env

    @property
    def is_connected(self) -> bool:
        return self._env is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        models = [place.model for place in self.row.placements]
        self._scene = build_scene(self.suite.name, models, self.row.variant)
        self._env = make_env(self._scene, self.suite.name, image_size=self.config.image_size)
        self._env.reset(self.row)
        self._judge = Judge.start(self.row, self._scene.sizes_m, self._env.truth())
        CONNECTED.append(self)
        task = f"{self.row.suite}/{self.row.task}"
        logger.info("twin: %s, episode %d: %s", task, self.row.episode, self.row.instruction)

    def calibrate(self) -> None:
        """A simulated arm is calibrated."""

    def configure(self) -> None:
        """A simulated arm has nothing to set."""

    def get_observation(self) -> dict[str, Any]:
        seen = self.env.observe()
        degrees = np.rad2deg(seen.state[1 - len(self._joints) :])
        positions = [*degrees.tolist(), OPEN * float(seen.state[6])]
        return {**dict(zip(self.action_features, positions, strict=True)), **seen.images}

    def send_action(self, action: Mapping[str, float]) -> dict[str, float]:
        """Go towards the positions for one control step; returns what was commanded.

        A joint moves no faster than it can, and leads no farther than it can follow: then the
        positions that come back are nearer than those asked for, as on the arm.
        """
        env = self.env
        command = env.command
        # A joint that is not named holds its place.
        goals = [*np.rad2deg(command.joints).tolist(), OPEN * command.gripper]
        for i, joint in enumerate(self._joints):
            if f"{joint}.pos" in action:
                goals[i] = float(action[f"{joint}.pos"])
        moves = np.deg2rad(goals[:-1]) - command.joints
        env.step(np.array([*moves, float(np.clip(goals[-1] / OPEN, 0.0, 1.0))], np.float32))
        judge = self._judge
        assert judge is not None
        if not judge.done and judge.steps < self.row.max_steps:
            self._judge = judge = judge.step(env.truth())
            if judge.done:
                logger.info("twin: %s at step %d", judge.outcome().status, judge.steps)
        sent = [*np.rad2deg(env.command.joints).tolist(), OPEN * env.command.gripper]
        return dict(zip(self.action_features, sent, strict=True))

    def disconnect(self) -> None:
        if self._judge is not None:
            outcome = self._judge.outcome()
            logger.info("twin: %s after %d steps", outcome.status, outcome.steps)
        if self._scene is not None:
            self._scene.close()
        if self in CONNECTED:
            CONNECTED.remove(self)
        self._scene = self._env = None

    def outcome(self) -> Outcome:
        """How the episode stands, by the suite's rule. Raises: ConnectionError."""
        if self._judge is None:
            raise ConnectionError("vap_so101_twin: not connected; call connect first.")
        return self._judge.outcome()


CONNECTED: list[VapSo101Twin] = []
"""The twins of this process that are connected, the last one last."""


class VapExpert(Teleoperator):
    """The scripted expert as a leader of the twin that is connected in this process.

    It reads the simulator: what it records are demonstrations, never results of a policy.
    """

    config_class = VapExpertConfig
    name = "vap_expert"

    def __init__(self, config: VapExpertConfig) -> None:
        super().__init__(config)
        self.config = config
        self._expert = Expert()
        self._of: VapSo101Twin | None = None
        self._state: ExpertState | None = None

    @property
    def action_features(self) -> dict[str, Any]:
        return {f"{joint}.pos": float for joint in _joints()}

    @property
    def feedback_features(self) -> dict[str, Any]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._state is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        self._state = self._expert.start(np.random.default_rng(0))

    def calibrate(self) -> None:
        """There is nothing to calibrate."""

    def configure(self) -> None:
        """There is nothing to set."""

    def get_action(self) -> dict[str, float]:
        """Where the expert goes next. Raises: ConnectionError without a connected twin."""
        if not CONNECTED:
            raise ConnectionError("vap_expert: no twin is connected; it leads vap_so101_twin only.")
        twin = CONNECTED[-1]
        if twin is not self._of or self._state is None:
            self._of = twin
            self._state = self._expert.start(np.random.default_rng(0))
        env = twin.env
        (self._state,), (chunk,) = self._expert.plan_from_simulation([self._state], [env])
        action = chunk[0]
        joints = np.rad2deg(env.command.joints + action[:-1]).tolist()
        positions = [*joints, OPEN * float(np.clip(action[-1], 0.0, 1.0))]
        return dict(zip(self.action_features, positions, strict=True))

    def send_feedback(self, feedback: dict[str, float]) -> None:
        """It feels nothing."""

    def disconnect(self) -> None:
        self._state = None
        self._of = None


def _joints() -> tuple[str, ...]:
    return (*robots.get(ROBOT).joints, GRIPPER)


def _row(config: VapSo101TwinConfig) -> EpisodeRow:
    """The row of the configured episode. Raises: UnknownName, BadStudy."""
    suite_name, _, task = config.task.partition("/")
    suite = suites.suite(suite_name)
    if suite.robot != ROBOT or suite.control != "joint":
        raise UnknownName(
            f"vap_so101_twin: {suite_name} has a {suite.robot} under {suite.control} control; take "
            'a task of tabletop, or of a suite of your own with an SO-101 and control="joint".'
        )
    rows = suites.listed(suite_name, task, own_target=config.object)
    if config.episode not in range(len(rows)):
        raise BadStudy(
            f"vap_so101_twin: no episode {config.episode}; {config.task} has 0 .. {len(rows) - 1}."
        )
    row = rows[config.episode]
    if row.subgoals:
        raise BadStudy(
            f"vap_so101_twin: episodes of {config.task} have sub-goals, and the outcome here is of "
            "one; run them by: ./vap eval"
        )
    return row
