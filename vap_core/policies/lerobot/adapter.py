"""Any policy that lerobot can load, as one of ours, with frozen weights and in batches.

    policy = load_policy("path/to/checkpoint")        # or owner/name, already downloaded
    Trial("generic", scene, policy, ...)

A checkpoint is a folder as lerobot writes it: config.json, model.safetensors, and the two processor
pipelines with their statistics. It comes from outside: it is parsed, never executed, and nothing
runs with weights that are not exactly those of the file. No random stream but that of its episode
has an effect on a chunk.
"""

import copy
import inspect
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float32

from vap_core.base.errors import BadPolicy
from vap_core.base.types import value
from vap_core.environments import AnyScene, open_env
from vap_core.policies.lerobot.checkpoints import PIPELINES, locate, stamp
from vap_core.policies.lerobot.hooks import (
    can_watch,
    overriding_tokens,
    positions,
    reporting_attention,
    word_width,
)
from vap_core.policies.lerobot.loading import EMPTY, build
from vap_core.policies.lerobot.traced import ChunkPredictor
from vap_core.policies.names import label_of
from vap_core.policies.protocol import (
    TEXT,
    Chunk,
    PolicyInput,
    attention_observed,
    inputs_observed,
    phrases_of,
    report_input,
    state_sha256,
)
from vap_core.simulation.suites import Suite

if TYPE_CHECKING:
    from lerobot.policies.pretrained import PreTrainedPolicy

STATE = "observation.state"
IMAGE = "observation.images."
TOKENS = "observation.language.tokens"
TOKEN_MASK = "observation.language.attention_mask"
"""lerobot's feature keys."""
DRAWS_NOTHING = ("act",)
"""Policies whose chunk is a function of the observation alone."""
OF_MODULES = frozenset(vars(torch.nn.Module()))
"""Where torch keeps the weights and hooks of every module."""
Shapes = dict[str, tuple[int, ...]]
"""The shape of every feature, by its key."""


@value
class LeRobotState:
    """Memory of one episode: the seed of its sampling noise, and a copy of the policy.

    `own` is the copy, which shares the weights, of a policy that remembers observations; else None.
    """

    seed: int
    own: Any

    def __deepcopy__(self, memo: Any) -> "LeRobotState":
        if self.own is None:
            return LeRobotState(self.seed, None)
        return LeRobotState(self.seed, _copy_policy(self.own))


