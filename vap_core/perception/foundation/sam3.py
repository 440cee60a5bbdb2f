"""SAM 3's detector: every box in a view that matches a noun phrase.

Its tracker and segmenter have SAM 2's interface and need no code of their own.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from vap_core.base.types import Rgb
from vap_core.perception.foundation.detector import PhraseDetector
from vap_core.perception.foundation.pixels import CENTRED, to_model
from vap_core.perception.foundation.runtime import Runtime

THRESHOLD = 0.3
"""transformers' default for boxes. A box's score is the probability of the box times that of the
phrase being in view at all.
"""
MAX_TOKENS = 32
"""Of a phrase, its beginning and its end included; shorter ones are padded to it."""


class Sam3Detector(PhraseDetector):
    """SAM 3 with a phrase; `tokenizer` is the one that the weights were trained with."""

    threshold = THRESHOLD

    def __init__(self, model: Any, tokenizer: Any, runtime: Runtime) -> None:
        super().__init__(model, runtime)
        self.tokenizer = tokenizer
        self.side = int(model.config.image_size)

    def _propose(
        self, images: Sequence[Rgb], phrase: str
    ) -> tuple[Float32[np.ndarray, "b q 4"], Float32[np.ndarray, "b q"]]:
        device = self.runtime.device
        pixels = torch.cat([to_model(image, self.side, device, CENTRED) for image in images])
        words = self.words(phrase)
        with self.runtime.inference():
            features = self.model.get_text_features(**words).pooler_output
            out = self.model(
                pixel_values=pixels,
                text_embeds=features.expand(len(images), -1, -1),
                attention_mask=words["attention_mask"].expand(len(images), -1),
            )
        h, w = images[0].shape[:2]
        size = torch.tensor([w, h, w, h], device=device)
        xyxy = out.pred_boxes.float() * size
        score = out.pred_logits.float().sigmoid() * out.presence_logits.float().sigmoid()
        return xyxy.cpu().numpy(), score.cpu().numpy()

    def words(self, phrase: str) -> dict[str, Int64[Tensor, "1 t"]]:
        """The phrase as tokens, and which of them are not padding."""
        tokens = self.tokenizer(
            [" ".join(phrase.split())],
            padding="max_length",
            truncation=True,
            max_length=MAX_TOKENS,
            return_tensors="pt",
        )
        words: dict[str, Tensor] = {}
        for name in ("input_ids", "attention_mask"):
            words[name] = tokens[name].to(self.runtime.device)
        return words
