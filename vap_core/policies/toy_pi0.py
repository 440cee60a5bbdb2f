"""lerobot's PI0 at toy size with random weights: the real classes and files, small enough for a test or a bench.

PI0's sizes stand in its source, not in its checkpoint, so they are small only inside `toy_sizes()`, for saving and for loading alike.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from vap_core.values import value

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
    """Inside, PI0 is built at toy size."""
    from lerobot.policies.pi0 import modeling_pi0 as pi0

    size = toy or Toy()
    sizes = {"gemma_2b": size.width, "gemma_300m": size.expert}
    vlm, expert = pi0.PaliGemmaForConditionalGenerationWithPiGemma, pi0.PiGemmaForCausalLM

    def small_vlm(config: Any) -> Any:
        config.text_config.vocab_size = config.image_token_index = config._vocab_size = VOCABULARY
        seen = config.vision_config
        seen.hidden_size, seen.intermediate_size, seen.projection_dim = size.width, 2 * size.width, size.width
        seen.num_hidden_layers, seen.num_attention_heads, seen.patch_size = size.layers, 4, size.patch
        return vlm(config=config)

    def small_expert(config: Any) -> Any:
        config.vocab_size = VOCABULARY
        return expert(config=config)

    def small(variant: str) -> Any:
        return pi0.GemmaConfig(
            width=sizes[variant], depth=size.layers, mlp_dim=2 * sizes[variant], num_heads=8, num_kv_heads=1, head_dim=size.width // 4
        )

    with (
        patch.object(pi0, "get_gemma_config", small),
        patch.object(pi0, "PaliGemmaForConditionalGenerationWithPiGemma", small_vlm),
        patch.object(pi0, "PiGemmaForCausalLM", small_expert),
    ):
        yield


def save_toy(folder: Path, cameras: Sequence[str], state_size: int, action_size: int, toy: Toy | None = None) -> Path:
    """A checkpoint as lerobot leaves it: config, weights, processors, and a tokenizer of a few dozen words. Its actions are small."""
    import torch
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies import make_pre_post_processors
    from lerobot.policies.pi0.configuration_pi0 import PI0Config
    from lerobot.policies.pi0.modeling_pi0 import PI0Policy
    from lerobot.policies.pi0.processor_pi0 import TokenizerProcessorStep

    size = toy or Toy()
    side, features = size.image, {f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, 224, 224)) for name in cameras}
    config = PI0Config(
        input_features={**features, "observation.state": PolicyFeature(FeatureType.STATE, (state_size,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (action_size,))},
        device="cpu", chunk_size=size.chunk, n_action_steps=size.chunk, max_state_dim=state_size, max_action_dim=action_size,
        image_resolution=(side, side), num_inference_steps=size.denoise, tokenizer_max_length=16,
    )  # fmt: skip
    names = _tokenizer(folder / "tokenizer")
    with toy_sizes(size), torch.random.fork_rng():
        torch.manual_seed(0)
        PI0Policy(config).save_pretrained(folder)
    stats: Mapping[str, Any] = {
        "observation.state": {"mean": torch.zeros(state_size), "std": torch.ones(state_size)},
        "action": {"mean": torch.zeros(action_size), "std": torch.full((action_size,), 0.005)},
    }
    with patch(f"{TokenizerProcessorStep.__module__}.AutoTokenizer.from_pretrained", return_value=names):  # PI0 asks the hub for PaliGemma's
        before, after = make_pre_post_processors(config, dataset_stats=dict(stats))
    before.save_pretrained(folder)
    after.save_pretrained(folder)
    file = folder / "policy_preprocessor.json"
    file.write_text(file.read_text().replace("google/paligemma-3b-pt-224", str((folder / "tokenizer").resolve())))
    return folder


def _tokenizer(folder: Path) -> Any:
    from tokenizers import Regex, Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    tokens = Tokenizer(models.WordLevel({word: i for i, word in enumerate(WORDS.split())}, unk_token="<unk>"))
    tokens.pre_tokenizer = pre_tokenizers.Split(Regex(r"[\s,.]+"), "removed")
    fast = PreTrainedTokenizerFast(tokenizer_object=tokens, pad_token="<pad>", unk_token="<unk>")
    fast.save_pretrained(folder)
    return fast
