"""Every box in a view that matches an open-vocabulary phrase (P 3.3): what all detectors of phrases
do, and Grounding DINO, the paper's (P 5.1).
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from vap_core.base.types import Boxes, Rgb
from vap_core.perception.boxes import suppress_overlaps
from vap_core.perception.foundation.runtime import Runtime

THRESHOLD = 0.25
"""Grounding DINO's published default. A box's score is its best probability over the phrase's
tokens.
"""
BATCH = 8
"""Images per pass on a GPU; only images of one size share a pass, because padding changes the
backbone's features."""
MAX_ASPECT = 8
"""Longer strips are padded to this aspect ratio: resizing their longer side to 1333 pixels would
leave nothing of the shorter one."""


class PhraseDetector(ABC):
    """A network that proposes boxes for a phrase; the best ones are kept.

    `threshold` is the least score where the caller names none.
    """

    threshold: float

    def __init__(self, model: Any, runtime: Runtime) -> None:
        self.model = model.requires_grad_(False).eval().to(runtime.device)
        self.runtime = runtime

    def __call__(
        self, images: Sequence[Rgb], phrase: str, threshold: float | None = None
    ) -> list[Boxes]:
        if threshold is None:
            threshold = self.threshold
        by_size: dict[tuple[int, ...], list[int]] = {}
        for i, image in enumerate(images):
            by_size.setdefault(image.shape, []).append(i)
        proposals = [Boxes.empty(phrase)] * len(images)
        for same_size in by_size.values():
            for batch in self.runtime.batches(same_size, BATCH):
                xyxy, score = self._propose([images[i] for i in batch], phrase)
                for row, i in enumerate(batch):
                    proposals[i] = select_boxes(
                        xyxy=xyxy[row],
                        score=score[row],
                        hw=images[i].shape[:2],
                        phrase=phrase,
                        threshold=threshold,
                    )
        return proposals

    @abstractmethod
    def _propose(
        self, images: Sequence[Rgb], phrase: str
    ) -> tuple[Float32[np.ndarray, "b q 4"], Float32[np.ndarray, "b q"]]:
        """Every query's box, in pixels, and score; the images are of one size."""


class GroundingDino(PhraseDetector):
    """The foundation detector.

    `tokenizer` and `processor` are those that the weights were trained with.
    """

    threshold = THRESHOLD

    def __init__(self, model: Any, tokenizer: Any, processor: Any, runtime: Runtime) -> None:
        super().__init__(model, runtime)
        self.tokenizer = tokenizer
        self.processor = processor

    def _propose(
        self, images: Sequence[Rgb], phrase: str
    ) -> tuple[Float32[np.ndarray, "b q 4"], Float32[np.ndarray, "b q"]]:
        padded = [pad_strip(image) for image in images]
        pixels = self.processor(
            images=padded, input_data_format="channels_last", return_tensors="pt"
        )
        words = self.tokenizer(
            [text_query(phrase)] * len(images),
            truncation=True,
            max_length=self.model.config.max_text_len,
            return_tensors="pt",
        )
        inputs: dict[str, torch.Tensor] = {}
        for key, tensor in {**pixels, **words}.items():
            inputs[key] = tensor.to(self.runtime.device)
        with self.runtime.inference():
            out = self.model(**inputs)
        h, w = padded[0].shape[:2]
        centre = out.pred_boxes.float()[..., :2]
        size = out.pred_boxes.float()[..., 2:]
        corners = torch.cat([centre - size / 2, centre + size / 2], -1)
        xyxy = corners * torch.tensor([w, h, w, h], device=size.device)
        score = out.logits.float().sigmoid().amax(-1)
        return xyxy.cpu().numpy(), score.cpu().numpy()


def text_query(phrase: str) -> str:
    """The phrase as the model was trained to read it: lower case, ending in a dot."""
    return " ".join(phrase.lower().replace(".", " ").split()) + "."


def pad_strip(image: Rgb) -> Rgb:
    """A long strip gets black below or to the right; other images stay as they are."""
    h, w = image.shape[:2]
    min_side = -(-max(h, w) // MAX_ASPECT)
    if min(h, w) >= min_side:
        return image
    out = np.zeros((max(h, min_side), max(w, min_side), 3), np.uint8)
    out[:h, :w] = image
    return out


def select_boxes(
    xyxy: Float32[np.ndarray, "q 4"],
    score: Float32[np.ndarray, " q"],
    hw: tuple[int, int],
    phrase: str,
    threshold: float,
) -> Boxes:
    """Clip to the image and keep the best boxes that score `threshold`, overlaps removed."""
    h, w = hw
    clipped = np.clip(xyxy, 0, (w, h, w, h)).astype(np.float32)
    large_enough = (clipped[:, 2:] - clipped[:, :2] >= 1).all(axis=1)
    selected = np.flatnonzero((score >= threshold) & large_enough)
    kept = selected[suppress_overlaps(clipped[selected], score[selected])]
    return Boxes(clipped[kept], score[kept], phrase)
