"""What the trainings of the small models share: their sizes, and the question which image patches show the object that is meant."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from vap_core.training.films.demonstrations import SIDE
from vap_core.training.words import vocabulary


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Features and layers of a mini-PaliGemma and of the action expert that grows from it."""

    width: int = 128
    depth: int = 4
    vision_width: int = 128
    vision_depth: int = 4
    expert_width: int = 96

    def configuration(self) -> dict[str, Any]:
        """As MiniPI0Config takes them, with words and pictures."""
        return {
            "words": vocabulary(), "device": "cpu", "width": self.width, "depth": self.depth, "head_dim": self.width // 8,
            "vision_width": self.vision_width, "vision_depth": self.vision_depth, "expert_width": self.expert_width, "image_resolution": (SIDE, SIDE),
        }  # fmt: skip


class Shown(nn.Module):
    """Which patches show the object that is meant: asked of hidden states, in training only."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm, self.patch = nn.LayerNorm(width), nn.Linear(width, 1)

    def forward(self, hidden: Tensor) -> Any:
        return self.patch(self.norm(hidden)).squeeze(-1)


def shares(mask: np.ndarray, patch: int) -> np.ndarray:
    """Of every patch, view after view, the share that a mask (... x s x s) covers."""
    side = mask.shape[-1] // patch
    return mask.reshape(-1, side, patch, side, patch).mean((2, 4)).reshape(-1)


def looking(chance: Tensor, patches: Tensor) -> tuple[Tensor, Tensor]:
    """Cross-entropy of scores (b x p) with shares of patches, where anything is shown, and how often the best patch shows some of it.

    NaN, that share, where nothing is shown.
    """
    shown = patches.sum(1) > 0
    share = patches / patches.sum(1, keepdim=True).clamp(min=1e-6)
    heat = (
        -(share * chance.log_softmax(-1)).sum(1)[shown].mean() if shown.any() else torch.zeros(())
    )
    return heat, (patches.gather(1, chance.argmax(1, keepdim=True)).squeeze(1) > 0)[
        shown
    ].float().mean()
