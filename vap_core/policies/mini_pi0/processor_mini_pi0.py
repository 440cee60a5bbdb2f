"""Words to tokens, and PI0's order of processing around them.

The vocabulary lies in the checkpoint; no tokenizer is asked for anywhere else.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import (
    ProcessorStep,
    ProcessorStepRegistry,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS

from vap_core.policies.mini_pi0.configuration_mini_pi0 import MiniPI0Config

PAD = "<pad>"
UNKNOWN = "<unk>"
END = "\n"
"""The first three words of every vocabulary; an instruction ends with END, as PaliGemma's do."""
Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]
SPLIT = re.compile(r"<\w+>|[\w']+|\n")


@ProcessorStepRegistry.register(name="mini_pi0_words")
@dataclass
class Words(ProcessorStep):
    """Tokenizes `task` by words, in lower case.

    What the vocabulary lacks becomes UNKNOWN, what is longer than `longest` is cut.
    """

    words: list[str]
    longest: int

    def __post_init__(self) -> None:
        self.words = list(self.words)
        self._vocabulary = vocabulary(self.words)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        processed = dict(transition)
        extra = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
        task = extra.get("task")
        texts = [task] if isinstance(task, str) else list(task or [""])
        tokens, mask = encode(texts, self._vocabulary, self.longest)
        observation = dict(transition.get(TransitionKey.OBSERVATION) or {})
        observation[OBS_LANGUAGE_TOKENS] = tokens
        observation[OBS_LANGUAGE_ATTENTION_MASK] = mask
        processed[TransitionKey.OBSERVATION] = observation
        return processed

    def get_config(self) -> dict[str, Any]:
        return {"words": self.words, "longest": self.longest}

    def transform_features(self, features: Features) -> Features:
        language = PolicyFeature(FeatureType.LANGUAGE, (self.longest,))
        features[PipelineFeatureType.OBSERVATION] |= {
            OBS_LANGUAGE_TOKENS: language,
            OBS_LANGUAGE_ATTENTION_MASK: language,
        }
        return features


def vocabulary(words: Iterable[str]) -> dict[str, int]:
    """The token of every word."""
    return {word: token for token, word in enumerate(words)}


def encode(
    texts: list[str], tokens_of: Mapping[str, int], longest: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Tokens, one row per text, and a mask of those that do not pad it.

    A row is as long as the longest text, `longest` at most, padded on the right. `tokens_of` is the
    `vocabulary`.
    """
    said = [SPLIT.findall(text.lower().rstrip("\n"))[: longest - 1] for text in texts]
    unknown = tokens_of[UNKNOWN]
    rows = [[tokens_of.get(word, unknown) for word in [*words, END]] for words in said]
    width = max(map(len, rows))
    tokens = torch.zeros((len(rows), width), dtype=torch.long)
    for i, row in enumerate(rows):
        tokens[i, : len(row)] = torch.tensor(row)
    return tokens, tokens != tokens_of[PAD]


def make_mini_pi0_pre_post_processors(
    config: MiniPI0Config, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> Any:
    """The two pipelines of a mini-pi0; lerobot's factory asks for them by this name."""
    steps = make_default_policy_processor_steps(config, dataset_stats)
    words = Words(list(config.words), config.tokenizer_max_length)
    before = [steps.rename_observations, steps.add_batch_dim, words]
    return make_policy_processor_pipelines(
        input_steps=[*before, steps.to_device, steps.normalize],
        output_steps=[steps.unnormalize, steps.to_cpu],
    )
