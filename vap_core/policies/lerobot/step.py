"""VAP inside lerobot: a processor step that personalises any of its policies, and our suites as one of its environments.

    attach("checkpoint", "personalised", memory="data/memory")             # links the frozen files, adds one step to the preprocessor
    lerobot-eval --policy.path=personalised --env.type=vap --env.task=simpler-bridge/put-camera \\
        --env.discover_packages_path=vap_core.policies.lerobot --seed=0

The step tints every view and rewrites the task before anything else reads them. It must know where an episode begins: lerobot-eval never resets
its pipelines, so our environments number their steps in the observation `vap_step`; robot loops reset theirs (`episodes="reset"`).
"""

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import _LazyAsyncVectorEnv, freeze_after_episode_end
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry

from vap_core.attend import Attender, AttendState, Prompting
from vap_core.base.errors import BadMemory, BadOutput, BadViews, one_of
from vap_core.base.types import Rgb, Views
from vap_core.memory import load_bank
from vap_core.perception.stacks import STACKS, load_stack
from vap_core.policies.lerobot.checkpoints import PIPELINES, STEP_NAME, locate
from vap_core.simulation import suites
from vap_core.simulation.gym_env import VapEnv, env_id

IMAGES, STEP, AFTER = "observation.images.", "observation.vap_step", "rename_observations_processor"


@dataclass
class Following:
    """One environment's episode under way: its number of steps, what attending carries, and the last answer."""

    step: int
    state: AttendState
    images: Views
    text: str


