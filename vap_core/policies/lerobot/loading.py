"""Loads a lerobot policy, and checks that it has the statistics that its inputs and actions need.

lerobot's normaliser returns a tensor unchanged where its key has no statistics.
"""

import io
import logging
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import torch

from vap_core.base.errors import BadPolicy, device_name, first_line
from vap_core.policies.lerobot.checkpoints import WEIGHTS, base_models, refuse_code

if TYPE_CHECKING:
    from lerobot.policies.pretrained import PreTrainedPolicy


NEEDED = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""The statistics that each of lerobot's ways to normalise reads. IDENTITY reads none."""
EMPTY = "observation.images.empty_camera"
"""What the keys of empty cameras begin with; a checkpoint fills them itself, unscaled."""
ACTION = "action"


def _scaled(config: Any, preprocessor: Any, postprocessor: Any) -> Iterator[tuple[Any, str, Any]]:
    """Every step that scales, the key of what it scales, and the feature of that key.

    Inputs go from the last step back, as a step that renames follows the key that it renames. An
    action is no input; it goes through the unnormalisers alone.
    """
    from lerobot.processor import NormalizerProcessorStep, UnnormalizerProcessorStep

    features = {
        key: feature for key, feature in config.input_features.items() if not key.startswith(EMPTY)
    }
    for step in reversed(preprocessor.steps):
        if isinstance(step, NormalizerProcessorStep):
            chosen = step.normalize_observation_keys
            for key, feature in features.items():
                if chosen is None or key in chosen:
                    yield step, key, feature
        before = {new: old for old, new in getattr(step, "rename_map", {}).items()}
        features = {before.get(key, key): feature for key, feature in features.items()}
    for step in postprocessor.steps:
        if isinstance(step, UnnormalizerProcessorStep):
            yield step, ACTION, config.action_feature


def _fault(step: Any, key: str, feature: Any) -> str:
    """What is wrong with the statistics of a key, "" where nothing is."""
    mode = step.norm_map.get(feature.type)
    needed = () if mode is None else NEEDED.get(mode.value, ())
    # EVO1 widens what it scales, and its steps' own features say so.
    shape = tuple(step.features.get(key, feature).shape)
    # An input that a step's features lack is not scaled by it.
    is_scaled = key in step.features or key == ACTION
    statistics = step.state_dict()
    for name in needed:
        found = statistics.get(f"{key}.{name}")
        if found is None or not is_scaled:
            return f"no statistics of {key}"
        try:  # those of an image may be of its channels alone
            wide = tuple(torch.broadcast_shapes(found.shape, shape)) if len(shape) > 1 else None
        except RuntimeError:
            wide = None
        if not torch.isfinite(found).all() or (name == "std" and (found < 0).any()):
            return f"statistics of {key} whose {name} is no number, or negative"
        if shape not in (tuple(found.shape), wide):
            return f"statistics of {key} for {found.numel()} numbers, where it has {shape[0]}"
    return ""


def build(folder: Path, device: str | None) -> tuple["PreTrainedPolicy", Any, Any]:
    """The policy of a checkpoint, its preprocessor and its postprocessor.

    Raises: BadPolicy when it would execute code, cannot be built, lacks statistics that it scales
        by, or does not end with exactly the file's weights. UnknownName when the device is not on
        this machine.
    """
    # registers our own type of policy and its step
    import_module("vap_core.policies.mini_pi0.processor_mini_pi0")
    refuse_code(folder)
    device = device_name(device)
    try:
        policy, preprocessor, postprocessor = _build(folder, device)
    except BadPolicy:  # it says its own remedy
        raise
    except Exception as error:
        remedy = "check its files, or save it again with lerobot 0.6"
        models = base_models(folder) if "huggingface.co" in str(error) else []
        if models:
            remedy = f"get what it builds on: {', '.join(f'`hf download {m}`' for m in models)}"
        raise BadPolicy(
            f"load: {folder} cannot become a policy "
            f"({type(error).__name__}: {first_line(error):.200}); {remedy}."
        ) from error
    for step, key, feature in _scaled(policy.config, preprocessor, postprocessor):
        fault = _fault(step, key, feature)
        if fault:
            raise BadPolicy(f"load: {folder} has {fault}; save it with the dataset's statistics.")
    with _silence():
        compare(policy, folder / WEIGHTS)
    return policy, preprocessor, postprocessor


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
        in_file = list(stored.keys())
        # openpi's names are mapped by the policy itself; numbers stand in for the tensors.
        numbered = {name: torch.tensor(i) for i, name in enumerate(in_file)}
        rename = getattr(policy, "_fix_pytorch_state_dict_keys", None)
        if rename is not None:
            numbered = rename(numbered, policy.config)
        names = {
            key if key in weights else f"model.{key}": in_file[int(number)]
            for key, number in numbered.items()
        }
        for key, name in names.items():
            found = stored.get_tensor(name) if key in weights else None
            if found is not None and not torch.isfinite(found).all():
                raise BadPolicy(
                    f"load: {name} in {file} has numbers that are not finite; copy it again."
                )
            if found is not None and torch.equal(found.to(weights[key].dtype), weights[key].cpu()):
                tied.add(weights[key].data_ptr())
            else:
                different.append(key)
    different += [
        key for key, tensor in weights.items() if key not in names and tensor.data_ptr() not in tied
    ]
    if different:
        raise BadPolicy(
            f"load: {len(different)} of {len(weights)} tensors differ from {file}, {different[0]} "
            "for one; the file belongs to another architecture or size."
        )


def _build(folder: Path, device: str) -> tuple["PreTrainedPolicy", Any, Any]:
    """The policy of a checkpoint, its preprocessor and its postprocessor."""
    from lerobot import policies
    from lerobot.configs import PreTrainedConfig

    # some policies trust any repository
    no_code = patch("transformers.dynamic_module_utils.get_class_in_module", _no_code)
    # a file does not decide what is looked up on the network
    offline = patch("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with _silence(), no_code, offline:
        config = PreTrainedConfig.from_pretrained(folder)
        config.device = device
        # the file's weights replace those that these options load
        if getattr(config, "pretrained_backbone_weights", None):
            config.pretrained_backbone_weights = None
        if getattr(config, "load_vlm_weights", None):
            config.load_vlm_weights = False
        policy_class = policies.factory.get_policy_class(config.type)
        policy = policy_class.from_pretrained(folder, config=config)
        preprocessor, postprocessor = policies.make_pre_post_processors(
            config,
            str(folder),
            preprocessor_overrides={"device_processor": {"device": config.device}},
        )
    return policy, preprocessor, postprocessor


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
