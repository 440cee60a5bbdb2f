"""Encoders: an object's appearance as one L2-normalised row (P 3.3, 5.1).

DINOv2, the paper's, and DINOv3 give the final layer's [CLS] token, SigLIP 2 its pooled token.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from vap_core.base.types import Rgb
from vap_core.perception.foundation.pixels import CENTRED, IMAGENET
from vap_core.perception.foundation.runtime import Runtime

SIDE = 224
"""Pixels of the square in which a crop is embedded."""
BATCH = 32


@dataclass(frozen=True)
class CropRecipe:
    """How a network's crops are scaled and normalised, as its published processor does it.

    `resample` is Pillow's number of the filter: 2 bilinear, 3 bicubic.
    """

    mean: tuple[float, float, float] = IMAGENET.mean
    std: tuple[float, float, float] = IMAGENET.std
    resample: int = 3

    @property
    def grey(self) -> tuple[int, int, int]:
        """The colour that normalises to zero."""
        red, green, blue = (round(255 * level) for level in self.mean)
        return red, green, blue


DINO = CropRecipe()
DINOV3 = CropRecipe(resample=2)
SIGLIP = CropRecipe(mean=CENTRED.mean, std=CENTRED.std, resample=3)


class CropEncoder:
    """A network whose [CLS] token is the embedding.

    A crop is padded to a square, so that nothing of a long object is cut off: no centre crop.
    """

    def __init__(self, model: Any, recipe: CropRecipe, name: str, runtime: Runtime) -> None:
        from transformers.models.bit.image_processing_pil_bit import BitImageProcessorPil

        self.model = model.requires_grad_(False).eval().to(runtime.device)
        self.recipe = recipe
        self.processor = BitImageProcessorPil(
            size={"height": SIDE, "width": SIDE},
            do_center_crop=False,
            resample=recipe.resample,
            image_mean=list(recipe.mean),
            image_std=list(recipe.std),
        )
        self.name = name
        self.runtime = runtime
        self.dim = int(model.config.hidden_size)

    def __call__(self, crops: Sequence[Rgb]) -> Float32[np.ndarray, "n d"]:
        rows = [np.zeros((0, self.dim), np.float32)]
        for batch in self.runtime.batches(crops, BATCH):
            rows.append(self._embed(batch))
        return np.concatenate(rows)

    def _embed(self, crops: Sequence[Rgb]) -> Float32[np.ndarray, "n d"]:
        pixels = self.processor(
            images=[pad_to_square(crop, self.recipe.grey) for crop in crops],
            input_data_format="channels_last",
            return_tensors="pt",
        )["pixel_values"]
        with self.runtime.inference():
            row = self._row(self.model(pixels.to(self.runtime.device))).float()
            return F.normalize(row, dim=1).cpu().numpy()

    def _row(self, out: Any) -> Tensor:
        """The embedding in the network's output."""
        return out.last_hidden_state[:, 0]


class PooledEncoder(CropEncoder):
    """A network that pools its tokens by attention."""

    def _row(self, out: Any) -> Tensor:
        return out.pooler_output


def pad_to_square(crop: Rgb, grey: tuple[int, int, int] = DINO.grey) -> Rgb:
    """The crop in the middle of a grey square; a larger one than the model takes is reduced
    first.
    """
    h, w = crop.shape[:2]
    scale = SIDE / max(h, w)
    if scale < 1:
        h = max(1, round(h * scale))
        w = max(1, round(w * scale))
        crop = cv2.resize(crop, (w, h), interpolation=cv2.INTER_AREA)
    side = max(h, w)
    out = np.full((side, side, 3), grey, np.uint8)
    top = (side - h) // 2
    left = (side - w) // 2
    out[top : top + h, left : left + w] = crop
    return out
