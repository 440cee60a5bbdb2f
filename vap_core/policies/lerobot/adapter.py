"""Any policy that lerobot can load, as one of ours: frozen, asked for whole batches at once, deaf to every random stream but its episode's.

    policy = load("path/to/checkpoint")        # or owner/name, already downloaded
    Trial("generic", scene, policy, ...)

A checkpoint is a folder as lerobot writes it: config.json, model.safetensors, and the two processor pipelines with their statistics. It comes
from outside: it is parsed, never executed, and nothing runs with weights that are not exactly those of the file.
"""

import copy
import hashlib
import inspect
import io
import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
import torch
from jaxtyping import Float32

from vap_core.base.errors import BadPolicy
from vap_core.base.types import value
from vap_core.policies.hooks import (
    TEXT,
    attention_observed,
    inputs_observed,
    report_attention,
    report_input,
)
from vap_core.policies.lerobot.checkpoints import (
    PIPELINES,
    WEIGHTS,
    fingerprint,
    foundations,
    locate,
    refuse_code,
)
from vap_core.policies.protocol import Chunk, PolicyInput
from vap_core.simulation.env import Env
from vap_core.simulation.scenes import Scene
from vap_core.simulation.suites import Suite

if TYPE_CHECKING:
    from lerobot.policies.pretrained import PreTrainedPolicy

STATE, IMAGE, EMPTY = "observation.state", "observation.images.", "observation.images.empty_camera"
TOKENS, READ = "observation.language.tokens", "observation.language.attention_mask"
"""lerobot's feature keys; a checkpoint fills its empty cameras itself."""
DRAWS_NOTHING = ("act",)
"""Policies whose chunk is a function of what they see."""


@value
class LeRobotState:
    """Memory of one episode: the seed of its sampling noise, and, of a policy that remembers what it saw, a copy that shares the weights."""

    seed: int
    own: Any

    def __deepcopy__(self, memo: Any) -> "LeRobotState":
        return LeRobotState(self.seed, None if self.own is None else _own(self.own))


