"""PI0's model with small towers.

Masks, prefix and suffix, flow matching and sampling are lerobot's, unchanged.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import torch
from lerobot.policies.pi0.modeling_pi0 import PaliGemmaWithExpertModel, PI0Policy, PI0Pytorch
from lerobot.policies.pi_gemma import (
    PaliGemmaForConditionalGenerationWithPiGemma,
    PiGemmaForCausalLM,
)
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor, nn
from transformers import GemmaConfig, PaliGemmaConfig
from transformers.integrations.sdpa_attention import sdpa_attention_forward
from transformers.modeling_utils import ALL_ATTENTION_FUNCTIONS

from vap_core.policies.mini_pi0.configuration_mini_pi0 import HEADS, MiniPI0Config


class MiniTowers(PaliGemmaWithExpertModel):
    """A small PaliGemma, whose prefix the action expert attends to."""

    def __init__(self, config: MiniPI0Config) -> None:
        nn.Module.__init__(self)
        self.freeze_vision_encoder = config.freeze_vision_encoder
        self.train_expert_only = config.train_expert_only
        self.paligemma = PaliGemmaForConditionalGenerationWithPiGemma(config=vlm_config(config))
        self.gemma_expert = PiGemmaForCausalLM(config=_gemma_config(config, config.expert_width))
        self.gemma_expert.model.embed_tokens = None
        self.to_bfloat16_for_selected_params(cast(Any, config.dtype))
        self._set_requires_grad()


class MiniPI0Pytorch(PI0Pytorch):
    """PI0's flow-matching model around `MiniTowers`."""

    def __init__(self, config: MiniPI0Config, rtc_processor: Any = None) -> None:
        nn.Module.__init__(self)
        width = config.expert_width
        self.config = config
        self.rtc_processor = rtc_processor
        self.paligemma_with_expert = MiniTowers(config)
        self.action_in_proj = nn.Linear(config.max_action_dim, width)
        self.action_out_proj = nn.Linear(width, config.max_action_dim)
        self.state_proj = nn.Linear(config.max_state_dim, width)
        self.action_time_mlp_in = nn.Linear(2 * width, width)
        self.action_time_mlp_out = nn.Linear(width, width)
        self.gradient_checkpointing_enabled = False

    def embed_prefix(
        self, images: Any, img_masks: Any, lang_tokens: Any, lang_masks: Any
    ) -> tuple[Tensor, Tensor, Tensor]:
        """PI0's, whose last mask is as long as the prefix also where a trace is given another.

        PI0 makes it of a list, which a trace would take for a constant.
        """
        embedded, present, _ = super().embed_prefix(images, img_masks, lang_tokens, lang_masks)
        return embedded, present, torch.zeros_like(present)

    def sample_actions(
        self,
        images: Any,
        img_masks: Any,
        lang_tokens: Any,
        lang_masks: Any,
        state: Tensor,
        noise: Any = None,
        **kwargs: Any,
    ) -> Tensor:
        """PI0's, from noise that is scaled by the configuration's `temperature`."""
        if noise is None:
            shape = (len(state), self.config.chunk_size, self.config.max_action_dim)
            noise = self.sample_noise(shape, state.device)
        with frozen(self):
            return super().sample_actions(
                images,
                img_masks,
                lang_tokens,
                lang_masks,
                state,
                noise=self.config.temperature * noise,
                **kwargs,
            )


class MiniPI0Policy(PI0Policy):
    """The policy. Unlike PI0's, a load that does not match raises."""

    config_class = MiniPI0Config
    name = "mini_pi0"

    def __init__(self, config: MiniPI0Config, **kwargs: Any) -> None:
        PreTrainedPolicy.__init__(self, config)
        config.validate_features()
        self.config = config
        self.init_rtc_processor()
        self.model = MiniPI0Pytorch(config, self.rtc_processor)
        self.model.to(config.device)
        self.reset()

    def _preprocess_images(self, batch: dict[str, Any]) -> tuple[list[Tensor], list[Tensor]]:
        """PI0's, of images that are scaled as in training: with antialiasing."""
        size = tuple(self.config.image_resolution)
        scaled = dict(batch)
        for key in self.config.image_features:
            if key in batch and batch[key].shape[-2:] != size:
                scaled[key] = torch.nn.functional.interpolate(
                    batch[key].float(), size, mode="bilinear", antialias=True
                )
        return super()._preprocess_images(scaled)

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: Any, **kwargs: Any) -> "MiniPI0Policy":
        """The checkpoint, tensor for tensor. Raises: RuntimeError when names or shapes differ."""
        from_pretrained = PreTrainedPolicy.from_pretrained.__func__
        options = {**kwargs, "strict": True}
        return cast(MiniPI0Policy, from_pretrained(cls, pretrained_name_or_path, **options))


@contextmanager
def frozen(module: nn.Module) -> Iterator[None]:
    """Inside, no parameter asks for a gradient.

    Where a weight asks for one, PyTorch's matmul folds a batch otherwise, also without gradients:
    actions would differ in their last bits between a loop that freezes its policy and one, such as
    lerobot-eval, that does not.
    """
    trained = [parameter for parameter in module.parameters() if parameter.requires_grad]
    for parameter in trained:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in trained:
            parameter.requires_grad_(True)


@contextmanager
def fused_attention() -> Iterator[None]:
    """Inside, the eager attention that lerobot's PI0 asks for is PyTorch's fused one.

    The numbers are the same, and a step takes a third less time. It can be entered again inside.
    """
    before = ALL_ATTENTION_FUNCTIONS.get("eager")
    ALL_ATTENTION_FUNCTIONS["eager"] = sdpa_attention_forward
    try:
        yield
    finally:
        if before is None:
            del ALL_ATTENTION_FUNCTIONS["eager"]
        else:
            ALL_ATTENTION_FUNCTIONS["eager"] = before


def vlm_config(config: MiniPI0Config) -> Any:
    """The configuration of the small PaliGemma.

    Its language head answers questions in the same words that instruct the policy.
    """
    vision = {
        "model_type": "siglip_vision_model",
        "image_size": config.image_resolution[0],
        "patch_size": config.patch,
        "hidden_size": config.vision_width,
        "intermediate_size": 2 * config.vision_width,
        "num_hidden_layers": config.vision_depth,
        "num_attention_heads": HEADS,
        "projection_dim": config.width,
        "projector_hidden_act": "gelu_fast",
        "vision_use_head": False,
    }
    parts: dict[str, Any] = {
        "text_config": _gemma_config(config, config.width).to_dict(),
        "vision_config": vision,
        "projection_dim": config.width,
    }
    paligemma: Any = PaliGemmaConfig(**parts)
    paligemma.image_token_index = len(config.words)
    paligemma._vocab_size = len(config.words)
    paligemma.text_config.use_adarms, paligemma.text_config.adarms_cond_dim = False, None
    return paligemma


def _gemma_config(config: MiniPI0Config, width: int) -> Any:
    """The configuration of the decoder, or of the action expert, which differ in width."""
    sizes: dict[str, Any] = {
        "vocab_size": len(config.words),
        "hidden_size": width,
        "intermediate_size": 2 * width,
        "num_hidden_layers": config.depth,
        "num_attention_heads": HEADS,
        "num_key_value_heads": 1,
        "head_dim": config.head_dim,
        "hidden_activation": "gelu_pytorch_tanh",
        "pad_token_id": 0,
    }
    gemma: Any = GemmaConfig(**sizes)
    gemma.use_adarms, gemma.adarms_cond_dim = False, None
    return gemma
