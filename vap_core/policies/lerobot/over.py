"""Personal objects in any environment of lerobot: `--env.type=vap_over --env.over=libero ...`.

    lerobot-eval --policy.path=personalised --env.type=vap_over --env.over=libero \\
        --env.options='{"task": "libero_90", "task_ids": [65]}' \\
        --env.instruction="put my mug on the left plate"

The environment is as it was, but for two things: it numbers the steps of an episode in the
observation `vap_step`, from which the attached step (`step`) knows where one begins; and its
command can be another. lerobot-eval says so where a rollout begins. An environment whose episode is
over stands still, so that no picture of the next one is taken for one of this.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.envs.configs import EnvConfig

from vap_core.base.errors import BadSuite, first_line, one_of


class NumberedEnvs:
    """A vector environment of lerobot's whose observations have `vap_step`."""

    def __init__(self, envs: Any, instruction: str) -> None:
        self._envs = envs
        self._instruction = instruction
        self._steps = np.zeros(0, np.float32)
        self._over = np.zeros(0, bool)
        self._seen: Any = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._envs, name)

    def reset(self, **how: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        seen, info = self._envs.reset(**how)
        self._steps = np.zeros(self._envs.num_envs, np.float32)
        self._over = np.zeros(self._envs.num_envs, bool)
        self._seen = seen
        return self._numbered(seen), info

    def step(self, action: Any) -> tuple[Any, ...]:
        seen, reward, terminated, truncated, info = self._envs.step(action)
        seen = _still(seen, self._seen, self._over)
        self._steps = self._steps + ~self._over
        self._over = self._over | np.asarray(terminated) | np.asarray(truncated)
        self._seen = seen
        return self._numbered(seen), reward, terminated, truncated, info

    def call(self, name: str, *given: Any, **more: Any) -> Any:
        if self._instruction and name in ("task_description", "task"):
            return [self._instruction] * self._envs.num_envs
        return self._envs.call(name, *given, **more)

    def _numbered(self, seen: dict[str, Any]) -> dict[str, Any]:
        return {**seen, "vap_step": self._steps[:, None]}


def _still(seen: Any, before: Any, over: np.ndarray) -> Any:
    """What is seen, but of the environments that are over what was seen before."""
    if not over.any():
        return seen
    if isinstance(seen, dict):
        return {key: _still(part, before[key], over) for key, part in seen.items()}
    kept = np.array(seen)
    kept[over] = np.asarray(before)[over]
    return kept


@EnvConfig.register_subclass("vap_over")
@dataclass
class VapOverConfig(EnvConfig):
    """Another registered environment, `over`, with numbered steps and perhaps another command.

    `options` are its own, by name.

    Raises: BadSuite: there is no such environment, or it has no such options.
    """

    over: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    instruction: str = ""

    def __post_init__(self) -> None:
        known = EnvConfig.get_known_choices()
        if self.over not in known or self.over == "vap_over":
            raise one_of("vap_over: --env.over", self.over, known)
        try:
            self._inner = known[self.over](**self.options)
        except (TypeError, ValueError) as error:
            raise BadSuite(
                f"vap_over: {self.over} does not take {self.options} ({first_line(error)}); give "
                'its options as JSON: --env.options=\'{"task": "libero_90"}\'.'
            ) from error
        if self.over == "libero":
            _read_npz()
        self.task, self.fps = self._inner.task, self._inner.fps
        self.features, self.features_map = self._inner.features, self._inner.features_map

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return dict(self._inner.gym_kwargs)

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> Any:
        made = self._inner.create_envs(n_envs, use_async_envs)
        return {
            suite: {i: NumberedEnvs(envs, self.instruction) for i, envs in of_suite.items()}
            for suite, of_suite in made.items()
        }

    def get_env_processors(self) -> Any:
        return self._inner.get_env_processors()


def _read_npz() -> None:
    """Let lerobot's LIBERO read initial states from .npz, as PyPI's packages of LIBERO have them;
    it unpickles torch files otherwise."""
    from lerobot.envs import libero

    unpickle = libero.get_task_init_states

    def read(task_suite: Any, i: int, is_libero_plus: bool = False) -> np.ndarray:
        task = task_suite.tasks[i]
        root = Path(libero.get_libero_path("init_states"), task.problem_folder)
        file = root / f"{Path(task.init_states_file).name}.npz"
        if is_libero_plus or not file.is_file():
            return unpickle(task_suite, i, is_libero_plus)
        with np.load(file, allow_pickle=False) as stored:
            return np.array(stored[stored.files[0]])

    libero.get_task_init_states = read
