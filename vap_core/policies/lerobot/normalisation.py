"""Whether a checkpoint has the statistics that its inputs and actions are scaled by.

lerobot's normaliser returns a tensor as it is where its key has no statistics, without a word.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from vap_core.base.errors import BadPolicy

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
Scaled = tuple[Any, str, Any]
"""A step that scales, the key of what it scales, and the feature of that key."""


def require_statistics(folder: Path, config: Any, preprocessor: Any, postprocessor: Any) -> None:
    """Check that every input and the actions of a checkpoint's policy are scaled as it says.

    Raises: BadPolicy when statistics are absent, or of another length than what they scale.
    """
    scaled = (*_inputs(config, preprocessor), *_actions(config, postprocessor))
    for step, key, feature in scaled:
        fault = _fault(step, key, feature)
        if fault:
            raise BadPolicy(f"load: {folder} has {fault}; save it with the dataset's statistics.")


def _inputs(config: Any, preprocessor: Any) -> Iterator[Scaled]:
    """What the normalisers of a preprocessor scale. An action is no input, and goes through none.

    From the last step back, as a step that renames follows the key that it renames.
    """
    from lerobot.processor import NormalizerProcessorStep

    features = {}
    for key, feature in config.input_features.items():
        if not key.startswith(EMPTY):
            features[key] = feature
    for step in reversed(preprocessor.steps):
        if isinstance(step, NormalizerProcessorStep):
            chosen = step.normalize_observation_keys
            for key, feature in features.items():
                if chosen is None or key in chosen:
                    yield step, key, feature
        before = {new: old for old, new in getattr(step, "rename_map", {}).items()}
        features = {before.get(key, key): feature for key, feature in features.items()}


def _actions(config: Any, postprocessor: Any) -> Iterator[Scaled]:
    """What the unnormalisers of a postprocessor scale: the actions alone."""
    from lerobot.processor import UnnormalizerProcessorStep

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
        if not _fits(tuple(found.shape), shape):
            return f"statistics of {key} for {found.numel()} numbers, where it has {shape[0]}"
    return ""


def _fits(found: tuple[int, ...], shape: tuple[int, ...]) -> bool:
    """Whether statistics have the shape of a vector; an image's may be of its channels alone."""
    if len(shape) == 1:
        return found == shape
    try:
        return tuple(torch.broadcast_shapes(found, shape)) == shape
    except RuntimeError:
        return False