class LeRobot:
    """A lerobot policy between its own processors; see `load`.

    One batch asks for the chunks of many episodes where the policy can be told its sampling noise or draws none; the noise of an episode is
    the same at every call, so that it does not dither between modes. Every other policy (one that looks back, or ensembles over time) is asked
    for one action a step through its own queues, a copy per episode, under that episode's seed.
    """

    def __init__(
        self,
        policy: "PreTrainedPolicy",
        preprocessor: Any,
        postprocessor: Any,
        label: str = "lerobot",
    ) -> None:
        config: Any = policy.config
        self.policy = policy.eval().requires_grad_(False)
        self.preprocessor = preprocessor
        self.postprocessor = postprocessor
        self.label = label
        sampler = getattr(getattr(policy, "model", None), "sample_actions", None)
        self.noisy = sampler is not None and "noise" in inspect.signature(sampler).parameters
        plain = config.n_obs_steps == 1 and getattr(config, "temporal_ensemble_coeff", None) is None
        self.batched = plain and (self.noisy or config.type in DRAWS_NOTHING)
        self.execute = int(config.n_action_steps) if self.batched else 1
        self.action_size = int(config.action_feature.shape[0])
        self.renamed = {
            new: old
            for step in preprocessor.steps
            for old, new in getattr(step, "rename_map", {}).items()
        }
        self.wanted: dict[str, tuple[int, ...]] = {
            self.renamed.get(key, key): tuple(feature.shape)
            for key, feature in config.input_features.items()
            if not key.startswith(EMPTY)
        }
        """Shape of every feature that the checkpoint reads, under the key that its preprocessor expects."""
        self.learned: dict[int, torch.Tensor] = {}
        self.attends = self.batched and hasattr(
            getattr(policy, "model", None), "paligemma_with_expert"
        )
        """Whether it tells where it looks (module hooks)."""

    def with_tokens(self, words: Mapping[str, Float32[np.ndarray, " d"]]) -> "LeRobot":
        """The same frozen policy, to whom some reserved words mean learned embeddings; its own table stays as it is. Raises: BadPolicy."""
        known, out = (
            {word: i for i, word in enumerate(getattr(self.policy.config, "words", ()))},
            copy.copy(self),
        )
        if missing := [word for word in words if word not in known]:
            raise BadPolicy(
                f"LeRobot: {self.label} has no word {missing[0]}; learned words need a mini-pi0, which reserves some for them."
            )
        out.learned = {
            known[word]: torch.from_numpy(embedding) for word, embedding in words.items()
        }
        return out

    def with_execute(self, actions: int) -> "LeRobot":
        """The same policy, asked again after so many actions of each chunk. Raises: BadPolicy."""
        longest, out = (
            int(getattr(self.policy.config, "chunk_size", 1)) if self.batched else 1,
            copy.copy(self),
        )
        if not 1 <= actions <= longest:
            raise BadPolicy(
                f"LeRobot: {self.label} decides on {longest} actions at a time; ask for 1 to {longest} of them."
            )
        out.execute, out.label = actions, f"{self.label}, {actions} of {longest}"
        return out

    def start(self, rng: np.random.Generator) -> LeRobotState:
        seed = int(rng.integers(2**63 - 1))
        if self.batched:
            return LeRobotState(seed, None)
        own = _own(self.policy)
        own.reset()
        return LeRobotState(seed, own)

    @torch.inference_mode()
    def plan(
        self, states: Sequence[LeRobotState], inputs: Sequence[PolicyInput]
    ) -> tuple[list[LeRobotState], list[Chunk]]:
        """The next chunk of every episode, un-normalised by the checkpoint's own postprocessor. Raises: BadPolicy when the inputs do not fit."""
        if self.batched:
            batch = self.preprocessor(self._observation(inputs))
            self._report_inputs(batch, range(len(inputs)))
            noise = {"noise": self._noise(states)} if self.noisy else {}
            with self._overriding_tokens(), self._reporting_attention():
                actions = self.postprocessor(
                    self.policy.predict_action_chunk(batch, **noise)[:, : self.execute]
                )
            return list(states), [chunk.float().cpu().numpy() for chunk in actions]
        return list(states), [
            self._step(i, state, seen)
            for i, (state, seen) in enumerate(zip(states, inputs, strict=True))
        ]

    def check(self, cameras: Sequence[str], state_size: int, action_size: int) -> None:
        """Raises: BadPolicy, unless the checkpoint reads no more than these cameras and this state, and its actions have this length."""
        there = {**{IMAGE + name: () for name in cameras}, STATE: (state_size,)}
        if any(
            key not in there or (key == STATE and shape != there[key])
            for key, shape in self.wanted.items()
        ):
            raise BadPolicy(
                f"LeRobot: {self.label} wants {_listed(self.wanted)}; there is {_listed(there)}. Take a policy that was trained on these, or map the "
                f"names by rename_map in its {PIPELINES[0]}."
            )
        if self.action_size != action_size:
            raise BadPolicy(
                f"LeRobot: the actions of {self.label} have {self.action_size} numbers, the suite takes {action_size}; take a policy trained for it."
            )

    def sha256(self) -> str:
        """Checksum of all parameters and buffers as they stand."""
        found = hashlib.sha256()
        for name, tensor in sorted(self.policy.state_dict().items()):
            found.update(
                name.encode()
                + tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
            )
        return found.hexdigest()

    def _observation(self, inputs: Sequence[PolicyInput]) -> dict[str, Any]:
        """What lerobot's loop would hand to the preprocessor: float images in 0..1, B x C x H x W."""
        self.check(list(inputs[0].images), len(inputs[0].state), self.action_size)
        out: dict[str, Any] = {"task": [seen.text for seen in inputs]}
        for key, shape in self.wanted.items():
            if key == STATE:
                out[key] = torch.from_numpy(np.stack([seen.state for seen in inputs]))
            else:
                rgb = np.stack([seen.images[key.removeprefix(IMAGE)] for seen in inputs])
                out[key] = _sized(torch.from_numpy(rgb).permute(0, 3, 1, 2).float() / 255, shape)
        return out

    def _report_inputs(self, batch: dict[str, Any], episodes: Sequence[int]) -> None:
        """What stands in the tensors that the policy is about to read, one row per episode; of its tokens those that do not pad a shorter text."""
        if not inputs_observed():
            return
        for key, tensor in batch.items():
            if key == TOKENS:
                name, rows = (
                    TEXT,
                    [row[read] for row, read in zip(tensor, batch[READ], strict=True)],
                )
            elif key.startswith(IMAGE):
                name, rows = self.renamed.get(key, key).removeprefix(IMAGE), list(tensor)
            else:
                continue
            for episode, row in zip(episodes, rows, strict=True):
                report_input(episode, name, row.float().cpu().numpy())

    @contextmanager
    def _overriding_tokens(self) -> Iterator[None]:
        """Inside, the table of words answers learned words by what was learned."""
        if not self.learned:
            yield
            return

        def spoken(table: Any, asked: Any, found: torch.Tensor) -> torch.Tensor:
            for number, embedding in self.learned.items():
                found = torch.where((asked[0] == number)[..., None], embedding.to(found), found)
            return found

        towers: Any = self.policy.model
        hook = towers.paligemma_with_expert.paligemma.model.language_model.embed_tokens.register_forward_hook(
            spoken
        )
        try:
            yield
        finally:
            hook.remove()

    @contextmanager
    def _reporting_attention(self) -> Iterator[None]:
        """Inside, while somebody watches, the last layer of a pi0's action expert tells how its actions weigh image patches, in the mean over heads,
        actions and denoising steps."""
        if not self.attends or not attention_observed():
            yield
            return
        weights: list[torch.Tensor] = []
        policy: Any = self.policy
        config, towers = policy.config, policy.model.paligemma_with_expert
        last = towers.gemma_expert.model.layers[-1].self_attn
        hook = last.register_forward_hook(
            lambda module, args, out: weights.append(
                out[1][:, :, -config.chunk_size :].mean(dim=(1, 2))
            )
        )
        try:
            yield
        finally:
            hook.remove()
        side = config.image_resolution[0] // towers.paligemma.config.vision_config.patch_size
        cameras = [
            key for key in config.image_features if not key.startswith(EMPTY)
        ]  # lerobot puts empty ones behind them
        prefix = torch.stack(weights).mean(0)[:, : len(cameras) * side**2]
        heats = prefix.unflatten(1, (len(cameras), side, side)).float().cpu().numpy()
        for i, key in enumerate(cameras):
            for episode, heat in enumerate(heats[:, i]):
                report_attention(episode, self.renamed.get(key, key).removeprefix(IMAGE), heat)

    def _noise(self, states: Sequence[LeRobotState]) -> torch.Tensor:
        config: Any = self.policy.config
        shape = (config.chunk_size, config.max_action_dim)
        drawn = [
            torch.randn(shape, generator=torch.Generator().manual_seed(state.seed))
            for state in states
        ]
        return torch.stack(drawn).to(config.device)

    def _step(self, i: int, state: LeRobotState, seen: PolicyInput) -> Chunk:
        batch = self.preprocessor(self._observation([seen]))
        self._report_inputs(batch, [i])
        with torch.random.fork_rng():
            torch.manual_seed(state.seed)
            action = self.postprocessor(state.own.select_action(batch))
        return action.float().cpu().numpy()


