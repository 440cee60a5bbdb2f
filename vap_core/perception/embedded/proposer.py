"""Boxes of any object, whatever it is called: the proposals of a detector trained on photos (COCO).

The network is NanoDet-g (Apache-2.0; its card is data/weights/nanodet-coco.md). The names of its 80
classes are not used: the highest class score of a box says how likely it holds an object at all.
"""

from functools import cache
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float32

from vap_core.base.types import Rgb
from vap_core.perception.boxes import suppress_overlaps
from vap_core.perception.embedded.runtime import (
    Network,
    OnnxNetwork,
    session_options,
    start_session,
)
from vap_core.perception.embedded.weights import read_checked

Found = tuple[Float32[np.ndarray, "n 4"], Float32[np.ndarray, " n"]]
"""Boxes and their scores."""
GRAPH = "nanodet-coco.onnx"
SIDE = 416
"""Pixels of the square to which a picture is resized; its aspect is not kept."""
STRIDES = (8, 16, 32)
BINS = 11
"""The distance of an edge is a distribution over so many strides, from 0."""
MEAN_BGR = np.array([103.53, 116.28, 123.675], np.float32)
DEVIATION_BGR = np.array([57.375, 57.12, 58.395], np.float32)
CELLS = 400
"""Only the best cells are decoded."""
LEAST_SCORE = 0.04
"""Flat grey gives boxes of up to .028."""
LEAST_SIDE_PX = 4
LARGEST_SHARE = 0.6
"""In a scene a box of more than this share of the picture is the table or the room."""
NMS_IOU = 0.7
"""Boxes of parts, of whole objects and of pairs are all kept for the vote."""
MOST = 20
"""Boxes of one picture. On renders the best 10 lose six points of tabletop's objects."""


@runtime_checkable
class Propose(Protocol):
    """Proposes boxes of any object, best first, with scores in [0, 1]."""

    def __call__(self, rgb: Rgb, least_score: float, most: int, largest_share: float) -> Found:
        """At most `most` boxes, none larger than a share of the picture, with a least score."""
        ...


class Proposer:
    """Proposes boxes; `network` computes NanoDet-g."""

    def __init__(self, network: Network) -> None:
        self.network = network

    def __call__(
        self,
        rgb: Rgb,
        least_score: float = LEAST_SCORE,
        most: int = MOST,
        largest_share: float = LARGEST_SHARE,
    ) -> Found:
        """Boxes in the picture's pixels and their scores, best first."""
        scores, edges = self.network(prepare(rgb))
        xyxy, score = decode(scores[0], edges[0])
        h, w = rgb.shape[:2]
        size = np.array([w, h, w, h], np.float32)
        xyxy = np.clip(xyxy / SIDE, 0, 1) * size
        sides = xyxy[:, 2:] - xyxy[:, :2]
        usable = score >= least_score
        usable &= (sides >= LEAST_SIDE_PX).all(axis=1)
        usable &= sides.prod(axis=1) <= largest_share * w * h
        xyxy = xyxy[usable]
        score = score[usable]
        kept = suppress_overlaps(xyxy, score, iou=NMS_IOU, most=most)
        return xyxy[kept], score[kept]


def prepare(rgb: Rgb) -> Float32[np.ndarray, "1 3 s s"]:
    """The network's input for a picture."""
    small = cv2.resize(rgb, (SIDE, SIDE), interpolation=cv2.INTER_LINEAR)
    bgr = (small[..., ::-1].astype(np.float32) - MEAN_BGR) / DEVIATION_BGR
    return np.ascontiguousarray(bgr.transpose(2, 0, 1)[None])


def decode(
    scores: Float32[np.ndarray, "c classes"], edges: Float32[np.ndarray, "c bins"]
) -> tuple[Float32[np.ndarray, "n 4"], Float32[np.ndarray, " n"]]:
    """Boxes of the best cells in pixels of the network's input, and their scores, best first.

    An edge's distance is the expectation of its distribution, in strides.
    """
    best = scores.max(axis=1)
    order = np.argsort(-best, kind="stable")[:CELLS]
    centre, stride = _cells()
    logits = edges[order].reshape(len(order), 4, BINS)
    likelihood = np.exp(logits - logits.max(axis=-1, keepdims=True))
    likelihood /= likelihood.sum(axis=-1, keepdims=True)
    reach = (likelihood @ np.arange(BINS, dtype=np.float32)) * stride[order, None]
    near = centre[order] - reach[:, :2]
    far = centre[order] + reach[:, 2:]
    return np.concatenate([near, far], axis=1), best[order]


@cache
def load() -> Proposer:
    """The shipped proposer.

    Raises: MissingWeights: a file of data/weights is absent or damaged.
    """
    graph, _ = read_checked(GRAPH, remedy="restore it with git")
    return Proposer(OnnxNetwork(start_session(graph, session_options())))


@cache
def _cells() -> tuple[Float32[np.ndarray, "c 2"], Float32[np.ndarray, " c"]]:
    """The centre of every cell in pixels of the network's input, and its stride."""
    centres = []
    strides = []
    for stride in STRIDES:
        n = SIDE // stride
        rows, cols = np.mgrid[:n, :n]
        cell = np.stack([cols.ravel(), rows.ravel()], axis=1).astype(np.float32)
        centres.append((cell + np.float32(0.5)) * np.float32(stride))
        strides.append(np.full(n * n, stride, np.float32))
    return np.concatenate(centres), np.concatenate(strides)
