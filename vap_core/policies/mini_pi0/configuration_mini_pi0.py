"""The sizes of a mini-pi0, in its checkpoint's config.json rather than in the source."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig
from lerobot.policies.pi0.configuration_pi0 import PI0Config

HEADS = 8
"""Attention heads of decoder and expert; PI0's attention takes no other number."""


@PreTrainedConfig.register_subclass("mini_pi0")
@dataclass
class MiniPI0Config(PI0Config):
    """PI0's options, and numbers where it has variants.

    They are those of a SigLIP tower and a Gemma decoder (together a small PaliGemma), and of the
    action expert. Widths are features, `patch` pixels. Decoder and expert have the same depth and
    the same `head_dim`.
    """

    image_resolution: tuple[int, int] = (112, 112)
    patch: int = 16
    vision_width: int = 128
    vision_depth: int = 4
    width: int = 128
    depth: int = 4
    head_dim: int = 16
    expert_width: int = 96
    chunk_size: int = 4
    n_action_steps: int = 4
    tokenizer_max_length: int = 40
    num_inference_steps: int = 5
    temperature: float = 1.0
    """Scale of the sampling noise: below 1 the actions keep closer to what was demonstrated most, 0
    draws none."""
    vlm: str = ""
    """SHA-256 of the mini-PaliGemma that it was initialised from. Learned words mean the same in
    both, unless the policy's training moved the embeddings of words, as those of before the recipe
    did."""
    words: tuple[str, ...] = ()
    """The vocabulary: token i is word i; see processor_mini_pi0."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.words = tuple(self.words)
        height, width = self.image_resolution
        if height != width:
            raise ValueError(
                f"MiniPI0Config: image_resolution is {height}x{width}; the tower reads squares."
            )
        if height % self.patch or self.vision_width % HEADS:
            raise ValueError(
                f"MiniPI0Config: {self.image_resolution} pixels do not part into patches of "
                f"{self.patch}, or {self.vision_width} features by {HEADS}"
            )
