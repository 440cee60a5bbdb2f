"""The networks of the foundation stacks: detector, encoder and segmenter behind the protocols."""

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from vap_core.base.errors import device_name
from vap_core.base.types import Boxes, Rgb
from vap_core.perception.boxes import suppress_overlaps


@dataclass(frozen=True)
class Normalisation:
    """Mean and standard deviation per channel, of levels from 0 to 1."""

    mean: tuple[float, float, float]
    std: tuple[float, float, float]


IMAGENET = Normalisation(mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
CENTRED = Normalisation(mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))
"""From -1 to 1."""


def to_model(
    image: Rgb, side: int, device: torch.device, normalisation: Normalisation = IMAGENET
) -> Float[Tensor, "1 3 s s"]:
    """The image as the model's input.

    It is stretched to a square with antialiased bilinear resampling in 8 bits, and normalised.
    """
    stretched = F.interpolate(
        torch.from_numpy(image.copy()).permute(2, 0, 1)[None],
        (side, side),
        mode="bilinear",
        antialias=True,
    )
    mean = torch.tensor(normalisation.mean, device=device)[:, None, None]
    std = torch.tensor(normalisation.std, device=device)[:, None, None]
    return (stretched.to(device).float() / 255 - mean) / std


@dataclass(frozen=True)
class Runtime:
    """A device and how it computes.

    `half` is the half-precision type of matrix products (None: everything in float32); `batched`
    says whether inputs share passes.
    """

    device: torch.device
    half: torch.dtype | None
    batched: bool

    def batches[T](self, items: Sequence[T], limit: int) -> list[Sequence[T]]:
        """What goes through a network together: up to `limit` items, or each alone."""
        size = limit if self.batched else 1
        return [items[start : start + size] for start in range(0, len(items), size)]

    @contextmanager
    def inference(self) -> Iterator[None]:
        """No gradients, and autocast where half precision is used."""
        autocast = torch.autocast(
            self.device.type, self.half or torch.bfloat16, enabled=self.half is not None
        )
        with torch.inference_mode(), autocast:
            yield


def select_runtime(device: str | None = None) -> Runtime:
    """The runtime of a device: the argument, else `VAP_DEVICE`, else a GPU where there is one.

    Raises: UnknownName: no such device on this machine.
    """
    chosen = torch.device(device_name(device))
    if chosen.type != "cuda":
        return Runtime(chosen, None, batched=False)
    half = torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float16
    return Runtime(chosen, half, batched=True)


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
                    hw = images[i].shape[:2]
                    proposals[i] = select_boxes(xyxy[row], score[row], hw, phrase, threshold)
        return proposals

    @abstractmethod
    def _propose(
        self, images: Sequence[Rgb], phrase: str
    ) -> tuple[Float32[np.ndarray, "b q 4"], Float32[np.ndarray, "b q"]]:
        """Every query's box, in pixels, and score; the images are of one size."""


class GroundingDino(PhraseDetector):
    """The foundation detector.

    `tokenizer` is the one that the weights were trained with.
    """

    threshold = THRESHOLD

    def __init__(self, model: Any, tokenizer: Any, runtime: Runtime) -> None:
        from transformers.models.grounding_dino.image_processing_pil_grounding_dino import (
            GroundingDinoImageProcessorPil,
        )

        super().__init__(model, runtime)
        self.tokenizer = tokenizer
        self.processor = GroundingDinoImageProcessorPil()

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
        inputs = {k: tensor.to(self.runtime.device) for k, tensor in {**pixels, **words}.items()}
        with self.runtime.inference():
            out = self.model(**inputs)
        h, w = padded[0].shape[:2]
        centre, size = out.pred_boxes.float().split(2, -1)
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


SIDE = 224
"""Pixels of the square in which a crop is embedded."""
ENCODER_BATCH = 32


@dataclass(frozen=True)
class CropRecipe:
    """How a network's crops are scaled and normalised, as its published processor does it.

    `resample` is Pillow's number of the filter: 2 bilinear, 3 bicubic.
    """

    mean: tuple[float, float, float] = IMAGENET.mean
    std: tuple[float, float, float] = IMAGENET.std
    resample: int = 3
    pooled: bool = False
    """The network pools its tokens by attention; else its [CLS] token is the embedding."""

    @property
    def grey(self) -> tuple[int, int, int]:
        """The colour that normalises to zero."""
        r, g, b = self.mean
        return round(255 * r), round(255 * g), round(255 * b)


DINO = CropRecipe()
DINOV3 = CropRecipe(resample=2)
SIGLIP = CropRecipe(mean=CENTRED.mean, std=CENTRED.std, pooled=True)


class CropEncoder:
    """A network whose [CLS] token, or pool of all tokens, is the embedding.

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
        for batch in self.runtime.batches(crops, ENCODER_BATCH):
            pixels = self.processor(
                images=[pad_to_square(crop, self.recipe.grey) for crop in batch],
                input_data_format="channels_last",
                return_tensors="pt",
            )["pixel_values"]
            with self.runtime.inference():
                out = self.model(pixels.to(self.runtime.device))
                row = out.pooler_output if self.recipe.pooled else out.last_hidden_state[:, 0]
                rows.append(F.normalize(row.float(), dim=1).cpu().numpy())
        return np.concatenate(rows)


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


SEGMENTER_BATCH = 16
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
        for batch in self.runtime.batches(images, SEGMENTER_BATCH):
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
            return sam.decode(features, coarse, sparse, dense, alternatives=False)


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


SAM3_THRESHOLD = 0.3
"""transformers' default for boxes. A box's score is the probability of the box times that of the
phrase being in view at all.
"""
MAX_TOKENS = 32
"""Of a phrase, its beginning and its end included; shorter ones are padded to it."""


class Sam3Detector(PhraseDetector):
    """SAM 3 with a phrase; `tokenizer` is the one that the weights were trained with."""

    threshold = SAM3_THRESHOLD

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
        return {k: tokens[k].to(self.runtime.device) for k in ("input_ids", "attention_mask")}
