"""Class-agnostic masks: the object inside each box (P 3.3).

The embedded segmenter cuts a square window around the box, passes it through the shallow half of
frozen Lite0, and decodes a mask from four resolutions. A prompt of two planes says which object is
meant: the box and, when tracking, a coarse guess of its mask.
"""

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from vap_core.base.types import Boxes, Mask, Rgb
from vap_core.perception.embedded.networks import (
    GREY,
    PERCEPTION,
    Network,
    head_weights,
    load_network,
    load_weights,
    trunk_weights,
)

GRAPH = "segmenter.onnx"
MASK_TAPS = ("b0", "b2", "b4", "b10")
SIDE = 112
"""Pixels of the square window in which a mask is decoded."""
CONTEXT = 0.25
"""The window's extent beyond the box on each side, as a fraction of the box's longer side."""
Window = tuple[int, int, int]
"""Left, top and side of a square, pixels; it may reach beyond the image."""


class LiteSegmenter:
    """The embedded segmenter; `network` computes a `mask_network.MaskNetwork`.

    A box always gets a mask: its most likely pixels, where none is likely.
    """

    def __init__(self, network: Network) -> None:
        self.network = network

    def __call__(self, image: Rgb, boxes: Boxes) -> Bool[np.ndarray, "n h w"]:
        return likely_pixels(self.mask_probability(image, boxes.xyxy))

    def mask_probability(
        self,
        image: Rgb,
        xyxy: Float[np.ndarray, "n 4"],
        coarse: Float32[np.ndarray, "n h w"] | None = None,
    ) -> Float32[np.ndarray, "n h w"]:
        """Probability of every pixel to belong to each box's object; zero outside its window.

        `coarse` guesses the masks, 0..1.
        """
        out = np.zeros((len(xyxy), *image.shape[:2]), np.float32)
        for i, box in enumerate(xyxy):
            window = window_around(box)
            planes = np.zeros((2, SIDE, SIDE), np.uint8)
            planes[0] = cut(box_plane(box, image.shape[:2]), window, fill=0)
            if coarse is not None:
                planes[1] = cut((coarse[i] * 255).astype(np.uint8), window, fill=0)
            (probability,) = self.network(cut(image, window)[None], planes[None])
            paste(out[i], probability[0], window)
        return out


def likely_pixels(probability: Float32[np.ndarray, "n h w"]) -> Bool[np.ndarray, "n h w"]:
    """The masks of more than even probability, or of more than half of the greatest."""
    best = probability.max(axis=(1, 2), initial=0.0)
    return probability > np.minimum(0.5, 0.5 * best)[:, None, None]


def window_around(box_xyxy: Float[np.ndarray, "4"]) -> Window:
    """The square around a box with context."""
    x0, y0, x1, y1 = box_xyxy.tolist()
    side = max(4, round(max(x1 - x0, y1 - y0) * (1 + 2 * CONTEXT)))
    return round((x0 + x1 - side) / 2), round((y0 + y1 - side) / 2), side


def cut(
    image: UInt8[np.ndarray, "h w *c"], window: Window, fill: int = GREY
) -> UInt8[np.ndarray, "s s *c"]:
    """The window resized to `SIDE`; what lies beyond the image is `fill`."""
    left, top, side = window
    x0, y0, x1, y1 = _visible_part(window, image.shape[:2])
    square = np.full((side, side, *image.shape[2:]), fill, np.uint8)
    if x1 > x0 and y1 > y0:
        square[y0 - top : y1 - top, x0 - left : x1 - left] = image[y0:y1, x0:x1]
    interpolation = cv2.INTER_AREA if side > SIDE else cv2.INTER_LINEAR
    return cv2.resize(square, (SIDE, SIDE), interpolation=interpolation)


def paste(
    image: Float32[np.ndarray, "h w"], patch: Float32[np.ndarray, "s s"], window: Window
) -> None:
    """Write a square patch back where its window was cut, in place."""
    left, top, side = window
    x0, y0, x1, y1 = _visible_part(window, image.shape)
    if x1 > x0 and y1 > y0:
        resized = cv2.resize(patch, (side, side), interpolation=cv2.INTER_LINEAR)
        image[y0:y1, x0:x1] = resized[y0 - top : y1 - top, x0 - left : x1 - left]


def box_plane(box_xyxy: Float[np.ndarray, "4"], hw: Sequence[int]) -> UInt8[np.ndarray, "h w"]:
    """255 inside the box, 0 outside."""
    plane = np.zeros(tuple(hw), np.uint8)
    x0, y0, x1, y1 = np.maximum(np.round(box_xyxy), 0).astype(int).tolist()
    plane[y0:y1, x0:x1] = 255
    return plane


