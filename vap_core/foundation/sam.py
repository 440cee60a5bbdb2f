"""SAM 2.1 on one image: masks of the objects inside boxes (P 3.3). The model it holds serves the tracker too.

The video checkpoint holds everything that the image predictor needs, so there is one model and one backbone per process.
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

from vap_core.foundation.runtime import Runtime
from vap_core.values import Boxes, Rgb

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
BATCH = 16
"""Images per pass of the backbone on a GPU."""
REMEMBERED = 8
"""Opening frames whose features are kept, because several phrases and the tracker ask for the same ones."""


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """What the backbone saw of one image: maps at a quarter, an eighth and a sixteenth of the model's resolution."""

    fine: Float[Tensor, "1 c4 h4 w4"]
    middle: Float[Tensor, "1 c8 h8 w8"]
    coarse: Float[Tensor, "1 c h w"]
    places: Float[Tensor, "p 1 c"]
    """Positional encoding of the coarse cells, row by row."""


@dataclass(frozen=True, slots=True, eq=False)
class Decoded:
    """What the mask decoder says of each prompt, with k alternative masks."""

    logits: Float[Tensor, "n k h w"]
    quality: Float[Tensor, "n k"]
    tokens: Float[Tensor, "n k c"]
    presence: Float[Tensor, " n"]
    """Logit of the object being in view."""


class Sam:
    """Model, device, and the features of the last opening frames."""

    def __init__(self, model: Any, runtime: Runtime) -> None:
        self.model = model.requires_grad_(False).eval().to(runtime.device)
        self.runtime = runtime
        self.side = int(model.config.image_size)
        with torch.inference_mode():
            self.places: Float[Tensor, "1 c h w"] = self.model.get_image_wide_positional_embeddings()
        self._seen: OrderedDict[bytes, Features] = OrderedDict()

    def look(self, images: Sequence[Rgb]) -> list[Features]:
        """The backbone, on a GPU in one pass for all images."""
        found = []
        for batch in self.runtime.batches(images, BATCH):
            pixels = torch.cat([to_model(image, self.side, self.runtime.device) for image in batch])
            with self.runtime.inference():
                out = self.model.get_image_features(pixels)
            fine, middle, coarse = (
                flat.permute(1, 2, 0).unflatten(2, tuple(size)).float()
                for flat, size in zip(out.fpn_hidden_states, self.model.backbone_feature_sizes, strict=True)
            )
            places = out.fpn_position_encoding[-1].float()
            found += [Features(fine[[i]], middle[[i]], coarse[[i]], places[:, :1]) for i in range(len(pixels))]
        return found

    def recall(self, image: Rgb) -> Features:
        """The backbone on an opening frame, always alone, so that the answer does not depend on what was asked before."""
        key = sha256(repr(image.shape).encode() + image.tobytes()).digest()
        if key not in self._seen:
            (self._seen[key],) = self.look([image])
        self._seen.move_to_end(key)
        while len(self._seen) > REMEMBERED:
            self._seen.popitem(last=False)
        return self._seen[key]

    def decode(
        self, seen: Features, coarse: Float[Tensor, "b c h w"], sparse: Float[Tensor, "b p t c"], dense: Float[Tensor, "b c h w"], several: bool
    ) -> Decoded:
        """Masks for p prompts on each of b coarse maps, in that order; `several` keeps the three alternatives of each."""
        b = len(coarse)
        with self.runtime.inference():
            logits, quality, tokens, presence = self.model.mask_decoder(
                image_embeddings=coarse,
                image_positional_embeddings=self.places.expand(b, -1, -1, -1),
                sparse_prompt_embeddings=sparse,
                dense_prompt_embeddings=dense,
                multimask_output=several,
                high_resolution_features=[seen.fine.expand(b, -1, -1, -1), seen.middle.expand(b, -1, -1, -1)],
            )
        return Decoded(logits.flatten(0, 1).float(), quality.flatten(0, 1).float(), tokens.flatten(0, 1), presence.flatten().float())


class SamSegmenter:
    """The foundation segmenter. A box always gets a mask: its most likely pixels, where none is likely."""

    def __init__(self, sam: Sam) -> None:
        self.sam = sam

    def __call__(self, image: Rgb, boxes: Boxes) -> Bool[np.ndarray, "n h w"]:
        h, w = image.shape[:2]
        if not len(boxes):
            return np.zeros((0, h, w), bool)
        chance = to_pixels(self.logits(image, boxes).logits, (h, w)).sigmoid()[:, 0].cpu().numpy()
        return np.stack([_mask(each, box) for each, box in zip(chance, boxes.xyxy, strict=True)])

    def logits(self, image: Rgb, boxes: Boxes) -> Decoded:
        """One mask per box, at the decoder's resolution; a box is no ambiguous prompt, so there are no alternatives."""
        sam, (h, w) = self.sam, image.shape[:2]
        seen = sam.recall(image)
        scale = torch.tensor([sam.side / w, sam.side / h] * 2)
        corners = (torch.from_numpy(boxes.xyxy) * scale)[None].to(sam.runtime.device)
        with torch.inference_mode():  # coordinates stay in single precision
            sparse, dense = sam.model.prompt_encoder(None, None, corners, None)
            coarse = seen.coarse + sam.model.no_memory_embedding[..., None].transpose(1, 2)
            return sam.decode(seen, coarse, sparse, dense, several=False)


def to_model(image: Rgb, side: int, device: torch.device) -> Float[Tensor, "1 3 s s"]:
    """Stretched to a square with antialiased bilinear resampling in 8 bits, and normalised as on ImageNet."""
    pixels = F.interpolate(torch.from_numpy(image.copy()).permute(2, 0, 1)[None], (side, side), mode="bilinear", antialias=True)
    mean, std = (torch.tensor(row, device=device)[:, None, None] for row in (MEAN, STD))
    return (pixels.to(device).float() / 255 - mean) / std


def to_pixels(logits: Float[Tensor, "n k h w"], hw: tuple[int, int]) -> Float[Tensor, "n k y x"]:
    """Mask logits at the image's resolution."""
    return F.interpolate(logits.float(), hw, mode="bilinear", align_corners=False)


def _mask(chance: Float[np.ndarray, "h w"], box: Float[np.ndarray, "4"]) -> Bool[np.ndarray, "h w"]:
    if (chance > 0.5).any():
        return chance > 0.5
    far = np.array(chance.shape[::-1])
    x0, y0 = np.clip(np.floor(box[:2]).astype(int), 0, far - 1)
    x1, y1 = np.clip(np.ceil(box[2:]).astype(int), (x0 + 1, y0 + 1), far)
    out = np.zeros(chance.shape, bool)
    inside = chance[y0:y1, x0:x1]
    out[y0:y1, x0:x1] = inside >= 0.5 * inside.max()
    return out
