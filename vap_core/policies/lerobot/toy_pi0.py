"""lerobot's PI0 and PI0.5 at toy size with random weights, for a test or a bench.

They are the real classes and files. Their sizes stand in their source, not in their checkpoints, so
they are small only inside `toy_sizes()`, for saving and for loading alike.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from vap_core.base.types import value

WORDS = """<pad> <unk> put pick move select my the red green blue yellow magenta cyan orange purple
camera shaver owl figurine straw cup bottle pen holder plate basket bowl on in into near up with
coke can shoe leather bag cat miniature house vase plushie slipper plant stuffed toy pouch scrubber
white black"""
VOCABULARY = 64
TOKENIZER = "google/paligemma-3b-pt-224"
"""The tokenizer that PI0's preprocessor asks the hub for."""


@value
class Toy:
    """Sizes in tokens, features and layers; eight heads, as PI0 has them."""

    image: int = 112
    patch: int = 16
    width: int = 64
    layers: int = 2
    expert: int = 64
    chunk: int = 4
    denoise: int = 10


@contextmanager
def toy_sizes(toy: Toy | None = None) -> Iterator[None]:
    """Inside, PI0 and PI0.5 are built at toy size."""
    from lerobot.policies.pi0 import modeling_pi0
    from lerobot.policies.pi05 import modeling_pi05

    size = toy or Toy()
    widths = {"gemma_2b": size.width, "gemma_300m": size.expert}
    make_vlm = modeling_pi0.PaliGemmaForConditionalGenerationWithPiGemma
    make_expert = modeling_pi0.PiGemmaForCausalLM

    def make_toy_vlm(config: Any) -> Any:
        # Set the sizes of a PaliGemma's configuration.
        config.text_config.vocab_size = VOCABULARY
        config.image_token_index = VOCABULARY
        config._vocab_size = VOCABULARY
        vision = config.vision_config
        vision.hidden_size = size.width
        vision.intermediate_size = 2 * size.width
        vision.projection_dim = size.width
        vision.num_hidden_layers = size.layers
        vision.num_attention_heads = 4
        vision.patch_size = size.patch
        return make_vlm(config=config)

    def make_toy_expert(config: Any) -> Any:
        config.vocab_size = VOCABULARY
        return make_expert(config=config)

    def toy_gemma_config(variant: str) -> Any:
        width = widths[variant]
        return modeling_pi0.GemmaConfig(
            width=width,
            depth=size.layers,
            mlp_dim=2 * width,
            num_heads=8,
            num_kv_heads=1,
            head_dim=size.width // 4,
        )

    replacements = {
        "get_gemma_config": toy_gemma_config,
        "PaliGemmaForConditionalGenerationWithPiGemma": make_toy_vlm,
        "PiGemmaForCausalLM": make_toy_expert,
    }
    with ExitStack() as patches:
        for module in (modeling_pi0, modeling_pi05):
            for name, replacement in replacements.items():
                patches.enter_context(patch.object(module, name, replacement))
        yield


def save_toy(
    folder: Path,
    cameras: Sequence[str],
    state_size: int,
    action_size: int,
    toy: Toy | None = None,
    kind: str = "pi0",
) -> Path:
    """Write a checkpoint as lerobot does, whose actions are small; returns its folder.

    It has a configuration, weights, processors, and a tokenizer of a few dozen words.
    """
    import torch
    from lerobot.policies import get_policy_class, make_pre_post_processors
    from lerobot.processor import tokenizer_processor

    size = toy or Toy()
    config = _policy_config(kind, size, cameras, state_size, action_size)
    words = tokenizer(folder / "tokenizer")
    with toy_sizes(size), torch.random.fork_rng():
        torch.manual_seed(0)
        get_policy_class(kind)(config).save_pretrained(folder)
    statistics = {
        "observation.state": _statistics(torch.ones(state_size)),
        "action": _statistics(torch.full((action_size,), 0.005)),
    }
    hub = tokenizer_processor.AutoTokenizer  # it asks the hub for PaliGemma's
    with patch.object(hub, "from_pretrained", return_value=words):
        preprocessor, postprocessor = make_pre_post_processors(config, dataset_stats=statistics)
    preprocessor.save_pretrained(folder)
    postprocessor.save_pretrained(folder)
    file = folder / "policy_preprocessor.json"
    own_tokenizer = str((folder / "tokenizer").resolve())
    file.write_text(file.read_text().replace(TOKENIZER, own_tokenizer))
    return folder


def tokenizer(folder: Path, *more: str, **special: Any) -> Any:
    """A tokenizer of a few dozen words and `more`, written to `folder`.

    `special` says what some of the words are for.
    """
    from tokenizers import Regex, Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    vocabulary = {word: i for i, word in enumerate((*WORDS.split(), *more))}
    tokens = Tokenizer(models.WordLevel(vocabulary, unk_token="<unk>"))
    tokens.pre_tokenizer = pre_tokenizers.Split(Regex(r"[\s,.]+"), "removed")
    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokens, pad_token="<pad>", unk_token="<unk>", **special
    )
    fast.save_pretrained(folder)
    return fast


def _policy_config(
    kind: str, size: Toy, cameras: Sequence[str], state_size: int, action_size: int
) -> Any:
    """The policy's configuration, with the features that it reads and its sizes."""
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies import make_policy_config

    inputs = {}
    for name in cameras:
        feature = PolicyFeature(FeatureType.VISUAL, (3, 224, 224))
        inputs[f"observation.images.{name}"] = feature
    inputs["observation.state"] = PolicyFeature(FeatureType.STATE, (state_size,))
    return make_policy_config(
        kind,
        input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (action_size,))},
        device="cpu",
        chunk_size=size.chunk,
        n_action_steps=size.chunk,
        max_state_dim=state_size,
        max_action_dim=action_size,
        image_resolution=(size.image, size.image),
        num_inference_steps=size.denoise,
        tokenizer_max_length=16 if kind == "pi0" else 48,
    )


def _statistics(std: Any) -> dict[str, Any]:
    return {"mean": 0 * std, "std": std, "q01": -2 * std, "q99": 2 * std}