@cache
def load() -> LiteSegmenter:
    """The shipped segmenter.

    Raises: MissingWeights: a file of data/weights is absent or damaged.
    """
    weights, entry = load_weights(PERCEPTION, "segment.")
    arrays = {**trunk_weights(MASK_TAPS), **head_weights(weights)}
    return LiteSegmenter(load_network(GRAPH, arrays, entry["sha256"]))


def _visible_part(window: Window, hw: Sequence[int]) -> tuple[int, int, int, int]:
    """The part of a window that lies in an image of that size: left, top, right and bottom."""
    left, top, side = window
    h, w = hw
    return max(left, 0), max(top, 0), min(left + side, w), min(top + side, h)


CUT_SIDE = 160
"""Pixels of the square window in which GrabCut runs."""
ITERATIONS = 4
UNLIKELY, SURE = 0.35, 0.9
"""The segmenter's probability below which a pixel of the box is probably background, and above
which it is foreground for sure."""
LEAST_PX = 64
"""The longer side of a box from which on GrabCut has colours enough to learn from."""
LEAST_SHARE = 0.05
"""Of the box: a smaller mask of GrabCut is none, and the segmenter's stays."""


class CutSegmenter:
    """The segmenter's masks in familiar views, and masks by GrabCut in others."""

    def __init__(self, lite: LiteSegmenter) -> None:
        self.lite = lite

    def __call__(self, image: Rgb, boxes: Boxes) -> Bool[np.ndarray, "n h w"]:
        probability = self.lite.mask_probability(image, boxes.xyxy)
        masks = likely_pixels(probability)
        if boxes.familiar:
            return masks
        sides = (boxes.xyxy[:, 2:] - boxes.xyxy[:, :2]).max(axis=1, initial=0.0)
        for i in np.flatnonzero(sides >= LEAST_PX):
            refined = refine(image, boxes.xyxy[i], probability[i])
            if refined is not None:
                masks[i] = refined
        return masks


def refine(
    image: Rgb, box_xyxy: Float[np.ndarray, "4"], probability: Float32[np.ndarray, "h w"]
) -> Mask | None:
    """The object in the box, given each pixel's probability to belong to it.

    None where GrabCut has nothing to tell apart, or leaves nearly nothing of the box.
    """
    h, w = image.shape[:2]
    left, top, side = window_around(box_xyxy)
    x0, y0 = max(left, 0), max(top, 0)
    x1, y1 = min(left + side, w), min(top + side, h)
    scale = min(1.0, CUT_SIDE / side)
    size = (max(8, round((x1 - x0) * scale)), max(8, round((y1 - y0) * scale)))
    part = cv2.resize(image[y0:y1, x0:x1], size, interpolation=cv2.INTER_AREA)
    likely = cv2.resize(probability[y0:y1, x0:x1], size, interpolation=cv2.INTER_LINEAR)
    scale_xy = np.array(size) / (x1 - x0, y1 - y0)
    corners = (box_xyxy.reshape(2, 2) - (x0, y0)) * scale_xy
    # What GrabCut starts from: outside of the box all is background.
    (left, top), (right, bottom) = np.round(corners).astype(int).clip(0, size).tolist()
    labels = np.full(likely.shape, cv2.GC_BGD, np.uint8)
    inner = likely[top:bottom, left:right]
    of_box = np.where(inner < UNLIKELY, cv2.GC_PR_BGD, cv2.GC_PR_FGD)
    labels[top:bottom, left:right] = np.where(inner > SURE, cv2.GC_FGD, of_box)
    if len(np.unique(labels & 1)) < 2:  # odd labels are foreground
        return None
    cv2.setRNGSeed(0)  # GrabCut's clusters start at random
    bgr = np.ascontiguousarray(part[..., ::-1])
    models = np.zeros((2, 1, 65))
    nowhere = (0, 0, 1, 1)  # not read where labels are given
    cv2.grabCut(bgr, labels, nowhere, models[0], models[1], ITERATIONS, cv2.GC_INIT_WITH_MASK)
    inside = (labels & 1).astype(np.float32)
    if inside.sum() < LEAST_SHARE * np.prod(corners[1] - corners[0]):
        return None
    mask = np.zeros((h, w), bool)
    whole = cv2.resize(inside, (x1 - x0, y1 - y0), interpolation=cv2.INTER_LINEAR)
    mask[y0:y1, x0:x1] = whole > 0.5
    return mask


@cache
def load_cut() -> CutSegmenter:
    """The shipped segmenter of any view.

    Raises: MissingWeights: a file of data/weights is absent or damaged.
    """
    return CutSegmenter(load())
