"""VAP inside lerobot: a processor step for any of its policies, and our suites as an environment.

    ./vap attach CHECKPOINT personalised --memory data/memory
    lerobot-eval --policy.path=personalised --env.type=vap --env.task=simpler-bridge/put-camera \\
        --seed=0

`attach` links the frozen files, and adds one step to the preprocessor. The step tints every view
and rewrites the task before anything else reads them. It must know where an episode begins:
lerobot-eval never resets its pipelines, so our environments number their steps in the observation
`vap_step`; robot loops reset theirs before the first picture. Where neither says it, the step
refuses the picture (`episodes="auto"`). The distribution lerobot_env_vap (plugins/) lets lerobot's
commands find all this.
"""

import fnmatch
import json
import os
import shutil
from collections.abc import Mapping, Sequence
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
from vap_core.base.errors import BadMemory, BadOutput, BadPolicy, BadSuite, BadViews, one_of
from vap_core.base.files import parse_json
from vap_core.base.types import Rgb, Views
from vap_core.memory import load_bank
from vap_core.perception.stacks import check_stack, load_stack
from vap_core.policies.lerobot.checkpoints import (
    PIPELINES,
    STEP_CLASS,
    STEP_NAME,
    WANTED_FILES,
    deciding_files,
    is_vap_step,
    locate,
    refuse_code,
)
from vap_core.prompt import Tint
from vap_core.simulation import suites
from vap_core.simulation.gym_env import VapEnv, env_id

IMAGES = "observation.images."
STEP = "observation.vap_step"
SLACK = 1e-3
"""By how much a picture's numbers may lie outside 0..1."""
RENAMING_STEP = "rename_observations_processor"
"""The step of lerobot's preprocessors behind which the prompting step stands."""


@dataclass
class OngoingEpisode:
    """One environment's episode: its last step, what was given, the method's state, the result."""

    step: int
    given: tuple[Views, str]
    state: AttendState
    images: Views
    text: str