class LeRobot:
    """A lerobot policy between its own processors; see `load`.

    One batch asks for the chunks of many episodes where the policy takes its sampling noise as an
    argument, or draws none; the noise of an episode is the same at every call, so that the chunks
    do not alternate between modes. Every other policy (one that looks back, or ensembles over time)
    is asked for one action a step through its own queues, a copy per episode, under that episode's
    seed.
    """

    def __init__(
        self,
        policy: "PreTrainedPolicy",
        preprocessor: Any,
        postprocessor: Any,
        label: str = "lerobot",
    ) -> None:
        config = policy.config
        self.policy = policy.eval().requires_grad_(False)
        self.preprocessor = preprocessor
        self.postprocessor = postprocessor
        self.label = label
        # Whether the sampling noise is an argument of the policy's model.
        sampler = getattr(getattr(policy, "model", None), "sample_actions", None)
        self.noisy = sampler is not None and "noise" in inspect.signature(sampler).parameters
        remembers = config.n_obs_steps != 1
        ensembles = getattr(config, "temporal_ensemble_coeff", None) is not None
        draws_nothing = config.type in DRAWS_NOTHING
        self.batched = not remembers and not ensembles and (self.noisy or draws_nothing)
        self.execute = int(config.n_action_steps) if self.batched else 1
        self.action_size = int(config.action_feature.shape[0])
        maps = [getattr(step, "rename_map", {}) for step in preprocessor.steps]
        self.renamed = {new: old for names in maps for old, new in names.items()}
        """The key that the preprocessor expects, by the key to which it renames it."""
        self.wanted: Shapes = {
            self.renamed.get(key, key): tuple(feature.shape)
            for key, feature in config.input_features.items()
            if not key.startswith(EMPTY)
        }
        """Shape of every feature that is read, under the key that the preprocessor expects."""
        self.learned: dict[int, torch.Tensor] = {}
        """The learned embedding of a word, by its token."""
        self.attends = self.batched and can_watch(policy, ())
        """Whether it reports its attention to square pictures."""
        self.predict = ChunkPredictor(policy, label)

    def with_tokens(self, words: Mapping[str, Float32[np.ndarray, " d"]]) -> "LeRobot":
        """The same frozen policy, in which some reserved words have learned embeddings.

        Its own table of embeddings stays as it is.

        Raises: BadPolicy for a word that the vocabulary does not have, or an embedding of another
            width than its words'.
        """
        tokens = {word: i for i, word in enumerate(getattr(self.policy.config, "words", ()))}
        learned = {}
        for word, embedding in words.items():
            if word not in tokens:
                raise BadPolicy(
                    f"LeRobot: {self.label} has no word {word}; learned words need a mini-pi0, "
                    "which reserves some for them."
                )
            width = word_width(self.policy)
            if len(embedding) != width:
                raise BadPolicy(
                    f"LeRobot: the embedding of {word} has {len(embedding)} numbers, and those of "
                    f"{self.label} have {width}; learn the word in the model that it grew from."
                )
            learned[tokens[word]] = torch.from_numpy(embedding)
        policy = copy.copy(self)
        policy.learned = learned
        return policy

    def with_execute(self, actions: int) -> "LeRobot":
        """The same policy, asked again after so many actions of each chunk. Raises: BadPolicy."""
        longest = int(getattr(self.policy.config, "chunk_size", 1)) if self.batched else 1
        if not 1 <= actions <= longest:
            raise BadPolicy(
                f"LeRobot: {self.label} decides on {longest} actions at a time; ask for 1 to "
                f"{longest} of them."
            )
        policy = copy.copy(self)
        policy.execute = actions
        policy.label = f"{self.label}, {actions} of {longest}"
        return policy

    def start(self, rng: np.random.Generator) -> LeRobotState:
        seed = int(rng.integers(2**63 - 1))
        if self.batched:
            return LeRobotState(seed, None)
        own = _copy_policy(self.policy)
        own.reset()
        return LeRobotState(seed, own)

    @torch.inference_mode()
    def plan(
        self, states: Sequence[LeRobotState], inputs: Sequence[PolicyInput]
    ) -> tuple[list[LeRobotState], list[Chunk]]:
        """The next chunk of every episode, un-normalised by the checkpoint's postprocessor.

        Raises: BadPolicy when the inputs do not fit.
        """
        if self.batched:
            batch, noise = self.prepare(states, inputs)
            self._report_inputs(batch, range(len(inputs)))
            with overriding_tokens(self.policy, self.learned), self._watching(batch):
                planned = self.predict(batch, noise)
            actions = self.postprocessor(planned[:, : self.execute])
            return list(states), list(actions.float().cpu().numpy())
        self.predict.stay_eager("it has a memory, which is no input of its calls")
        # Copies remember this call, so that one that fails can be made again.
        after = copy.deepcopy(list(states))
        chunks: list[Chunk] = []
        for i, (state, policy_input) in enumerate(zip(after, inputs, strict=True)):
            batch = self.preprocessor(self._observation([policy_input]))
            self._report_inputs(batch, [i])
            with torch.random.fork_rng():
                torch.manual_seed(state.seed)
                action = self.postprocessor(state.own.select_action(batch))
            chunks.append(action.float().cpu().numpy())
        return after, chunks

    def check(self, cameras: Sequence[str], state_size: int, action_size: int) -> None:
        """Check that the checkpoint fits these cameras and these sizes.

        Raises: BadPolicy when it reads another camera or another state, or when its actions have
            another length.
        """
        available: Shapes = {STATE: (state_size,)} | {IMAGE + camera: () for camera in cameras}
        for key, shape in self.wanted.items():
            if key not in available or (key == STATE and shape != available[key]):
                raise BadPolicy(
                    f"LeRobot: {self.label} wants {_format_shapes(self.wanted)}; there is "
                    f"{_format_shapes(available)}. Take a policy that was trained on these, or map "
                    f"the names by rename_map in its {PIPELINES[0]}."
                )
        if self.action_size != action_size:
            raise BadPolicy(
                f"LeRobot: the actions of {self.label} have {self.action_size} numbers, the suite "
                f"takes {action_size}; take a policy trained for it."
            )

    def cameras(self) -> list[str]:
        """The names of our cameras, in the order in which the policy reads them."""
        config = self.policy.config
        return [self._camera(key) for key in config.image_features if not key.startswith(EMPTY)]

    def prepare(
        self, states: Sequence[LeRobotState], inputs: Sequence[PolicyInput]
    ) -> tuple[dict[str, Any], torch.Tensor | None]:
        """The preprocessed batch of some episodes, and their sampling noise if it takes any.

        Raises: BadPolicy when the inputs do not fit.
        """
        batch = self.preprocessor(self._observation(inputs))
        return batch, self._noise(states) if self.noisy else None

    def sha256(self) -> str:
        """Checksum of all parameters and buffers as they stand."""
        return state_sha256(self.policy)

    def _watching(self, batch: dict[str, Any]) -> AbstractContextManager[None]:
        """Reports the attention of a call where somebody observes it."""
        config = self.policy.config
        pictures = [batch[key] for key in config.image_features if key in batch]
        if not (self.attends and attention_observed() and can_watch(self.policy, pictures)):
            return nullcontext()
        places = [
            positions(self.preprocessor, tokens, phrases_of(episode))
            for episode, tokens in enumerate(batch[TOKENS])
        ]
        side_px = pictures[0].shape[-1]
        return reporting_attention(self.policy, self.cameras(), side_px, places)

    def _observation(self, inputs: Sequence[PolicyInput]) -> dict[str, Any]:
        """What lerobot's loop would hand to the preprocessor, equal to the bit.

        Every camera's images as they are, floats in 0..1, B x C x H x W: a policy that wants
        another size scales or pads them itself. The state, whether or not it is declared.
        """
        self.check(list(inputs[0].images), len(inputs[0].state), self.action_size)
        observation: dict[str, Any] = {"task": [policy_input.text for policy_input in inputs]}
        for camera in inputs[0].images:
            rgb = np.stack([policy_input.images[camera] for policy_input in inputs])
            images = torch.from_numpy(rgb).permute(0, 3, 1, 2).contiguous()
            observation[IMAGE + camera] = images.float() / 255
        observation[STATE] = torch.from_numpy(np.stack([each.state for each in inputs]))
        return observation

    def _report_inputs(self, batch: dict[str, Any], episodes: Sequence[int]) -> None:
        """Report the tensors that the policy is about to read, one row per episode.

        Of its tokens those that pad a shorter text are left out.
        """
        if not inputs_observed():
            return
        for key, tensor in batch.items():
            if key == TOKENS:
                name = TEXT
                rows = [
                    tokens[mask] for tokens, mask in zip(tensor, batch[TOKEN_MASK], strict=True)
                ]
            elif key.startswith(IMAGE) and key in self.policy.config.input_features:
                name = self._camera(key)
                rows = list(tensor)
            else:
                continue
            for episode, row in zip(episodes, rows, strict=True):
                report_input(episode, name, row.float().cpu().numpy())

    def _camera(self, key: str) -> str:
        """The name of our camera whose image the checkpoint reads under `key`."""
        return self.renamed.get(key, key).removeprefix(IMAGE)

    def _noise(self, states: Sequence[LeRobotState]) -> torch.Tensor:
        config = self.policy.config
        shape = (config.chunk_size, config.max_action_dim)
        seeded = [torch.Generator().manual_seed(state.seed) for state in states]
        noise = [torch.randn(shape, generator=generator) for generator in seeded]
        return torch.stack(noise).to(config.device)