def _own(policy: "PreTrainedPolicy") -> "PreTrainedPolicy":
    """A copy that shares weights and configuration, and keeps its own memory of what it saw."""
    own = copy.copy(policy)
    for name, held in vars(policy).items():
        if not name.startswith("_") and not isinstance(held, torch.nn.Module) and name != "config":
            setattr(own, name, copy.deepcopy(held))
    return own


def load(checkpoint: str | Path, device: str | None = None) -> LeRobot:
    """Load a checkpoint through lerobot's factory: a folder, or the `owner/name` of a model that was downloaded before.

    Raises: BadPolicy when it is not there, would execute code, cannot be built, or does not end with exactly the file's weights.
    """
    from lerobot import policies
    from lerobot.configs import PreTrainedConfig

    import_module(
        "vap_core.policies.mini_pi0.processor_mini_pi0"
    )  # registers our own type and its step
    folder = locate(checkpoint)
    refuse_code(folder)
    try:
        with (
            _silence(),
            patch("transformers.dynamic_module_utils.get_class_in_module", _no_code),
        ):  # some policies trust any repository
            config: Any = PreTrainedConfig.from_pretrained(folder)
            config.device = device or ("cuda" if torch.cuda.is_available() else "cpu")
            for name in (
                "pretrained_backbone_weights",
                "load_vlm_weights",
            ):  # the file's weights replace them
                if getattr(config, name, None):
                    setattr(config, name, None if name.startswith("pretrained") else False)
            policy = policies.factory.get_policy_class(config.type).from_pretrained(
                folder, config=config
            )
            moved = {"device_processor": {"device": config.device}}
            before, after = policies.make_pre_post_processors(
                config, str(folder), preprocessor_overrides=moved
            )
    except Exception as error:
        reason, mend = (
            str(error).strip().splitlines() or [""],
            "check its files, or save it again with lerobot 0.6",
        )
        if "huggingface.co" in str(error) and (names := foundations(folder)):
            mend = "get what it builds on: " + ", ".join(f"`hf download {name}`" for name in names)
        raise BadPolicy(
            f"load: {folder} cannot become a policy ({type(error).__name__}: {reason[0]:.200}); {mend}."
        ) from error
    with _silence():
        compare(policy, folder / WEIGHTS)
    return LeRobot(
        policy,
        before,
        after,
        f"{config.type}:{folder.name if Path(checkpoint).is_dir() else checkpoint}@{fingerprint(folder)[:8]}",
    )


