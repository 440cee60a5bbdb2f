"""The benchmarks as gymnasium environments: `import vap_core.simulation.gym_env`, then `gym.make("vap/simpler-bridge/put-camera-v0")`.

An observation is what a policy may read (values.PolicyInput): the suite's camera images, the proprioception, and the instruction. An
action is one control step in the suite's control (values.Action). The reward is 1 in the step in which the rule is met, else 0.
"""

import re
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs import registration

from vap_core.base.errors import BadSuite
from vap_core.base.types import Rgb
from vap_core.simulation import suites
from vap_core.simulation.scenes import Meshes, Scene
from vap_core.simulation.suites import Judge
from vap_core.simulation.suites.lists import check
from vap_core.simulation.suites.open_row import build_scene, make_env
from vap_core.simulation.types import EpisodeRow

LONGEST_M, LONGEST_RAD = 0.25, 1.5
"""Bounds of the action space, per second; the robot's own limits are enforced in any case."""
MOST_SCENES = 16
"""Compiled scenes kept, one per variant and set of objects."""
CHARSET = "".join(map(chr, range(32, 127)))


class VapEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """One task of one suite. `reset(options={"episode": i})` starts episode i of its list, else one is drawn by the seed.

    `reset(options={"row": row})` starts any EpisodeRow of the same robot, for suites of your own.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        suite: str,
        task: str,
        image_size: int = 224,
        robots: Meshes = "plain",
        render_mode: str | None = None,
        episodes: int = 20,
    ) -> None:
        self.suite = suites.suite(suite)
        self.rows = suites.rows(suite, task, episodes if suite in suites.WARM_UPS else None)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.suite.hz}
        self.image_size = image_size
        self.robots = robots
        self._scenes: dict[tuple[str, tuple[str, ...]], Scene] = {}
        self._judge: Judge | None = None
        self._start(self.rows[0])
        state, cameras = self._env.state(), self.suite.cameras
        picture = spaces.Box(0, 255, (image_size, image_size, 3), np.uint8)
        self.observation_space = spaces.Dict(
            {
                "images": spaces.Dict({name: picture for name in cameras}),
                "state": spaces.Box(-np.inf, np.inf, state.shape, np.float32),
                "instruction": spaces.Text(max_length=200, charset=CHARSET),
            }
        )
        rates = (
            [LONGEST_M] * 3 + [LONGEST_RAD] * 3
            if self.suite.control == "ee"
            else self._env.robot.speed_rad_s.tolist()
        )
        most = np.array([rate / self.suite.hz for rate in rates], np.float32)
        self.action_space = spaces.Box(
            np.append(-most, np.float32(0)), np.append(most, np.float32(1)), dtype=np.float32
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; a seed reaches the sensor's noise, too. Raises: BadSuite for a row that cannot be run here."""
        super().reset(seed=seed)
        options = options or {}
        row = options.get("row")
        if row is None:
            number = options.get("episode", int(self.np_random.integers(len(self.rows))))
            if number not in range(len(self.rows)):
                raise BadSuite(
                    f"reset: no episode {number!r}; {self.spec.id if self.spec else 'the list'} has 0 .. {len(self.rows) - 1}."
                )
            row = self.rows[number]
        if not isinstance(row, EpisodeRow) or suites.suite(row.suite).robot != self.suite.robot:
            raise BadSuite(
                f"reset: {row!r:.80} is no EpisodeRow for {self.suite.robot}; take one of vap_core.simulation.suites.rows and replace its fields."
            )
        check([row])
        self._start(row if seed is None else replace(row, seed=seed))
        return self._observe(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        assert self._judge is not None, "call reset first"
        before = self._judge
        self._env.step(np.asarray(action, np.float32))
        self._judge = before.step(self._env.truth())
        reward = float(self._judge.success_once and not before.success_once)
        return (
            self._observe(),
            reward,
            self._judge.done,
            self._judge.steps >= self._judge.row.max_steps,
            self._info(),
        )

    def render(self) -> Rgb | None:
        """All cameras side by side, when made with `render_mode="rgb_array"`."""
        if self.render_mode is None:
            return None
        return np.concatenate(list(self._env.observe().images.values()), axis=1)

    def close(self) -> None:
        for scene in self._scenes.values():
            scene.close()
        self._scenes.clear()

    def _start(self, row: EpisodeRow) -> None:
        models = tuple(
            dict.fromkeys(
                place.model
                for known in (*self.rows, row)
                if known.variant == row.variant
                for place in known.placements
            )
        )
        key = (row.variant, models)
        if key not in self._scenes:
            if len(self._scenes) >= MOST_SCENES:
                self._scenes.pop(next(iter(self._scenes))).close()
            self._scenes[key] = build_scene(self.suite.name, models, row.variant, self.robots)
        self._env = make_env(self._scenes[key], self.suite.name, image_size=self.image_size)
        self._env.reset(row)
        self._judge = Judge.start(row, self._scenes[key].sizes_m, self._env.truth())

    def _observe(self) -> dict[str, Any]:
        seen = self._env.observe()
        return {
            "images": dict(seen.images),
            "state": seen.state,
            "instruction": self._env.row.instruction,
        }

    def _info(self) -> dict[str, Any]:
        assert self._judge is not None
        outcome, row = self._judge.outcome(), self._judge.row
        measured = {
            name: getattr(outcome, name)
            for name in (
                "success",
                "success_once",
                "held_steps",
                "wrong_object",
                "first_object_correct",
            )
        }
        if outcome.cmr is not None:  # the paper defines none for selection
            measured["cmr"] = outcome.cmr
        return {
            "episode": row.episode,
            "variant": row.variant,
            "split": row.split,
            "steps": outcome.steps,
            **measured,
        }


def env_id(suite: str, task: str) -> str:
    """The gymnasium id of a task."""
    return f"vap/{suite}/{task}-v0"


def register() -> None:
    """Enter every task of every suite; asking twice does no harm.

    Gymnasium's grammar of ids knows one slash. It is widened for namespaces under "vap/", every other id is read as before.
    """
    registration.ENV_ID_RE = re.compile(
        r"^(?:(?P<namespace>vap/[\w-]+|[\w:-]+)\/)?(?:(?P<name>[\w:.-]+?))(?:-v(?P<version>\d+))?$"
    )
    for suite in suites.SUITES.values():
        for task in suite.tasks:
            if env_id(suite.name, task.name) not in registration.registry:
                gymnasium.register(
                    env_id(suite.name, task.name),
                    f"{__name__}:VapEnv",
                    kwargs={"suite": suite.name, "task": task.name},
                )


register()
