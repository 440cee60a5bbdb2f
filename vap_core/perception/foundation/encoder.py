"""DINOv2: an object's appearance as the final layer's [CLS] token, L2-normalised (P 3.3, 5.1)."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32
from torch.nn import functional as F  # noqa: N812

from vap_core.base.types import Rgb
from vap_core.perception.foundation.runtime import Runtime

SIDE = 224
"""Pixels of the square in which a crop is embedded."""
BATCH = 32
GREY = (124, 116, 104)
"""ImageNet's mean, which normalises to zero."""


class DinoEncoder:
    """The foundation encoder.

    A crop is padded to a square, so that nothing of a long object is cut off.
    """

    def __init__(self, model: Any, processor: Any, name: str, runtime: Runtime) -> None:
        self.model = model.requires_grad_(False).eval().to(runtime.device)
        self.processor = processor
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
            images=[pad_to_square(crop) for crop in crops],
            input_data_format="channels_last",
            return_tensors="pt",
        )["pixel_values"]
        with self.runtime.inference():
            cls = self.model(pixels.to(self.runtime.device)).last_hidden_state[:, 0].float()
            return F.normalize(cls, dim=1).cpu().numpy()


def pad_to_square(crop: Rgb) -> Rgb:
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
    out = np.full((side, side, 3), GREY, np.uint8)
    top = (side - h) // 2
    left = (side - w) // 2
    out[top : top + h, left : left + w] = crop
    return out
