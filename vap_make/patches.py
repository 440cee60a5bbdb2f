"""What the trainings of the small models share: their configuration, and scores of patches."""

from typing import Any

import numpy as np
from torch import Tensor, nn

from vap_make.films.demonstrations import SIDE
from vap_make.recipe import Sizes
from vap_make.words import vocabulary


def model_options(sizes: Sizes) -> dict[str, Any]:
    """As MiniPI0Config takes sizes, with words and pictures."""
    return {
        "words": vocabulary(),
        "device": "cpu",
        "width": sizes.width,
        "depth": sizes.depth,
        "head_dim": sizes.width // 8,
        "vision_width": sizes.vision_width,
        "vision_depth": sizes.vision_depth,
        "expert_width": sizes.expert_width,
        "image_resolution": (SIDE, SIDE),
    }


class PatchScores(nn.Module):
    """Scores how well patches show the object that is meant; in training only."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.patch = nn.Linear(width, 1)

    def forward(self, hidden: Tensor) -> Any:
        """Scores (b x p) of the patches, from hidden states (b x p x d)."""
        return self.patch(self.norm(hidden)).squeeze(-1)


def patch_shares(mask: np.ndarray, patch: int) -> np.ndarray:
    """Of every patch, view after view, the share that a mask (... x s x s) covers."""
    side = mask.shape[-1] // patch
    patches = mask.reshape(-1, side, patch, side, patch)
    return patches.mean((2, 4)).reshape(-1)


def patch_loss(scores: Tensor, patches: Tensor) -> tuple[Tensor, Tensor]:
    """Cross-entropy of scores with shares of patches (both b x p), and the share of hits.

    A hit is a best patch that shows some of the object. Both are over the rows in which anything
    is shown; where nothing is, the cross-entropy is 0 and the share of hits NaN.
    """
    shown = patches.sum(1) > 0
    target = patches / patches.sum(1, keepdim=True).clamp(min=1e-6)
    if shown.any():
        loss = -(target * scores.log_softmax(-1)).sum(1)[shown].mean()
    else:
        loss = scores.new_zeros(())
    best = scores.argmax(1, keepdim=True)
    hits = patches.gather(1, best).squeeze(1) > 0
    return loss, hits[shown].float().mean()
