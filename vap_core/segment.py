"""Class-agnostic masks: the object inside each box (P 3.3).

The embedded segmenter cuts a square window around the box, shows it to the shallow half of frozen Lite0, and decodes a mask
from four resolutions. A prompt of two planes says which object is meant: the box, and, when tracking, a coarse guess of its mask.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from vap_core.features import CHANNELS, backbone, normalise
from vap_core.values import Boxes, Mask, Rgb
from vap_core.weights import load_weights

TAPS = ("b0", "b2", "b4", "b10")
SIDE = 112
"""Pixels of the square window in which a mask is decoded."""
CONTEXT = 0.25
"""The window's extent beyond the box on each side, as a fraction of the box's longer side."""
Window = tuple[int, int, int]
"""Left, top and side of a square, pixels; it may reach beyond the image."""


@runtime_checkable
class Segmenter(Protocol):
    """Masks the object inside each box."""

    def __call__(self, image: Rgb, boxes: Boxes) -> Bool[np.ndarray, "n h w"]:
        """One mask per box, in the box's order; n may be 0."""
        ...


class MaskHead(nn.Module):
    """Four feature maps and the prompt in, one logit per pixel of the window out."""

    def __init__(self, widths: tuple[int, int, int, int] = (16, 24, 32, 48)) -> None:
        super().__init__()
        self.lateral = nn.ModuleList(nn.Conv2d(CHANNELS[tap], width, 1) for tap, width in zip(TAPS, widths, strict=True))
        self.prompt = nn.ModuleList(nn.Conv2d(2, width, 3, padding=1) for width in widths)
        narrower = (12, *widths[:-1])
        self.mix = nn.ModuleList(nn.Conv2d(wide, narrow, 3, padding=1) for wide, narrow in zip(widths, narrower, strict=True))
        self.fine = nn.Sequential(nn.Conv2d(12 + 3 + 2, 12, 3, padding=1), nn.ReLU(), nn.Conv2d(12, 1, 3, padding=1))

    def forward(self, pixels: Float[Tensor, "n 3 h w"], taps: Mapping[str, Tensor], prompt: Float[Tensor, "n 2 h w"]) -> Float[Tensor, "n h w"]:
        """`pixels` normalised as for the backbone; `prompt` holds the box and the coarse mask, 0..1 (all 0 when there is none)."""
        x: Tensor | None = None
        for level in reversed(range(len(TAPS))):
            side = self.lateral[level](taps[TAPS[level]]) + self.prompt[level](F.avg_pool2d(prompt, 2 ** (level + 1)))
            x = side if x is None else side + F.interpolate(x, scale_factor=2, mode="nearest")
            x = F.relu(self.mix[level](F.relu(x)))
        assert x is not None
        x = F.interpolate(x, scale_factor=2, mode="bilinear")
        return self.fine(torch.cat([x, pixels, prompt], 1))[:, 0]


class LiteSegmenter:
    """The embedded segmenter. A box always gets a mask: its most likely pixels, where none is likely."""

    def __init__(self, head: MaskHead) -> None:
        self.head = head.requires_grad_(False).eval()

    def __call__(self, image: Rgb, boxes: Boxes) -> Bool[np.ndarray, "n h w"]:
        chance = self.chance(image, boxes.xyxy)
        best = chance.reshape(len(chance), -1).max(axis=1) if len(chance) else np.zeros(0)
        return chance > np.minimum(0.5, 0.5 * best)[:, None, None]

    @torch.inference_mode()
    def chance(self, image: Rgb, xyxy: Float[np.ndarray, "n 4"], coarse: Float32[np.ndarray, "n h w"] | None = None) -> Float32[np.ndarray, "n h w"]:
        """Probability of every pixel to belong to each box's object; zero outside its window. `coarse` guesses the masks, 0..1."""
        out = np.zeros((len(xyxy), *image.shape[:2]), np.float32)
        for i, box in enumerate(xyxy):
            win = window(box)
            pixels = normalise(torch.from_numpy(cut(image, win))[None])
            planes = np.stack([cut(box_plane(box, image.shape[:2]), win, 0), np.zeros((SIDE, SIDE), np.uint8)])
            if coarse is not None:
                planes[1] = cut((coarse[i] * 255).astype(np.uint8), win, 0)
            prompt = torch.from_numpy(planes.astype(np.float32) / 255)[None]
            logits = self.head(pixels, backbone()(pixels, TAPS), prompt)[0]
            paste(out[i], logits.sigmoid().numpy(), win)
        return out


def window(box_xyxy: Float[np.ndarray, "4"], context: float = CONTEXT) -> Window:
    """The square around a box with context."""
    x0, y0, x1, y1 = (float(v) for v in box_xyxy)
    side = max(4, round(max(x1 - x0, y1 - y0) * (1 + 2 * context)))
    return round((x0 + x1 - side) / 2), round((y0 + y1 - side) / 2), side


def cut(image: UInt8[np.ndarray, "h w *c"], win: Window, fill: int = 127, size: int = SIDE) -> UInt8[np.ndarray, "s s *c"]:
    """The window resized to `size`; what lies beyond the image is `fill`."""
    left, top, side = win
    h, w = image.shape[:2]
    x0, y0, x1, y1 = max(left, 0), max(top, 0), min(left + side, w), min(top + side, h)
    square = np.full((side, side, *image.shape[2:]), fill, np.uint8)
    if x1 > x0 and y1 > y0:
        square[y0 - top : y1 - top, x0 - left : x1 - left] = image[y0:y1, x0:x1]
    return cv2.resize(square, (size, size), interpolation=cv2.INTER_AREA if side > size else cv2.INTER_LINEAR)


def paste(image: Float32[np.ndarray, "h w"], patch: Float32[np.ndarray, "s s"], win: Window) -> None:
    """Write a square patch back where its window was cut, in place."""
    left, top, side = win
    h, w = image.shape
    x0, y0, x1, y1 = max(left, 0), max(top, 0), min(left + side, w), min(top + side, h)
    if x1 > x0 and y1 > y0:
        grown = cv2.resize(patch, (side, side), interpolation=cv2.INTER_LINEAR)
        image[y0:y1, x0:x1] = grown[y0 - top : y1 - top, x0 - left : x1 - left]


def box_plane(box_xyxy: Float[np.ndarray, "4"], hw: Sequence[int]) -> UInt8[np.ndarray, "h w"]:
    """255 inside the box, 0 outside."""
    plane = np.zeros(tuple(hw), np.uint8)
    x0, y0, x1, y1 = (max(0, round(float(v))) for v in box_xyxy)
    plane[y0:y1, x0:x1] = 255
    return plane


def iou(one: Mask, other: Mask) -> float:
    """Intersection over union; two empty masks agree."""
    union = int((one | other).sum())
    return int((one & other).sum()) / union if union else 1.0


def bounds(mask: Mask) -> Float32[np.ndarray, "4"] | None:
    """The box of a mask, pixels, far corner exclusive; None when it is empty."""
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return np.array([cols[0], rows[0], cols[-1] + 1, rows[-1] + 1], np.float32) if len(rows) else None


@cache
def load() -> LiteSegmenter:
    """The shipped segmenter.

    Raises:
        MissingWeights: data/weights/perception.safetensors is absent or not what the manifest promises.
    """
    weights, _ = load_weights("perception.safetensors", "segment.")
    head = MaskHead()
    head.load_state_dict(weights)
    return LiteSegmenter(head)
