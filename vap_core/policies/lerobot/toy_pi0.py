"""lerobot's PI0 and PI0.5 at toy size with random weights: the real classes and files, small enough for a test or a bench.

Their sizes stand in their source, not in their checkpoints, so they are small only inside `toy_sizes()`, for saving and for loading alike.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from vap_core.base.types import value

WORDS = """<pad> <unk> put pick move select my the red green blue yellow magenta cyan orange purple camera shaver owl figurine straw cup bottle
pen holder plate basket bowl on in into near up with coke can shoe leather bag cat miniature house vase plushie slipper plant stuffed toy pouch
scrubber white black"""
VOCABULARY = 64


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
    sizes = {"gemma_2b": size.width, "gemma_300m": size.expert}
    vlm, expert = (
        modeling_pi0.PaliGemmaForConditionalGenerationWithPiGemma,
        modeling_pi0.PiGemmaForCausalLM,
    )

    def small_vlm(config: Any) -> Any:
        config.text_config.vocab_size = config.image_token_index = config._vocab_size = VOCABULARY
        seen = config.vision_config
        seen.hidden_size, seen.intermediate_size, seen.projection_dim = (
            size.width,
            2 * size.width,
            size.width,
        )
        seen.num_hidden_layers, seen.num_attention_heads, seen.patch_size = (
            size.layers,
            4,
            size.patch,
        )
        return vlm(config=config)

    def small_expert(config: Any) -> Any:
        config.vocab_size = VOCABULARY
        return expert(config=config)

    def small(variant: str) -> Any:
        wide = sizes[variant]
        return modeling_pi0.GemmaConfig(
            width=wide,
            depth=size.layers,
            mlp_dim=2 * wide,
            num_heads=8,
            num_kv_heads=1,
            head_dim=size.width // 4,
        )

    with ExitStack() as patches:
        for module in (modeling_pi0, modeling_pi05):
            patches.enter_context(patch.object(module, "get_gemma_config", small))
            patches.enter_context(
                patch.object(module, "PaliGemmaForConditionalGenerationWithPiGemma", small_vlm)
            )
            patches.enter_context(patch.object(module, "PiGemmaForCausalLM", small_expert))
        yield


def save_toy(
    folder: Path,
    cameras: Sequence[str],
    state_size: int,
    action_size: int,
    toy: Toy | None = None,
    kind: str = "pi0",
) -> Path:
    """A checkpoint as lerobot leaves it: config, weights, processors, and a tokenizer of a few dozen words. Its actions are small."""
    import torch
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies import get_policy_class, make_policy_config, make_pre_post_processors
    from lerobot.processor import tokenizer_processor

    size = toy or Toy()
    side, features = (
        size.image,
        {
            f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, 224, 224))
            for name in cameras
        },
    )
    config = make_policy_config(
        kind,
        input_features={**features, "observation.state": PolicyFeature(FeatureType.STATE, (state_size,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (action_size,))},
        device="cpu", chunk_size=size.chunk, n_action_steps=size.chunk, max_state_dim=state_size, max_action_dim=action_size,
        image_resolution=(side, side), num_inference_steps=size.denoise, tokenizer_max_length=16 if kind == "pi0" else 48,
    )  # fmt: skip
    names = tokenizer(folder / "tokenizer")
    with toy_sizes(size), torch.random.fork_rng():
        torch.manual_seed(0)
        get_policy_class(kind)(config).save_pretrained(folder)
    stats = {
        "observation.state": _statistics(torch.ones(state_size)),
        "action": _statistics(torch.full((action_size,), 0.005)),
    }
    with patch.object(
        tokenizer_processor.AutoTokenizer, "from_pretrained", return_value=names
    ):  # it asks the hub for PaliGemma's
        before, after = make_pre_post_processors(config, dataset_stats=stats)
    before.save_pretrained(folder)
    after.save_pretrained(folder)
    file = folder / "policy_preprocessor.json"
    file.write_text(
        file.read_text().replace(
            "google/paligemma-3b-pt-224", str((folder / "tokenizer").resolve())
        )
    )
    return folder


def _statistics(std: Any) -> dict[str, Any]:
    return {"mean": 0 * std, "std": std, "q01": -2 * std, "q99": 2 * std}


def tokenizer(folder: Path, *more: str, **special: Any) -> Any:
    """Kept in `folder`: a tokenizer of a few dozen words, and `more`; `special` says what some of them are for."""
    from tokenizers import Regex, Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    tokens = Tokenizer(
        models.WordLevel(
            {word: i for i, word in enumerate((*WORDS.split(), *more))}, unk_token="<unk>"
        )
    )
    tokens.pre_tokenizer = pre_tokenizers.Split(Regex(r"[\s,.]+"), "removed")
    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokens, pad_token="<pad>", unk_token="<unk>", **special
    )
    fast.save_pretrained(folder)
    return fast
