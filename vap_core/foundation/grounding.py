"""Grounding DINO: every box in a view that matches an open-vocabulary phrase (P 3.3, 5.1)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Int64

from vap_core.detect import NMS_IOU, TOP, box_iou
from vap_core.foundation.runtime import Runtime
from vap_core.values import Boxes, Rgb

THRESHOLD = 0.25
"""The models' published default for a box's score, the best probability over the phrase's tokens."""
BATCH = 8
"""Images per pass on a GPU; only images of one size share a pass, because padding changes what the backbone sees."""
MAX_ASPECT = 8
"""Longer strips are padded to this aspect ratio: resizing to 1333 pixels would leave nothing of their shorter side."""


class GroundingDino:
    """The foundation detector. `tokenizer` and `processor` are those that the weights were trained with."""

    def __init__(self, model: Any, tokenizer: Any, processor: Any, runtime: Runtime, *, threshold: float = THRESHOLD) -> None:
        self.model = model.requires_grad_(False).eval().to(runtime.device)
        self.tokenizer = tokenizer
        self.processor = processor
        self.runtime = runtime
        self.threshold = threshold

    def __call__(self, images: Sequence[Rgb], phrase: str, threshold: float | None = None) -> list[Boxes]:
        sizes: dict[tuple[int, ...], list[int]] = {}
        for i, image in enumerate(images):
            sizes.setdefault(image.shape, []).append(i)
        found: dict[int, Boxes] = {}
        for alike in sizes.values():
            for batch in self.runtime.batches(alike, BATCH):
                xyxy, score = self._propose([images[i] for i in batch], phrase)
                for i, boxes, scores in zip(batch, xyxy, score, strict=True):
                    found[i] = choose(boxes, scores, images[i].shape[:2], phrase, self.threshold if threshold is None else threshold)
        return [found[i] for i in range(len(images))]

    def _propose(self, images: Sequence[Rgb], phrase: str) -> tuple[Float32[np.ndarray, "b q 4"], Float32[np.ndarray, "b q"]]:
        """Every query's box, in pixels, and score; the images are of one size."""
        padded = [pad_strip(image) for image in images]
        inputs = self.processor(images=padded, input_data_format="channels_last", return_tensors="pt")
        words = self.tokenizer([caption(phrase)] * len(images), truncation=True, max_length=self.model.config.max_text_len, return_tensors="pt")
        with self.runtime.inference():
            out = self.model(**{key: value.to(self.runtime.device) for key, value in {**inputs, **words}.items()})
        h, w = padded[0].shape[:2]
        centre, size = out.pred_boxes.float()[..., :2], out.pred_boxes.float()[..., 2:]
        xyxy = torch.cat([centre - size / 2, centre + size / 2], -1) * torch.tensor([w, h, w, h], device=size.device)
        return xyxy.cpu().numpy(), out.logits.float().sigmoid().amax(-1).cpu().numpy()


def caption(phrase: str) -> str:
    """As the model was trained to read it: lower case, one phrase, ending in a dot."""
    return " ".join(phrase.lower().replace(".", " ").split()) + "."


def pad_strip(image: Rgb) -> Rgb:
    """A long strip gets black below or to the right; other images stay as they are."""
    h, w = image.shape[:2]
    least = -(-max(h, w) // MAX_ASPECT)
    if min(h, w) >= least:
        return image
    out = np.zeros((max(h, least), max(w, least), 3), np.uint8)
    out[:h, :w] = image
    return out


def choose(xyxy: Float32[np.ndarray, "q 4"], score: Float32[np.ndarray, " q"], hw: tuple[int, int], phrase: str, threshold: float) -> Boxes:
    """Clip to the image, and keep the best boxes that score `threshold`: at most `TOP`, none over `NMS_IOU` of a better one."""
    clipped = np.clip(xyxy, 0, (hw[1], hw[0], hw[1], hw[0])).astype(np.float32)
    real = (score >= threshold) & (clipped[:, 2:] - clipped[:, :2] >= 1).all(axis=1)
    order: Int64[np.ndarray, " n"] = np.flatnonzero(real)[np.argsort(-score[real], kind="stable")]
    keep: list[int] = []
    for i in order:
        if len(keep) < TOP and (not keep or box_iou(clipped[[i]], clipped[keep]).max() < NMS_IOU):
            keep.append(int(i))
    return Boxes(clipped[keep].reshape(-1, 4), score[keep].reshape(-1).astype(np.float32), phrase)
