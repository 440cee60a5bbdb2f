"""Words to tokens, and PI0's order of processing around them. The vocabulary lies in the checkpoint; no tokenizer is asked for anywhere else."""

import re
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

PAD, UNKNOWN, END = "<pad>", "<unk>", "\n"
"""The first three words of every vocabulary; an instruction ends with END, as PaliGemma's do."""
Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]
SPLIT = re.compile(r"<\w+>|[\w']+|\n")


@ProcessorStepRegistry.register(name="mini_pi0_words")
@dataclass
class Words(ProcessorStep):
    """Tokenizes `task` by words, lower case; what the vocabulary lacks becomes UNKNOWN, what is longer than `longest` is cut."""

    words: list[str]
    longest: int

    def __post_init__(self) -> None:
        self.words = list(self.words)
        self.number = {word: i for i, word in enumerate(self.words)}

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        out = dict(transition)
        task = (transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}).get("task")
        texts = [task] if isinstance(task, str) else list(task or [""])
        tokens, mask = encode(texts, self.number, self.longest)
        out[TransitionKey.OBSERVATION] = {
            **(transition.get(TransitionKey.OBSERVATION) or {}), OBS_LANGUAGE_TOKENS: tokens, OBS_LANGUAGE_ATTENTION_MASK: mask,
        }  # fmt: skip
        return out

    def get_config(self) -> dict[str, Any]:
        return {"words": self.words, "longest": self.longest}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        language = PolicyFeature(FeatureType.LANGUAGE, (self.longest,))
        features[PipelineFeatureType.OBSERVATION] |= {
            OBS_LANGUAGE_TOKENS: language,
            OBS_LANGUAGE_ATTENTION_MASK: language,
        }
        return features


def encode(
    texts: list[str], number: dict[str, int], longest: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Token numbers, one row a text, as many as the longest has but at most `longest`, padded on the right; and where there are any."""
    said = [[*SPLIT.findall(text.lower().rstrip("\n"))[: longest - 1], END] for text in texts]
    tokens = torch.zeros((len(texts), max(map(len, said))), dtype=torch.long)
    for row, words in zip(tokens, said, strict=True):
        row[: len(words)] = torch.tensor([number.get(word, number[UNKNOWN]) for word in words])
    return tokens, tokens != number[PAD]


def make_mini_pi0_pre_post_processors(
    config: MiniPI0Config, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> Any:
    """The two pipelines of a mini-pi0; lerobot's factory asks for them by this name."""
    steps = make_default_policy_processor_steps(config, dataset_stats)
    words = Words(list(config.words), config.tokenizer_max_length)
    before = [
        steps.rename_observations,
        steps.add_batch_dim,
        words,
        steps.to_device,
        steps.normalize,
    ]
    return make_policy_processor_pipelines(
        input_steps=before, output_steps=[steps.unnormalize, steps.to_cpu]
    )
