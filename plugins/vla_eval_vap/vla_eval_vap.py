"""The suites of vap_core in vla-eval (0.8): every one of its model servers runs our episode lists.

    benchmarks:
      - benchmark: "vla_eval_vap:VapBenchmark"
        episodes_per_task: 20
        params: {suite: simpler-bridge}

`vla-eval run --no-docker --config FILE --server-url ws://127.0.0.1:8001`: a server, or the
prompting proxy before one. An observation has `images` by camera, `task_description` and `state`;
an action is one control step in the suite's own control (vap_core.simulation.types.Action).
"""

from typing import Any

import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.specs import IMAGE_RGB, LANGUAGE, RAW, DimSpec
from vla_eval.types import Action, EpisodeResult, Observation, Task

from vap_core.simulation import suites
from vap_core.simulation.gym_env import VapEnv


class VapBenchmark(StepBenchmark):
    """The tasks of one suite, or those named; episode i is the i-th of the task's list."""

    render_backends = frozenset({"gpu", "cpu"})

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        return {}  # MuJoCo's renderer takes what there is

    def __init__(
        self, suite: str = "simpler-bridge", tasks: list[str] | None = None, image_size: int = 224
    ) -> None:
        super().__init__()
        self.suite = suites.suite(suite)
        self.tasks = [self.suite.task(name).name for name in tasks or []]
        self.image_size = image_size
        self._env: VapEnv | None = None
        self._task_name = ""

    def get_tasks(self) -> list[Task]:
        names = self.tasks or [task.name for task in self.suite.tasks]
        return [{"name": name, "suite": self.suite.name} for name in names]

    def reset(self, task: Task) -> Any:
        if self._env is None or self._task_name != task["name"]:
            self.cleanup()
            self._env = VapEnv(self.suite.name, task["name"], self.image_size)
            self._task_name = task["name"]
        number = int(task.get("episode_idx", 0)) % len(self._env.rows)
        observation, _ = self._env.reset(options={"episode": number})
        return observation

    def step(self, action: Action) -> StepResult:
        assert self._env is not None
        row = np.asarray(action["actions"], np.float32).reshape(-1)
        observation, reward, terminated, truncated, info = self._env.step(row)
        return StepResult(observation, reward, terminated or truncated, info)

    def make_obs(self, raw_obs: Any, task: Task) -> Observation:
        text = raw_obs["instruction"]
        images = {name: np.ascontiguousarray(rgb) for name, rgb in raw_obs["images"].items()}
        return {"images": images, "task_description": text, "state": raw_obs["state"]}

    def get_step_result(self, step_result: StepResult) -> EpisodeResult:
        info = step_result.info
        names = ("success", "wrong_object", "steps")
        return {name: info[name] for name in names if name in info}

    def get_action_spec(self) -> dict[str, DimSpec]:
        return {"actions": RAW}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        return {"image": IMAGE_RGB, "state": RAW, "language": LANGUAGE}

    def get_metric_keys(self) -> dict[str, str]:
        return {"success": "mean", "wrong_object": "mean"}

    def cleanup(self) -> None:
        if self._env is not None:
            self._env.close()
        self._env = None