@ProcessorStepRegistry.register(name=STEP_NAME)
@dataclass
class VapPrompt(ProcessorStep):
    """Tints the remembered object in every `observation.images.*`, and rewrites `task`.

    Pictures are lerobot's: floats in 0..1, 3 x H x W or B x 3 x H x W. Those of one channel whose
    key says depth pass as they are; a colour picture of another name is refused.

    Views in which it is not seen pass bit for bit. `memory` is the folder of remembered objects,
    `objects` names those meant where the category alone does not decide, `speaker` is whom "my"
    means. `episodes` says how an
    episode's beginning is known: by `observation.vap_step` being 0, or by `reset()` (then of one
    environment only). With "auto" it is the former where that observation is there, else the
    latter in a loop that has called `reset()`.

    Raises: UnknownName for a stack, or a value of `episodes`, that there is not; BadMemory when
        `memory` is no folder.
    """

    memory: str
    stack: str = "embedded"
    objects: list[str] | None = None
    speaker: str = ""
    highlight: bool = True
    rewrite: bool = True
    alpha: float = 0.5
    episodes: Literal["auto", "vap_step", "reset"] = "auto"
    _attender: Attender | None = field(default=None, init=False, repr=False)
    _ongoing: dict[int, OngoingEpisode] = field(default_factory=dict, init=False, repr=False)
    _was_reset: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        check_stack(self.stack, "VapPrompt")
        if self.episodes not in ("auto", "vap_step", "reset"):
            raise one_of("VapPrompt: episodes", self.episodes, ("auto", "vap_step", "reset"))
        if not os.path.isdir(self.memory):
            raise BadMemory(
                f"VapPrompt: {self.memory} is no folder of remembered objects; register one, or "
                "attach again."
            )

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Prompt every view and the task of a batch.

        Raises: BadViews when a picture is none of lerobot's, or it cannot be known which episode it
            belongs to.
        """
        prompted = transition.copy()
        observation = dict(prompted.get(TransitionKey.OBSERVATION) or {})
        extra = dict(prompted.get(TransitionKey.COMPLEMENTARY_DATA) or {})
        if prompted.get(TransitionKey.ACTION) is not None:
            raise BadViews(
                "VapPrompt: this batch holds actions, so it is for training, and its frames are "
                "shuffled; train the plain checkpoint."
            )
        task = extra.get("task")
        views = _views(observation, is_batched=not isinstance(task, str))
        if not views or task is None:
            missing = "task" if views else f"{IMAGES}*"
            raise BadViews(
                f"VapPrompt: no {missing} among {sorted({*observation, *extra})}; give both."
            )
        texts = [task] if isinstance(task, str) else list(task)
        steps = self._steps(observation.pop(STEP, None), len(texts))
        tensors, texts = self._prompt(views, texts, steps)
        observation.update(tensors)
        extra["task"] = texts[0] if isinstance(task, str) else texts
        prompted[TransitionKey.OBSERVATION] = observation
        prompted[TransitionKey.COMPLEMENTARY_DATA] = extra
        return prompted

    def get_config(self) -> dict[str, Any]:
        return {option.name: getattr(self, option.name) for option in fields(self) if option.init}

    def reset(self) -> None:
        """The next pictures begin an episode."""
        self._ongoing.clear()
        self._was_reset = True

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features

    def _steps(self, signal: torch.Tensor | None, n: int) -> list[int]:
        """The step that every environment of the batch is at, 0 for a new episode."""
        given = [] if signal is None else signal.reshape(-1).tolist()
        for step in given:
            if not (step >= 0 and float(step).is_integer()):
                raise BadViews(
                    f"VapPrompt: {STEP} is {step:g}; give the whole number of steps since the "
                    "episode began (0 = new)."
                )
        numbered = list(map(int, given))
        if self.episodes == "vap_step" or (self.episodes == "auto" and numbered):
            if not numbered:
                raise BadViews(
                    f"VapPrompt: {STEP} is missing, so the start of an episode is not known; "
                    "let the environment give vap_step (0 = new), or attach with episodes='reset' "
                    "where the caller resets the preprocessor."
                )
            return numbered
        if n > 1:
            raise BadViews(
                f"VapPrompt: {n} environments, of which a reset of the preprocessor names none; "
                "let the environment give the observation vap_step (0 = new)."
            )
        if not self._was_reset:
            raise BadViews(
                "VapPrompt: this loop has not reset its preprocessor (lerobot-eval never does), so "
                "the start of an episode is not known; let the environment give the observation "
                "vap_step (0 = new)."
            )
        step = self._ongoing[0].step + 1 if self._ongoing else 0
        if numbered and (numbered[0] == 0) != (step == 0):
            raise BadViews(
                f"VapPrompt: episodes='reset', but the environment is at step {numbered[0]} where "
                f"the resets count {step}; attach with episodes='auto', which reads vap_step."
            )
        return [step]

    def _prompt(
        self, views: Mapping[str, torch.Tensor], texts: Sequence[str], steps: Sequence[int]
    ) -> tuple[dict[str, torch.Tensor], list[str]]:
        """The prompted views and texts, one per environment; pixels that stay are not touched."""
        pixels = {}
        prompted = {}
        for key, tensor in views.items():
            batch = tensor[None] if tensor.ndim == 3 else tensor
            if not len(batch) == len(texts) == len(steps):
                raise BadViews(
                    f"VapPrompt: {key} is of {len(batch)} environments, but there are {len(texts)} "
                    f"tasks and {len(steps)} steps; give one of each per environment."
                )
            # lerobot's floats in 0..1, B x C x H x W, as the RGB bytes that they were.
            levels = (batch.detach().cpu().float() * 255).round().clamp(0, 255).to(torch.uint8)
            rgb = np.ascontiguousarray(levels.permute(0, 2, 3, 1).numpy())
            pixels[key.removeprefix(IMAGES)] = rgb
            prompted[key] = tensor.clone()
        new_texts = []
        for i, (step, text) in enumerate(zip(steps, texts, strict=True)):
            images = {camera: rgb[i] for camera, rgb in pixels.items()}
            episode = self._follow(i, step, images, text)
            self._ongoing[i] = episode
            new_texts.append(episode.text)
            for camera, rgb in episode.images.items():
                batch = prompted[IMAGES + camera]
                tensor = batch if batch.ndim == 3 else batch[i]
                changed = torch.from_numpy((rgb != images[camera]).any(-1)).to(tensor.device)
                if not changed.any():
                    continue
                new = (torch.from_numpy(rgb).permute(2, 0, 1).float() / 255).to(tensor)
                tensor[:, changed] = new[:, changed]
        return prompted, new_texts

    def _follow(self, i: int, step: int, images: Views, text: str) -> OngoingEpisode:
        """The episode of environment `i` after its next images."""
        episode, fault = self._ongoing.get(i), ""
        if step == 0:
            state, attended = self._load().start(images, text, objects=self.objects)
        elif episode is None or step not in (episode.step, episode.step + 1):
            last = "nothing" if episode is None else episode.step
            fault = f"is at step {step} after {last}; give every picture, in order"
        elif text != episode.given[1]:
            fault = (
                f"has the task {text!r} at step {step}, and had {episode.given[1]!r}; begin an "
                "episode with it, and let one step serve one task at a time"
            )
        elif images.keys() != episode.given[0].keys():
            fault = (
                f"has views of {sorted(images)}, but the episode started with "
                f"{sorted(episode.given[0])}; give the same cameras"
            )
        elif step == episode.step:
            if not any((rgb != episode.given[0][camera]).any() for camera, rgb in images.items()):
                return episode  # it is over, and stands still until the others are done
            fault = (
                f"is at step {step} twice, with another picture; number its steps, and let one "
                "step serve one environment"
            )
        else:
            state, attended = self._load().step(episode.state, images)
        if fault:
            raise BadViews(f"VapPrompt: environment {i} {fault}.")
        return OngoingEpisode(step, (images, text), state, attended.images, attended.text)

    def _load(self) -> Attender:
        if self._attender is None:
            stack = load_stack(self.stack)
            memory = load_bank(Path(self.memory), stack.encoder.name)
            how = Prompting(form=Tint(self.alpha), highlight=self.highlight, rewrite=self.rewrite)
            self._attender = Attender(stack, memory, how, speaker=self.speaker)
        return self._attender


def attach(checkpoint: str | Path, out: Path, memory: Path, **options: Any) -> Path:
    """Write a checkpoint with VAP beside the frozen one; returns its folder.

    Its files are linked, but for those of other kinds than a checkpoint's. One step is added to the
    preprocessor, right after the renaming of observations. `options` are VapPrompt's other fields.
    The stack is loaded once, to see that it can be, and that its encoder made the memory.

    Raises: BadOutput when `out` exists; BadPolicy, BadMemory, UnknownName when the parts do not
        fit; BadMemory also where `memory` holds no object, or a damaged one; as `load_stack`.
    """
    source = locate(checkpoint).resolve()
    memory = Path(memory).resolve()
    step = VapPrompt(str(memory), **options)
    bank = load_bank(memory, caller="attach")
    for name in step.objects or ():
        if name not in bank:
            raise one_of("attach: object", name, bank)
    if out.exists():
        raise BadOutput(f"attach: {out} exists; choose another folder.")
    file = source / PIPELINES[0]
    try:
        pipeline = parse_json(file.read_text())
        # Behind the renaming of observations, else first.
        names = [step.get("registry_name") for step in pipeline["steps"]]
        place = names.index(RENAMING_STEP) + 1 if RENAMING_STEP in names else 0
        attached = any(map(is_vap_step, pipeline["steps"]))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadPolicy(
            f"attach: {file} is no processor pipeline ({type(error).__name__}); save it again with "
            "lerobot 0.6."
        ) from error
    if attached:
        raise BadPolicy(f"attach: {source} has VAP attached; give the checkpoint without it.")
    refuse_code(source)
    step._load()  # what would fail at the first picture fails here
    pipeline["steps"].insert(place, {"class": STEP_CLASS, "config": step.get_config()})
    made = False
    try:
        out.mkdir(parents=True)
        made = True
        beside = [file.name for file in source.iterdir() if file.is_file()]
        wanted = [Path(name) for kind in WANTED_FILES for name in fnmatch.filter(beside, kind)]
        for part in {*wanted, *deciding_files(source)} - {Path(PIPELINES[0])}:
            (out / part).parent.mkdir(parents=True, exist_ok=True)
            os.symlink(source / part, out / part)
        (out / PIPELINES[0]).write_text(json.dumps(pipeline, indent=2))
    except OSError as error:
        if made:
            shutil.rmtree(out, ignore_errors=True)
        raise BadOutput(
            f"attach: {out} cannot be written ({error.strerror}); choose another folder."
        ) from error
    return out


class LeRobotEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """One task in lerobot's shape: pixels by camera, `agent_pos`, and `vap_step`.

    `vap_step` is the number of steps since the episode began. Seed s starts episode s of the task's
    list, modulo its length, exactly as our own rollout does; `max_steps` shortens it.

    Raises: as VapEnv; BadSuite for `max_steps` below 1.
    """

    def __init__(
        self,
        suite: str,
        task: str,
        image_size: int = 224,
        robots: str = "plain",
        max_steps: int | None = None,
    ) -> None:
        _check_max_steps(max_steps)
        self.inner = VapEnv(suite, task, image_size, robots, render_mode="rgb_array")
        self.render_mode = "rgb_array"
        self.metadata = {**self.inner.metadata, "render_fps": round(self.inner.suite.hz)}
        self.rows = [
            row if max_steps is None else replace(row, max_steps=min(row.max_steps, max_steps))
            for row in self.inner.rows
        ]
        self.task = env_id(suite, task)
        self.task_description = self.rows[0].instruction
        self._max_episode_steps = max(row.max_steps for row in self.rows)
        inner_space = self.inner.observation_space
        assert isinstance(inner_space, spaces.Dict)
        self.observation_space = spaces.Dict(
            {
                "pixels": inner_space["images"],
                "agent_pos": inner_space["state"],
                "vap_step": spaces.Box(0, np.inf, (1,), np.float32),
            }
        )
        self.action_space = self.inner.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        number = int(self.np_random.integers(len(self.rows))) if seed is None else seed
        row = self.rows[number % len(self.rows)]
        self.task_description = row.instruction
        observation, info = self.inner.reset(options={"row": row})
        return _lerobot_observation(observation, 0), {**info, "is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.inner.step(action)
        shaped = _lerobot_observation(observation, info["steps"])
        info = {**info, "is_success": bool(info["success"])}
        return shaped, reward, terminated, truncated, info

    def render(self) -> Rgb | None:
        return self.inner.render()

    def close(self) -> None:
        self.inner.close()


@EnvConfig.register_subclass("vap")
@dataclass
class VapEnvConfig(EnvConfig):
    """`--env.type=vap --env.task=SUITE/TASK`, or SUITE alone for all its tasks.

    Raises: as LeRobotEnv.
    """

    task: str | None = "simpler-bridge/put-camera"
    image_size: int = 224
    robots: str = "plain"
    max_steps: int | None = None

    def __post_init__(self) -> None:
        _check_max_steps(self.max_steps)
        suite_name, *task_names = (self.task or "").split("/")
        self.suite = suites.suite(suite_name)
        tasks = tuple(map(self.suite.task, task_names)) or self.suite.tasks
        self.tasks = tuple(task.name for task in tasks)
        self.fps = round(self.suite.hz)
        inner = VapEnv(suite_name, self.tasks[0], self.image_size, self.robots)
        state_shape = inner.observation_space["state"].shape  # type: ignore[index]
        action_shape = inner.action_space.shape or ()
        image_shape = (self.image_size, self.image_size, 3)
        self.features = {"action": PolicyFeature(FeatureType.ACTION, action_shape)}
        self.features_map = {"action": "action", "agent_pos": "observation.state"}
        for camera in self.suite.cameras:
            self.features[f"pixels/{camera}"] = PolicyFeature(FeatureType.VISUAL, image_shape)
            self.features_map[f"pixels/{camera}"] = IMAGES + camera
        self.features["agent_pos"] = PolicyFeature(FeatureType.STATE, state_shape)
        inner.close()

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"image_size": self.image_size, "robots": self.robots, "max_steps": self.max_steps}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, VectorEnv]]:
        """One vector environment per task.

        An environment whose episode is over stands still, as in lerobot's own.
        """
        tasks = enumerate(self.tasks)
        return {
            self.suite.name: {
                i: self._vector_env(task, n_envs, use_async_envs) for i, task in tasks
            }
        }

    def _vector_env(self, task: str, n_envs: int, use_async_envs: bool) -> Any:
        def make_env() -> gymnasium.Env:
            return LeRobotEnv(self.suite.name, task, **self.gym_kwargs)

        makers = [make_env] * n_envs
        if use_async_envs and n_envs > 1:
            return _LazyAsyncVectorEnv(makers)
        makers = list(map(freeze_after_episode_end, makers))
        return SyncVectorEnv(makers, autoreset_mode=AutoresetMode.NEXT_STEP)


def _views(observation: Mapping[str, Any], is_batched: bool) -> dict[str, torch.Tensor]:
    """The images of an observation, by their key; those of depth are left out.

    Raises: BadViews: one is not as lerobot's pictures are, or a colour picture has a name under
        which it would not be prompted.
    """
    views = {}
    for key, picture in observation.items():
        shape = tuple(np.shape(picture)) if hasattr(picture, "shape") else ()
        if not key.startswith(IMAGES):
            # The last states of three environments have three dimensions, too, so that a picture
            # of a batch has four.
            if (len(shape) == 4 or (len(shape) == 3 and not is_batched)) and (
                shape[-3] == 3 or ("image" in key and shape[-1] == 3)
            ):
                raise BadViews(
                    f"VapPrompt: {key} is a colour picture, and {IMAGES}* alone are prompted; map "
                    f"its name to {IMAGES}... by rename_map in the checkpoint's {PIPELINES[0]}, or "
                    "leave it out."
                )
            continue
        if "depth" in key and shape[-3:-2] == (1,):
            continue
        fits = isinstance(picture, torch.Tensor) and picture.is_floating_point()
        if not fits or len(shape) not in (3, 4) or shape[-3] != 3 or not picture.numel():
            kind = f"{type(picture).__name__} {getattr(picture, 'dtype', '')}".strip()
            raise BadViews(
                f"VapPrompt: {key} is {kind} of {tuple(np.shape(picture))}; give a tensor of "
                "floats in 0..1, 3 x height x width, or a batch of them."
            )
        if not torch.isfinite(picture).all():
            raise BadViews(
                f"VapPrompt: {key} has numbers that are not finite; mend the camera, or skip the "
                "frame."
            )
        low, high = picture.min().item(), picture.max().item()
        if low < -SLACK or high > 1 + SLACK:
            raise BadViews(
                f"VapPrompt: {key} has numbers from {low:g} to {high:g}; give floats in 0..1, and "
                "let the normaliser come after this step."
            )
        views[key] = picture
    return views


def _check_max_steps(max_steps: int | None) -> None:
    """Raises: BadSuite: no episode has so few steps."""
    if max_steps is not None and max_steps < 1:
        raise BadSuite(
            f"VapEnvConfig: max_steps is {max_steps}; give 1 or more, or leave it out for the "
            "suite's own limit."
        )


def _lerobot_observation(observation: Mapping[str, Any], step: int) -> dict[str, Any]:
    """An observation of our environment under lerobot's names."""
    return {
        "pixels": observation["images"],
        "agent_pos": observation["state"],
        "vap_step": np.array([step], np.float32),
    }