@ProcessorStepRegistry.register(name=STEP_NAME)
@dataclass
class VapPrompt(ProcessorStep):
    """Tints the remembered object in every `observation.images.*` and rewrites `task`; the views that show it not pass bit for bit.

    `memory` is the folder of remembered objects, `objects` names those meant where the category alone does not decide.
    `episodes` says how an episode's beginning is known: by `observation.vap_step` being 0, or by `reset()` (then of one environment only).
    """

    memory: str
    stack: str = "embedded"
    objects: list[str] | None = None
    highlight: bool = True
    rewrite: bool = True
    alpha: float = 0.5
    episodes: Literal["vap_step", "reset"] = "vap_step"
    _attender: Attender | None = field(default=None, init=False, repr=False)
    _following: dict[int, Following] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.stack not in STACKS:
            raise one_of("VapPrompt: stack", self.stack, STACKS)
        if self.episodes not in ("vap_step", "reset"):
            raise one_of("VapPrompt: episodes", self.episodes, ("vap_step", "reset"))
        if not Path(self.memory).is_dir():
            raise BadMemory(
                f"VapPrompt: {self.memory} is no folder of remembered objects; register one, or attach again."
            )

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Raises: BadViews when it cannot be known which episode a picture belongs to."""
        out = transition.copy()
        observation = dict(out.get(TransitionKey.OBSERVATION) or {})
        said = dict(out.get(TransitionKey.COMPLEMENTARY_DATA) or {})
        if out.get(TransitionKey.ACTION) is not None:
            raise BadViews(
                "VapPrompt: this batch holds actions, so it is for training, and its frames are shuffled; train the plain checkpoint."
            )
        views = {key: tensor for key, tensor in observation.items() if key.startswith(IMAGES)}
        task = said.get("task")
        if not views or task is None:
            raise BadViews(
                f"VapPrompt: no {'task' if views else IMAGES + '*'} among {sorted({*observation, *said})}; give both."
            )
        single = next(iter(views.values())).ndim == 3
        pictures = {
            key: _pixels(tensor[None] if single else tensor) for key, tensor in views.items()
        }
        texts = [task] if isinstance(task, str) else list(task)
        steps = self._steps(observation.pop(STEP, None), len(texts))
        for key in views:
            observation[key] = views[key].clone()
        for i, (step, text) in enumerate(zip(steps, texts, strict=True)):
            seen = {key.removeprefix(IMAGES): rgb[i] for key, rgb in pictures.items()}
            shown = self._following[i] = self._follow(i, step, seen, text)
            texts[i] = shown.text
            for camera, rgb in shown.images.items():
                if rgb is not seen[camera] and (rgb != seen[camera]).any():
                    target = (
                        observation[IMAGES + camera] if single else observation[IMAGES + camera][i]
                    )
                    target.copy_(torch.from_numpy(rgb).permute(2, 0, 1).float() / 255)
        said["task"] = texts[0] if isinstance(task, str) else texts
        out[TransitionKey.OBSERVATION], out[TransitionKey.COMPLEMENTARY_DATA] = observation, said
        return out

    def get_config(self) -> dict[str, Any]:
        return {one.name: getattr(self, one.name) for one in fields(self) if one.init}

    def reset(self) -> None:
        """The next pictures begin an episode."""
        self._following.clear()

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:  # fmt: skip
        return features

    def _steps(self, signal: torch.Tensor | None, n: int) -> list[int]:
        """The step that every environment of the batch is at, 0 for a new episode."""
        if self.episodes == "reset":
            if n > 1:
                raise BadViews(
                    f"VapPrompt: {n} environments but episodes='reset', which knows one; give the observation vap_step and attach again."
                )
            return [self._following[0].step + 1 if self._following else 0]
        if signal is None:
            raise BadViews(
                f"VapPrompt: {STEP} is missing, so a new episode cannot be told from an old one; let the environment give vap_step (0 = new), "
                "or attach with episodes='reset' where the caller resets the preprocessor."
            )
        return [round(step) for step in signal.reshape(-1).tolist()]

    def _follow(self, i: int, step: int, seen: Views, text: str) -> Following:
        held = self._following.get(i)
        if step == 0:
            state, attended = self._load().start(seen, text, objects=self.objects)
        elif held is None or step not in (held.step, held.step + 1):
            raise BadViews(
                f"VapPrompt: environment {i} is at step {step} after {'nothing' if held is None else held.step}; give every picture, in order."
            )
        elif (
            step == held.step
        ):  # an episode that is over stands still until its neighbours are done
            return held
        else:
            state, attended = self._load().step(held.state, seen)
        return Following(step, state, attended.images, attended.text)

    def _load(self) -> Attender:
        if self._attender is None:
            stack = load_stack(self.stack)
            memory = load_bank(Path(self.memory), stack.encoder.name)
            self._attender = Attender(
                stack, memory, Prompting(self.alpha, highlight=self.highlight, rewrite=self.rewrite)
            )
        return self._attender


def attach(checkpoint: str | Path, out: Path, memory: Path, **how: Any) -> Path:
    """A checkpoint beside the frozen one: every file linked, one step added to the preprocessor right after the renaming of observations.

    `how` are VapPrompt's other fields. Raises: BadOutput when `out` exists; BadPolicy, BadMemory, UnknownName when the parts do not fit.
    """
    source = locate(checkpoint).resolve()
    step = VapPrompt(str(Path(memory).resolve()), **how)
    if out.exists():
        raise BadOutput(f"attach: {out} exists; choose another folder.")
    pipeline = json.loads((source / PIPELINES[0]).read_text())
    names = [entry.get("registry_name") for entry in pipeline["steps"]]
    place = names.index(AFTER) + 1 if AFTER in names else 0
    pipeline["steps"].insert(
        place,
        {"class": f"{VapPrompt.__module__}.{VapPrompt.__name__}", "config": step.get_config()},
    )
    out.mkdir(parents=True)
    for file in source.iterdir():
        if file.name != PIPELINES[0]:
            os.symlink(file, out / file.name)
    (out / PIPELINES[0]).write_text(json.dumps(pipeline, indent=2))
    return out


class LeRobotEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """One task in lerobot's shape: pixels by camera, `agent_pos`, and `vap_step`, the number of steps since the episode began.

    Seed s starts episode s of the task's list, modulo its length, exactly as our own rollout does; `max_steps` shortens it.
    """

    def __init__(
        self,
        suite: str,
        task: str,
        image_size: int = 224,
        robots: Any = "plain",
        max_steps: int | None = None,
    ) -> None:
        self.inner = VapEnv(suite, task, image_size, robots, render_mode="rgb_array")
        self.render_mode, self.metadata = (
            "rgb_array",
            {**self.inner.metadata, "render_fps": round(self.inner.suite.hz)},
        )
        self.rows = [
            replace(row, max_steps=min(row.max_steps, max_steps or row.max_steps))
            for row in self.inner.rows
        ]
        self.task, self.task_description = env_id(suite, task), self.rows[0].instruction
        self._max_episode_steps = max(row.max_steps for row in self.rows)
        seen = self.inner.observation_space
        assert isinstance(seen, spaces.Dict)
        count = spaces.Box(0, np.inf, (1,), np.float32)
        self.observation_space = spaces.Dict(
            {"pixels": seen["images"], "agent_pos": seen["state"], "vap_step": count}
        )
        self.action_space = self.inner.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        row = self.rows[
            (int(self.np_random.integers(len(self.rows))) if seed is None else seed)
            % len(self.rows)
        ]
        self.task_description = row.instruction
        seen, info = self.inner.reset(options={"row": row})
        return _shaped(seen, 0), {**info, "is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        seen, reward, terminated, truncated, info = self.inner.step(action)
        return (
            _shaped(seen, info["steps"]),
            reward,
            terminated,
            truncated,
            {**info, "is_success": bool(info["success"])},
        )

    def render(self) -> Rgb | None:
        return self.inner.render()

    def close(self) -> None:
        self.inner.close()


@EnvConfig.register_subclass("vap")
@dataclass
class VapEnvConfig(EnvConfig):
    """`--env.type=vap --env.task=SUITE/TASK`, or SUITE alone for all its tasks."""

    task: str | None = "simpler-bridge/put-camera"
    image_size: int = 224
    robots: str = "plain"
    max_steps: int | None = None

    def __post_init__(self) -> None:
        name, *task = (self.task or "").split("/")
        self.suite = suites.suite(name)
        self.tasks = tuple(self.suite.task(one).name for one in task) or tuple(
            one.name for one in self.suite.tasks
        )
        self.fps = round(self.suite.hz)
        inner = VapEnv(name, self.tasks[0], self.image_size, self.robots)  # type: ignore[arg-type]
        state, side = inner.observation_space["state"].shape, self.image_size  # type: ignore[index]
        self.features = {
            "action": PolicyFeature(FeatureType.ACTION, inner.action_space.shape or ())
        }
        self.features |= {
            f"pixels/{name}": PolicyFeature(FeatureType.VISUAL, (side, side, 3))
            for name in self.suite.cameras
        }
        self.features["agent_pos"] = PolicyFeature(FeatureType.STATE, state)
        self.features_map = {"action": "action", "agent_pos": "observation.state"}
        self.features_map |= {f"pixels/{name}": IMAGES + name for name in self.suite.cameras}
        inner.close()

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"image_size": self.image_size, "robots": self.robots, "max_steps": self.max_steps}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, VectorEnv]]:
        """One vector environment per task; an environment whose episode is over stands still, as in lerobot's own."""
        return {
            self.suite.name: {
                i: self._vector(task, n_envs, use_async_envs) for i, task in enumerate(self.tasks)
            }
        }

    def _vector(self, task: str, n_envs: int, use_async_envs: bool) -> Any:
        make: list[Callable[[], gymnasium.Env]] = [
            lambda: LeRobotEnv(self.suite.name, task, **self.gym_kwargs)
        ] * n_envs
        if use_async_envs and n_envs > 1:
            return _LazyAsyncVectorEnv(make)
        return SyncVectorEnv(
            [freeze_after_episode_end(one) for one in make], autoreset_mode=AutoresetMode.NEXT_STEP
        )


def _shaped(seen: Mapping[str, Any], step: int) -> dict[str, Any]:
    return {
        "pixels": seen["images"],
        "agent_pos": seen["state"],
        "vap_step": np.array([step], np.float32),
    }


def _pixels(images: torch.Tensor) -> np.ndarray:
    """lerobot's floats in 0..1, B x C x H x W, as the RGB bytes that they were."""
    return np.ascontiguousarray(
        (images.detach().cpu().float() * 255)
        .round()
        .clamp(0, 255)
        .to(torch.uint8)
        .permute(0, 2, 3, 1)
        .numpy()
    )
