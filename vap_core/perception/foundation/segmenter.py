"""SAM 2.1, and the later models with its interface, on one image: masks of the objects inside boxes
(P 3.3).

The video checkpoint holds everything that the image predictor needs, so segmenter and tracker share
one model and one backbone per process.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from vap_core.base.types import Boxes, Rgb
from vap_core.perception.foundation.pixels import IMAGENET, Normalisation, to_model
from vap_core.perception.foundation.runtime import Runtime

BATCH = 16
"""Images per pass of the backbone on a GPU."""
CACHED_FRAMES = 8
"""First frames whose features are kept: several phrases and the tracker need the same ones."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageFeatures:
    """The backbone's maps of one image, at 1/4, 1/8 and 1/16 of the model's resolution."""

    fine: Float[Tensor, "1 c4 h4 w4"]
    middle: Float[Tensor, "1 c8 h8 w8"]
    coarse: Float[Tensor, "1 c h w"]
    positions: Float[Tensor, "p 1 c"]
    """Positional encoding of the coarse cells, row by row."""


@dataclass(frozen=True, slots=True, eq=False)
class DecodedMasks:
    """The mask decoder's output for each prompt, with k alternative masks."""

    logits: Float[Tensor, "n k h w"]
    quality: Float[Tensor, "n k"]
    tokens: Float[Tensor, "n k c"]
    presence: Float[Tensor, " n"]
    """Logit of the object being in view."""


class Sam:
    """Model, device, and the features of the last first frames."""

    def __init__(
        self, model: Any, runtime: Runtime, normalisation: Normalisation = IMAGENET
    ) -> None:
        self.model = model.requires_grad_(False).eval().to(runtime.device)
        self.runtime = runtime
        self.normalisation = normalisation
        self.side = int(model.config.image_size)
        with torch.inference_mode():
            self.positions: Float[Tensor, "1 c h w"] = (
                self.model.get_image_wide_positional_embeddings()
            )
        self._first_frames: OrderedDict[bytes, ImageFeatures] = OrderedDict()

    def encode(self, images: Sequence[Rgb]) -> list[ImageFeatures]:
        """The backbone's features, on a GPU in one pass for all images."""
        encoded: list[ImageFeatures] = []
        for batch in self.runtime.batches(images, BATCH):
            pixels = torch.cat([self.pixels(image) for image in batch])
            with self.runtime.inference():
                out = self.model.get_image_features(pixels)
            maps: list[Tensor] = []
            sizes = self.model.backbone_feature_sizes
            for flat, size in zip(out.fpn_hidden_states, sizes, strict=True):
                maps.append(flat.permute(1, 2, 0).unflatten(2, tuple(size)).float())
            fine, middle, coarse = maps
            positions = out.fpn_position_encoding[-1].float()
            for i in range(len(pixels)):
                encoded.append(ImageFeatures(fine[[i]], middle[[i]], coarse[[i]], positions[:, :1]))
        return encoded

    def pixels(self, image: Rgb) -> Float[Tensor, "1 3 s s"]:
        """The image as the backbone's input."""
        return to_model(image, self.side, self.runtime.device, self.normalisation)

    def encode_first_frame(self, image: Rgb) -> ImageFeatures:
        """The features of a first frame, which are kept.

        It passes the backbone alone, so that the result does not depend on other images.
        """
        key = sha256(repr(image.shape).encode() + image.tobytes()).digest()
        if key not in self._first_frames:
            (self._first_frames[key],) = self.encode([image])
        self._first_frames.move_to_end(key)
        while len(self._first_frames) > CACHED_FRAMES:
            self._first_frames.popitem(last=False)
        return self._first_frames[key]

    def decode(
        self,
        features: ImageFeatures,
        coarse: Float[Tensor, "b c h w"],
        sparse: Float[Tensor, "b p t c"],
        dense: Float[Tensor, "b c h w"],
        alternatives: bool,
    ) -> DecodedMasks:
        """Masks for p prompts on each of b coarse maps, in that order.

        `alternatives` keeps three masks of each.
        """
        b = len(coarse)
        with self.runtime.inference():
            logits, quality, tokens, presence = self.model.mask_decoder(
                image_embeddings=coarse,
                image_positional_embeddings=self.positions.expand(b, -1, -1, -1),
                sparse_prompt_embeddings=sparse,
                dense_prompt_embeddings=dense,
                multimask_output=alternatives,
                high_resolution_features=[
                    features.fine.expand(b, -1, -1, -1),
                    features.middle.expand(b, -1, -1, -1),
                ],
            )
        return DecodedMasks(
            logits=logits.flatten(0, 1).float(),
            quality=quality.flatten(0, 1).float(),
            tokens=tokens.flatten(0, 1),
            presence=presence.flatten().float(),
        )


class SamSegmenter:
    """The foundation segmenter.

    A box always gets a mask: its most likely pixels, where none is likely.
    """

    def __init__(self, sam: Sam) -> None:
        self.sam = sam

    def __call__(self, image: Rgb, boxes: Boxes) -> Bool[np.ndarray, "n h w"]:
        h, w = image.shape[:2]
        masks = np.zeros((len(boxes), h, w), bool)
        if not len(boxes):
            return masks
        decoded = self.decode_boxes(image, boxes)
        probability = to_pixels(decoded.logits, (h, w)).sigmoid()[:, 0].cpu().numpy()
        for i, box in enumerate(boxes.xyxy):
            masks[i] = _threshold(probability[i], box)
        return masks

    def decode_boxes(self, image: Rgb, boxes: Boxes) -> DecodedMasks:
        """One mask per box, at the decoder's resolution.

        A box is no ambiguous prompt, so there are no alternatives.
        """
        sam = self.sam
        h, w = image.shape[:2]
        features = sam.encode_first_frame(image)
        scale = torch.tensor([sam.side / w, sam.side / h] * 2)
        corners = (torch.from_numpy(boxes.xyxy) * scale)[None].to(sam.runtime.device)
        with torch.inference_mode():  # coordinates stay in single precision
            sparse, dense = sam.model.prompt_encoder(None, None, corners, None)
            coarse = features.coarse + sam.model.no_memory_embedding[..., None].transpose(1, 2)
            return sam.decode(
                features=features,
                coarse=coarse,
                sparse=sparse,
                dense=dense,
                alternatives=False,
            )


def to_pixels(logits: Float[Tensor, "n k h w"], hw: tuple[int, int]) -> Float[Tensor, "n k y x"]:
    """Mask logits at the image's resolution."""
    return F.interpolate(logits.float(), hw, mode="bilinear", align_corners=False)


def _threshold(
    probability: Float[np.ndarray, "h w"], box: Float[np.ndarray, "4"]
) -> Bool[np.ndarray, "h w"]:
    """The likely pixels; without any, those in the box at least half as likely as the best one."""
    likely = probability > 0.5
    if likely.any():
        return likely
    size = np.array(probability.shape[::-1])
    x0, y0 = np.clip(np.floor(box[:2]).astype(int), 0, size - 1)
    x1, y1 = np.clip(np.ceil(box[2:]).astype(int), (x0 + 1, y0 + 1), size)
    mask = np.zeros(probability.shape, bool)
    inside = probability[y0:y1, x0:x1]
    mask[y0:y1, x0:x1] = inside >= 0.5 * inside.max()
    return mask