def load_policy(
    checkpoint: str | Path, device: str | None = None, temperature: float | None = None
) -> LeRobot:
    """Load a checkpoint through lerobot's factory.

    `checkpoint` is a folder, or the `owner/name` of a model that was downloaded before.
    `temperature` scales a mini-pi0's sampling noise, instead of the checkpoint's own.

    Raises: BadPolicy when it is not there, would execute code, cannot be built, lacks statistics
        that it scales by, does not end with exactly the file's weights, or has no temperature to
        set.
    """
    policy, preprocessor, postprocessor = build(locate(checkpoint), device)
    if temperature is not None:
        config = policy.config
        if not hasattr(config, "temperature"):
            raise BadPolicy(
                f"load: {checkpoint} has no temperature; leave it out, or take a mini-pi0, whose "
                "sampling noise is scaled by one."
            )
        config.temperature = temperature
    return LeRobot(policy, preprocessor, postprocessor, label_of(checkpoint, temperature))


_loaded: dict[tuple[str, float | None], tuple[object, LeRobot]] = {}
"""The policies of this process by checkpoint and temperature, with the `stamp` of their files."""


def load_for_suite(
    checkpoint: str, scene: AnyScene, suite: Suite, temperature: float | None = None
) -> LeRobot:
    """The checkpoint, loaded once in this process, for the inputs and actions of a suite.

    It is loaded again where its files have changed since.

    Raises: BadPolicy, as `load_policy`, and when it does not fit them.
    """
    key = (checkpoint, temperature)
    now = stamp(checkpoint)
    if key in _loaded and _loaded[key][0] != now:
        # Two sets of weights may not fit into memory.
        del _loaded[key]
    if key not in _loaded:
        _loaded[key] = (now, load_policy(checkpoint, temperature=temperature))
    policy = _loaded[key][1]
    env = open_env(scene, scene.cameras, control=suite.control)
    policy.check(suite.cameras, len(env.state()), len(env.action_names))
    return policy


def _copy_policy(policy: "PreTrainedPolicy") -> "PreTrainedPolicy":
    """A copy that shares weights and configuration, and keeps its own memory of observations."""
    own = copy.copy(policy)
    for name, attribute in vars(policy).items():
        shared = name in OF_MODULES or name == "config" or isinstance(attribute, torch.nn.Module)
        if not shared:
            setattr(own, name, copy.deepcopy(attribute))
    return own


def _format_shapes(features: Shapes) -> str:
    """The features' keys, and the sizes of those that are vectors."""
    parts = [
        f"{key} ({shape[0]})" if len(shape) == 1 else key for key, shape in sorted(features.items())
    ]
    return ", ".join(parts) or "nothing"