def load_for_suite(checkpoint: str, scene: Scene, suite: Suite) -> LeRobot:
    """The checkpoint, loaded once in this process, whose inputs and actions are the suite's. Raises: BadPolicy."""
    policy, env = _load_cached(checkpoint), Env(scene, control=suite.control)
    policy.check(suite.cameras, len(env.state()), env.action_size)
    return policy


def compare(policy: "PreTrainedPolicy", file: Path) -> None:
    """Tensor for tensor, the policy's weights are the file's, cast to its precision. Raises: BadPolicy.

    lerobot's PI0 prints a failed load and goes on with random weights; other policies skip what they miss.
    """
    from safetensors import safe_open

    mine = policy.state_dict()
    with safe_open(file, "pt") as stored:
        names = list(stored.keys())
        rename = getattr(
            policy, "_fix_pytorch_state_dict_keys", lambda found, config: found
        )  # openpi's names
        known = {
            key: names[int(i)]
            for key, i in rename(
                {name: torch.tensor(i) for i, name in enumerate(names)}, policy.config
            ).items()
        }
        known = {key if key in mine else f"model.{key}": name for key, name in known.items()}
        same = {
            key: key in mine and torch.equal(stored.get_tensor(name).to(mine[key].dtype), mine[key].cpu())
            for key, name in known.items()
        }  # fmt: skip
    tied = {mine[key].data_ptr() for key, good in same.items() if good}
    bad = [key for key, good in same.items() if not good] + [
        key for key in mine if key not in same and mine[key].data_ptr() not in tied
    ]
    if bad:
        raise BadPolicy(
            f"load: {len(bad)} of {len(mine)} tensors differ from {file}, {bad[0]} for one; the file belongs to another architecture or size."
        )


_load_cached = cache(load)


def _sized(images: torch.Tensor, shape: tuple[int, ...]) -> torch.Tensor:
    """Scaled to the height and width that the checkpoint was trained on."""
    size = shape[-2:]
    return (
        images
        if images.shape[-2:] == size
        else torch.nn.functional.interpolate(images, size, mode="bilinear", antialias=True)
    )


def _listed(features: dict[str, tuple[int, ...]]) -> str:
    return (
        ", ".join(
            key + (f" ({shape[0]})" if len(shape) == 1 else "")
            for key, shape in sorted(features.items())
        )
        or "nothing"
    )


@contextmanager
def _silence() -> Iterator[None]:
    """Loading prints and logs a page; what matters of it is checked afterwards."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with redirect_stdout(io.StringIO()):
            yield
    finally:
        logging.disable(before)


def _no_code(*args: Any, **kwargs: Any) -> Any:
    raise BadPolicy(
        "its tokenizer or backbone is Python from the hub, which is never executed here"
    )
