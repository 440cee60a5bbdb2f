"""The benchmarks as gymnasium environments.

`import vap_core.simulation.gym_env`, then `gym.make("vap/simpler-bridge/put-camera-v0")`. An
observation is what a policy may read (policies.protocol.PolicyInput): the suite's camera images,
the proprioception, and the instruction. An action is one control step in the suite's control
(types.Action). The reward is 1 in the step in which the rule is met, else 0. An AsyncVectorEnv
gives the instructions with shared_memory=False alone: gymnasium never reads texts from that memory.
"""

import re
import warnings
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs import registration

from vap_core.base.errors import BadSuite, one_of
from vap_core.base.types import Rgb
from vap_core.simulation import suites
from vap_core.simulation.scenes import Scene, meshes_called
from vap_core.simulation.suites import Judge, shared
from vap_core.simulation.suites.lists import check
from vap_core.simulation.suites.open_row import build_scene, make_env, models_of
from vap_core.simulation.suites.suite import Suite
from vap_core.simulation.types import EpisodeRow

LONGEST_M = 0.25
"""Bound of a translation in the action space, metres per second; the robot's limits hold too."""
LONGEST_RAD = 1.5
"""Bound of a rotation in the action space, radians per second; the robot's limits hold too."""
MOST_SCENES = 16
"""Compiled scenes that are kept, one per variant and set of objects."""
OUTCOME_FIELDS = (
    "steps",
    "success",
    "success_once",
    "held_steps",
    "wrong_object",
    "first_object_correct",
)
"""The fields of Outcome in the info of a step."""
CHARSET = "".join(map(chr, range(32, 127)))
"""The characters of the shipped suites' instructions; a user's own may have others."""


class VapEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """One task of one suite, whose episodes have no sub-goals.

    `reset(options={"episode": i})` starts episode i of its list, else one is drawn by the seed.
    `reset(options={"row": row})` starts any EpisodeRow of the same robot, for suites of your own.

    Raises: UnknownName for a suite, a task, `robots` or a `render_mode` that there is not; BadSuite
        for a damaged list, or `episodes` below 1; BadViews for an `image_size` below 1.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        suite: str,
        task: str,
        image_size: int = 224,
        robots: str = "plain",
        render_mode: str | None = None,
        episodes: int = 20,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise one_of("VapEnv: render_mode", render_mode, self.metadata["render_modes"])
        if episodes < 1:
            raise BadSuite(f"VapEnv: episodes is {episodes}; give 1 or more.")
        self.suite = suites.suite(suite)
        self.rows = suites.rows(suite, task, episodes if suite in suites.WARM_UPS else None)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.suite.hz}
        self.image_size = image_size
        self.robots = meshes_called(robots)
        self._scenes: dict[tuple[str, tuple[str, ...]], Scene] = {}
        self._judge: Judge | None = None
        self._start(self.rows[0])
        self.observation_space = self._observations()
        self.action_space = self._actions()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; a seed reaches the sensor's noise, too.

        Raises: BadSuite for a row that cannot be run here.
        """
        super().reset(seed=seed)
        options = options or {}
        row = options.get("row") or self._listed_row(options)
        if not isinstance(row, EpisodeRow) or suites.suite(row.suite).robot != self.suite.robot:
            raise BadSuite(
                f"reset: {row!r:.80} is no EpisodeRow for {self.suite.robot}; "
                "take one of vap_core.simulation.suites.rows and replace its fields."
            )
        check([row], self.suite)
        self._start(row if seed is None else replace(row, seed=seed))
        return self._observe(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One control step: observation, reward, terminated, truncated, info."""
        assert self._judge is not None, "call reset first"
        before = self._judge
        self._env.step(np.asarray(action, np.float32))
        self._judge = before.step(self._env.truth())
        reward = float(self._judge.success_once and not before.success_once)
        truncated = self._judge.steps >= self._judge.row.max_steps
        return self._observe(), reward, self._judge.done, truncated, self._info()

    def render(self) -> Rgb | None:
        """All cameras side by side, when made with `render_mode="rgb_array"`."""
        if self.render_mode is None:
            return None
        return np.concatenate(list(self._env.observe().images.values()), axis=1)

    def close(self) -> None:
        """Release the compiled scenes."""
        for scene in self._scenes.values():
            scene.close()
        self._scenes.clear()

    def _observations(self) -> gymnasium.Space[Any]:
        shape = (self.image_size, self.image_size, 3)
        picture = spaces.Box(low=0, high=255, shape=shape, dtype=np.uint8)
        state = spaces.Box(
            low=-np.inf, high=np.inf, shape=self._env.state().shape, dtype=np.float32
        )
        instruction = spaces.Text(max_length=200, charset=self._charset())
        return spaces.Dict(
            {
                "images": spaces.Dict(dict.fromkeys(self.suite.cameras, picture)),
                "state": state,
                "instruction": instruction,
            }
        )

    def _charset(self) -> str:
        """The characters of every instruction of the suite; the same for all its tasks."""
        name = self.suite.name
        rows = suites.benchmark(name) if suites.has_list(name) else self.rows
        return "".join(sorted(set(CHARSET).union(*(row.instruction for row in rows))))

    def _actions(self) -> gymnasium.Space[Any]:
        rates = self._env.robot.speed_rad_s
        if self.suite.control == "ee":
            rates = np.array([LONGEST_M] * 3 + [LONGEST_RAD] * 3)
        most = (rates / self.suite.hz).astype(np.float32)
        ends = np.append(-most, np.float32(0)), np.append(most, np.float32(1))
        return spaces.Box(*ends, dtype=np.float32)

    def _listed_row(self, options: dict[str, Any]) -> EpisodeRow:
        """The row of the asked episode, or of one drawn at random."""
        number = options.get("episode", int(self.np_random.integers(len(self.rows))))
        if number not in range(len(self.rows)):
            name = self.spec.id if self.spec else "the list"
            raise BadSuite(f"reset: no episode {number!r}; {name} has 0 .. {len(self.rows) - 1}.")
        return self.rows[number]

    def _start(self, row: EpisodeRow) -> None:
        if row.subgoals:
            raise BadSuite(
                f"gym: episodes of {row.suite} have sub-goals, and the reward here is of one; run "
                "them by: ./vap eval"
            )
        scene = self._scene(row)
        self._env = make_env(scene, self.suite.name, image_size=self.image_size)
        self._env.reset(row)
        self._judge = Judge.start(row, scene.sizes_m, self._env.truth())

    def _scene(self, row: EpisodeRow) -> Scene:
        """A scene with the objects of `row` and of all listed rows of its variant."""
        of_variant = [known for known in (*self.rows, row) if known.variant == row.variant]
        models = tuple(models_of(of_variant))
        key = (row.variant, models)
        if key not in self._scenes:
            if len(self._scenes) >= MOST_SCENES:
                self._scenes.pop(next(iter(self._scenes))).close()
            self._scenes[key] = build_scene(self.suite.name, models, row.variant, self.robots)
        return self._scenes[key]

    def _observe(self) -> dict[str, Any]:
        observation = self._env.observe()
        images, words = dict(observation.images), self._env.row.instruction
        return {"images": images, "state": observation.state, "instruction": words}

    def _info(self) -> dict[str, Any]:
        assert self._judge is not None
        outcome = self._judge.outcome()
        row = self._judge.row
        info = {name: getattr(row, name) for name in ("episode", "variant", "split")}
        info |= {name: getattr(outcome, name) for name in OUTCOME_FIELDS}
        return info if outcome.cmr is None else {**info, "cmr": outcome.cmr}  # none for selection


def env_id(suite: str, task: str) -> str:
    """The gymnasium id of a task."""
    return f"vap/{suite}/{task}-v0"


def register() -> None:
    """Enter every task of every suite that is not entered yet, the user's own among them.

    Tasks in several steps are none: the reward here is of one goal (`VapEnv._start`).

    Those are the suites that are open, and those of VAP_SUITES. Gymnasium's grammar of ids knows
    one slash. It is widened for namespaces under "vap/"; every other id is read as before.

    Raises: BadSuite: a file of VAP_SUITES is damaged.
    """
    registration.ENV_ID_RE = re.compile(
        r"^(?:(?P<namespace>vap/[\w-]+|[\w:-]+)\/)?(?:(?P<name>[\w:.-]+?))(?:-v(?P<version>\d+))?$"
    )
    several = {name for name, tasks in shared.TASKS.items() if any(t.subgoals for t in tasks)}
    _register(suite for suite in suites.SUITES.values() if suite.name not in several)
    _register(suites.own_suites())


def _register(known: Iterable[Suite]) -> None:
    for suite in known:
        for task in suite.tasks:
            name = env_id(suite.name, task.name)
            if name not in registration.registry:
                gymnasium.register(
                    name,
                    f"{__name__}:VapEnv",
                    kwargs={"suite": suite.name, "task": task.name},
                )


try:
    register()
except BadSuite as broken:  # what needs no suite, as VapPrompt on a robot, goes on
    warnings.warn(f"{broken} Its tasks are no environments.", stacklevel=2)
