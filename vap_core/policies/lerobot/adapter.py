"""Any policy that lerobot can load, as one of ours, with frozen weights and in batches.

    policy = load_policy("path/to/checkpoint")        # or owner/name, already downloaded
    Trial("generic", scene, policy, ...)

A checkpoint is a folder as lerobot writes it: config.json, model.safetensors, and the two processor
pipelines with their statistics. It comes from outside: it is parsed, never executed, and nothing
runs with weights that are not exactly those of the file. No random stream but that of its episode
has an effect on a chunk.
"""

import copy
import hashlib
import inspect
import io
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
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
    base_models,
    fingerprint,
    locate,
    refuse_code,
)
from vap_core.policies.protocol import Chunk, PolicyInput
from vap_core.simulation.env import Env
from vap_core.simulation.scenes import Scene
from vap_core.simulation.suites import Suite

if TYPE_CHECKING:
    from lerobot.policies.pretrained import PreTrainedPolicy

STATE = "observation.state"
IMAGE = "observation.images."
EMPTY = "observation.images.empty_camera"
TOKENS = "observation.language.tokens"
TOKEN_MASK = "observation.language.attention_mask"
"""lerobot's feature keys; a checkpoint fills its empty cameras itself."""
DRAWS_NOTHING = ("act",)
"""Policies whose chunk is a function of the observation alone."""
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
        config: Any = policy.config
        self.policy = policy.eval().requires_grad_(False)
        self.preprocessor = preprocessor
        self.postprocessor = postprocessor
        self.label = label
        self.noisy = _takes_noise(policy)
        remembers = config.n_obs_steps != 1
        ensembles = getattr(config, "temporal_ensemble_coeff", None) is not None
        draws_nothing = config.type in DRAWS_NOTHING
        self.batched = not remembers and not ensembles and (self.noisy or draws_nothing)
        self.execute = int(config.n_action_steps) if self.batched else 1
        self.action_size = int(config.action_feature.shape[0])
        self.renamed = _renamed_features(preprocessor)
        self.wanted: Shapes = {}
        """Shape of every feature that is read, under the key that the preprocessor expects."""
        for key, feature in config.input_features.items():
            if not key.startswith(EMPTY):
                self.wanted[self.renamed.get(key, key)] = tuple(feature.shape)
        self.learned: dict[int, torch.Tensor] = {}
        """The learned embedding of a word, by its token."""
        model = getattr(policy, "model", None)
        self.attends = self.batched and hasattr(model, "paligemma_with_expert")
        """Whether it reports its attention (module hooks)."""

    def with_tokens(self, words: Mapping[str, Float32[np.ndarray, " d"]]) -> "LeRobot":
        """The same frozen policy, in which some reserved words have learned embeddings.

        Its own table of embeddings stays as it is.

        Raises: BadPolicy for a word that the vocabulary does not have.
        """
        tokens = {word: i for i, word in enumerate(getattr(self.policy.config, "words", ()))}
        learned = {}
        for word, embedding in words.items():
            if word not in tokens:
                raise BadPolicy(
                    f"LeRobot: {self.label} has no word {word}; learned words need a mini-pi0, "
                    "which reserves some for them."
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
            return list(states), self._plan_batch(states, inputs)
        chunks = []
        for i, (state, policy_input) in enumerate(zip(states, inputs, strict=True)):
            chunks.append(self._plan_step(i, state, policy_input))
        return list(states), chunks

    def check(self, cameras: Sequence[str], state_size: int, action_size: int) -> None:
        """Check that the checkpoint fits these cameras and these sizes.

        Raises: BadPolicy when it reads another camera or another state, or when its actions have
            another length.
        """
        available: Shapes = {STATE: (state_size,)}
        for camera in cameras:
            available[IMAGE + camera] = ()
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

    def sha256(self) -> str:
        """Checksum of all parameters and buffers as they stand."""
        digest = hashlib.sha256()
        for name, tensor in sorted(self.policy.state_dict().items()):
            flat = tensor.detach().cpu().contiguous().reshape(-1)
            digest.update(name.encode())
            digest.update(flat.view(torch.uint8).numpy().tobytes())
        return digest.hexdigest()

    def _plan_batch(
        self, states: Sequence[LeRobotState], inputs: Sequence[PolicyInput]
    ) -> list[Chunk]:
        batch = self.preprocessor(self._observation(inputs))
        episodes = range(len(inputs))
        self._report_inputs(batch, episodes)
        options = {}
        if self.noisy:
            options["noise"] = self._noise(states)
        with self._overriding_tokens(), self._reporting_attention():
            planned = self.policy.predict_action_chunk(batch, **options)
            actions = self.postprocessor(planned[:, : self.execute])
        return list(actions.float().cpu().numpy())

    def _plan_step(self, episode: int, state: LeRobotState, policy_input: PolicyInput) -> Chunk:
        batch = self.preprocessor(self._observation([policy_input]))
        self._report_inputs(batch, [episode])
        with torch.random.fork_rng():
            torch.manual_seed(state.seed)
            action = self.postprocessor(state.own.select_action(batch))
        return action.float().cpu().numpy()

    def _observation(self, inputs: Sequence[PolicyInput]) -> dict[str, Any]:
        """What lerobot's loop would hand to the preprocessor.

        Images are floats in 0..1, B x C x H x W.
        """
        self.check(list(inputs[0].images), len(inputs[0].state), self.action_size)
        observation: dict[str, Any] = {"task": [policy_input.text for policy_input in inputs]}
        for key, shape in self.wanted.items():
            if key == STATE:
                state = np.stack([policy_input.state for policy_input in inputs])
                observation[key] = torch.from_numpy(state)
            else:
                camera = key.removeprefix(IMAGE)
                rgb = np.stack([policy_input.images[camera] for policy_input in inputs])
                images = torch.from_numpy(rgb).permute(0, 3, 1, 2).float() / 255
                observation[key] = _resize(images, shape)
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
                rows = []
                for tokens, mask in zip(tensor, batch[TOKEN_MASK], strict=True):
                    rows.append(tokens[mask])
            elif key.startswith(IMAGE):
                name = self._camera(key)
                rows = list(tensor)
            else:
                continue
            for episode, row in zip(episodes, rows, strict=True):
                report_input(episode, name, row.float().cpu().numpy())

    def _camera(self, key: str) -> str:
        """The name of our camera whose image the checkpoint reads under `key`."""
        return self.renamed.get(key, key).removeprefix(IMAGE)

    @contextmanager
    def _overriding_tokens(self) -> Iterator[None]:
        """Inside, the embeddings of learned words are the learned ones."""
        if not self.learned:
            yield
            return

        def replace_embeddings(module: Any, args: Any, embeddings: torch.Tensor) -> torch.Tensor:
            for token, embedding in self.learned.items():
                is_token = (args[0] == token)[..., None]
                embeddings = torch.where(is_token, embedding.to(embeddings), embeddings)
            return embeddings

        model: Any = self.policy.model
        table = model.paligemma_with_expert.paligemma.model.language_model.embed_tokens
        hook = table.register_forward_hook(replace_embeddings)
        try:
            yield
        finally:
            hook.remove()

    @contextmanager
    def _reporting_attention(self) -> Iterator[None]:
        """Inside, a pi0 reports its attention to image patches, where somebody observes it.

        It is that of the last layer of the action expert, in the mean over heads, actions and
        denoising steps.
        """
        if not self.attends or not attention_observed():
            yield
            return
        policy: Any = self.policy
        chunk_size = policy.config.chunk_size
        weights: list[torch.Tensor] = []

        def keep_weights(module: Any, args: Any, output: Any) -> None:
            of_actions = output[1][:, :, -chunk_size:]
            weights.append(of_actions.mean(dim=(1, 2)))

        expert = policy.model.paligemma_with_expert.gemma_expert.model
        hook = expert.layers[-1].self_attn.register_forward_hook(keep_weights)
        try:
            yield
        finally:
            hook.remove()
        self._report_attention(torch.stack(weights).mean(0))

    def _report_attention(self, weights: torch.Tensor) -> None:
        """Report a map per camera of every episode; `weights` is episodes x attention keys."""
        policy: Any = self.policy
        vision = policy.model.paligemma_with_expert.paligemma.config.vision_config
        side = policy.config.image_resolution[0] // vision.patch_size
        keys = [key for key in policy.config.image_features if not key.startswith(EMPTY)]
        n_cameras = len(keys)  # lerobot puts empty cameras behind them
        patches = weights[:, : n_cameras * side**2]
        maps = patches.unflatten(1, (n_cameras, side, side)).float().cpu().numpy()
        for i, key in enumerate(keys):
            for episode, attention in enumerate(maps[:, i]):
                report_attention(episode, self._camera(key), attention)

    def _noise(self, states: Sequence[LeRobotState]) -> torch.Tensor:
        config: Any = self.policy.config
        shape = (config.chunk_size, config.max_action_dim)
        noise = []
        for state in states:
            generator = torch.Generator().manual_seed(state.seed)
            noise.append(torch.randn(shape, generator=generator))
        return torch.stack(noise).to(config.device)


def load_policy(checkpoint: str | Path, device: str | None = None) -> LeRobot:
    """Load a checkpoint through lerobot's factory.

    `checkpoint` is a folder, or the `owner/name` of a model that was downloaded before.

    Raises: BadPolicy when it is not there, would execute code, cannot be built, or does not end
        with exactly the file's weights.
    """
    # registers our own type of policy and its step
    import_module("vap_core.policies.mini_pi0.processor_mini_pi0")
    folder = locate(checkpoint)
    refuse_code(folder)
    try:
        policy, preprocessor, postprocessor = _build(folder, device)
    except Exception as error:
        reason = str(error).strip().splitlines() or [""]
        remedy = _remedy(folder, error)
        raise BadPolicy(
            f"load: {folder} cannot become a policy "
            f"({type(error).__name__}: {reason[0]:.200}); {remedy}."
        ) from error
    with _silence():
        compare(policy, folder / WEIGHTS)
    name = folder.name if Path(checkpoint).is_dir() else checkpoint
    label = f"{policy.config.type}:{name}@{fingerprint(folder)[:8]}"
    return LeRobot(
        policy=policy, preprocessor=preprocessor, postprocessor=postprocessor, label=label
    )


_load_cached = cache(load_policy)


def load_for_suite(checkpoint: str, scene: Scene, suite: Suite) -> LeRobot:
    """The checkpoint, loaded once in this process, for the inputs and actions of a suite.

    Raises: BadPolicy when it does not fit them.
    """
    policy = _load_cached(checkpoint)
    env = Env(scene, control=suite.control)
    state_size = len(env.state())
    policy.check(suite.cameras, state_size, env.action_size)
    return policy


def compare(policy: "PreTrainedPolicy", file: Path) -> None:
    """Check that the policy's weights are the file's, tensor for tensor, cast to its precision.

    lerobot's PI0 prints a failed load and goes on with random weights; other policies skip what
    they miss.

    Raises: BadPolicy.
    """
    from safetensors import safe_open

    weights = policy.state_dict()
    different = []
    tied = set()
    with safe_open(file, "pt") as stored:
        names = _names_in_file(policy, stored.keys(), weights)
        for key, name in names.items():
            if key in weights and _equal(stored.get_tensor(name), weights[key]):
                tied.add(weights[key].data_ptr())
            else:
                different.append(key)
    for key, tensor in weights.items():
        if key not in names and tensor.data_ptr() not in tied:
            different.append(key)
    if different:
        raise BadPolicy(
            f"load: {len(different)} of {len(weights)} tensors differ from {file}, {different[0]} "
            "for one; the file belongs to another architecture or size."
        )


def _takes_noise(policy: "PreTrainedPolicy") -> bool:
    """Whether the sampling noise is an argument of the policy's model."""
    sampler = getattr(getattr(policy, "model", None), "sample_actions", None)
    return sampler is not None and "noise" in inspect.signature(sampler).parameters


def _renamed_features(preprocessor: Any) -> dict[str, str]:
    """The key that the preprocessor expects, by the key to which it renames it."""
    renamed = {}
    for step in preprocessor.steps:
        for old, new in getattr(step, "rename_map", {}).items():
            renamed[new] = old
    return renamed


def _copy_policy(policy: "PreTrainedPolicy") -> "PreTrainedPolicy":
    """A copy that shares weights and configuration, and keeps its own memory of observations."""
    own = copy.copy(policy)
    for name, attribute in vars(policy).items():
        if name.startswith("_") or name == "config":
            continue
        if not isinstance(attribute, torch.nn.Module):
            setattr(own, name, copy.deepcopy(attribute))
    return own


def _build(folder: Path, device: str | None) -> tuple["PreTrainedPolicy", Any, Any]:
    """The policy of a checkpoint, its preprocessor and its postprocessor."""
    from lerobot import policies
    from lerobot.configs import PreTrainedConfig

    # some policies trust any repository
    no_code = patch("transformers.dynamic_module_utils.get_class_in_module", _no_code)
    with _silence(), no_code:
        config: Any = PreTrainedConfig.from_pretrained(folder)
        config.device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        # the file's weights replace those that these options load
        if getattr(config, "pretrained_backbone_weights", None):
            config.pretrained_backbone_weights = None
        if getattr(config, "load_vlm_weights", None):
            config.load_vlm_weights = False
        policy_class: Any = policies.factory.get_policy_class(config.type)
        policy = policy_class.from_pretrained(folder, config=config)
        preprocessor, postprocessor = policies.make_pre_post_processors(
            config,
            str(folder),
            preprocessor_overrides={"device_processor": {"device": config.device}},
        )
    return policy, preprocessor, postprocessor


def _remedy(folder: Path, error: Exception) -> str:
    """What to do about a checkpoint that cannot be built."""
    if "huggingface.co" in str(error):
        models = base_models(folder)
        if models:
            commands = ", ".join(f"`hf download {name}`" for name in models)
            return f"get what it builds on: {commands}"
    return "check its files, or save it again with lerobot 0.6"


def _names_in_file(
    policy: "PreTrainedPolicy", names: Sequence[str], weights: Mapping[str, torch.Tensor]
) -> dict[str, str]:
    """The name of a tensor in the file, by its key in the policy's `weights`.

    openpi's names are mapped by the policy itself; numbers stand in for the tensors meanwhile.
    """
    numbered = {}
    for i, name in enumerate(names):
        numbered[name] = torch.tensor(i)
    rename: Callable[..., dict[str, Any]] | None
    rename = getattr(policy, "_fix_pytorch_state_dict_keys", None)
    if rename is not None:
        numbered = rename(numbered, policy.config)
    found = {}
    for key, number in numbered.items():
        known = key if key in weights else f"model.{key}"
        found[known] = names[int(number)]
    return found


def _equal(stored: torch.Tensor, loaded: torch.Tensor) -> bool:
    return torch.equal(stored.to(loaded.dtype), loaded.cpu())


def _resize(images: torch.Tensor, shape: tuple[int, ...]) -> torch.Tensor:
    """Scaled to the height and width that the checkpoint was trained on."""
    size = shape[-2:]
    if images.shape[-2:] == size:
        return images
    return torch.nn.functional.interpolate(images, size, mode="bilinear", antialias=True)


def _format_shapes(features: Shapes) -> str:
    """The features' keys, and the sizes of those that are vectors."""
    parts = []
    for key, shape in sorted(features.items()):
        parts.append(f"{key} ({shape[0]})" if len(shape) == 1 else key)
    return ", ".join(parts) or "nothing"


@contextmanager
def _silence() -> Iterator[None]:
    """Loading prints and logs a page; what matters of it is checked afterwards."""
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with redirect_stdout(io.StringIO()):
            yield
    finally:
        logging.disable(level)


def _no_code(*args: Any, **kwargs: Any) -> Any:
    raise BadPolicy(
        "its tokenizer or backbone is Python from the hub, which is never executed here"
    )
