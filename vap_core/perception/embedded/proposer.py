"""Category-level proposals: every box in a view that matches an open-vocabulary phrase (P 3.3).

The embedded detector is a small head on frozen Lite0 features. Each cell of a stride-8 grid carries
a visual embedding. Its dot product with the projected MiniLM embedding of the phrase says how
likely an object of that kind has its centre there; four more numbers say how far its edges are (as
in CenterNet and FCOS). The head was trained on rendered tabletop scenes alone.
"""

from collections.abc import Sequence
from functools import cache
from itertools import product
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64

from vap_core.base.types import Boxes, Rgb
from vap_core.perception.boxes import box_iou, other_places, suppress_overlaps
from vap_core.perception.candidates import MOST_CANDIDATES
from vap_core.perception.embedded.networks import (
    PERCEPTION,
    Network,
    OnnxNetwork,
    head_weights,
    load_network,
    load_weights,
    read_checked,
    resize_and_pad,
    session_options,
    start_session,
    trunk_weights,
)
from vap_core.perception.protocols import Detector
from vap_core.perception.text_encoder import embed_text

GRAPH = "detector.onnx"
TAPS = ("b4", "b10", "b14")
STRIDE = 8
TRAINED_SIDE = 224
"""The longer side of the training views, pixels. Sharper images are found less well (at 448 pixels
recall is .90 instead of .96, and cropped references 75 % instead of 98 %): they are reduced to
this."""
SIDE = 384
"""The longer side to which a view is then enlarged to be searched."""
THRESHOLD = 0.1
SNAP_COSINE = 0.55
"""A phrase whose cosine to a trained one reaches this is searched for as that one, which may be one
that names nothing."""


class LiteDetector:
    """The embedded detector; `network` computes a `detect_network.DetectNetwork`.

    `known` are the embeddings of the trained phrases. A phrase whose cosine to one of them reaches
    `snap` is searched for as that one; None never does.
    """

    def __init__(
        self,
        network: Network,
        known: Float32[np.ndarray, "k 384"],
        *,
        snap: float | None = SNAP_COSINE,
    ) -> None:
        self.network = network
        self.known = known
        self.snap = snap

    def embed_phrase(self, phrase: str) -> Float32[np.ndarray, "1 384"]:
        """The phrase's embedding, or that of the nearest trained phrase when it is near enough."""
        row = embed_text([phrase])
        if self.snap is None:
            return row
        cosine = (self.known @ row[0]).round(6)
        if cosine.max() >= self.snap:
            return self.known[[cosine.argmax()]]
        return row

    def __call__(
        self, images: Sequence[Rgb], phrase: str, threshold: float | None = None
    ) -> list[Boxes]:
        if threshold is None:
            threshold = THRESHOLD
        text = self.embed_phrase(phrase)
        proposals: list[Boxes] = []
        for image in images:
            small, scale = resize_for_search(image)
            logits, edges = self.network(small[None], text)
            xyxy, score = decode(logits[0, 0], edges[0], threshold)
            h, w = image.shape[:2]
            xyxy = np.clip(xyxy / scale, 0, (w, h, w, h)).astype(np.float32)
            large_enough = (xyxy[:, 2:] - xyxy[:, :2] >= 1).all(axis=1)
            proposals.append(Boxes(xyxy[large_enough], score[large_enough], phrase))
        return proposals


def resize_for_search(image: Rgb) -> tuple[Rgb, float]:
    """The view as sharp and as large as those that the head was trained on, and its scale."""
    scale = 1.0
    if max(image.shape[:2]) > TRAINED_SIDE:
        image, scale = resize_and_pad(image, TRAINED_SIDE, multiple=1)
    small, enlargement = resize_and_pad(image, SIDE)
    return small, scale * enlargement


def decode(
    logits: Float32[np.ndarray, "h w"], edges: Float32[np.ndarray, "4 h w"], threshold: float
) -> tuple[Float32[np.ndarray, "n 4"], Float32[np.ndarray, " n"]]:
    """Peaks of one score map as boxes and scores, best first, overlaps removed.

    Boxes are in pixels of the searched image.
    """
    probability = 1 / (1 + np.exp(-np.maximum(logits, -80)))
    peak = cv2.dilate(logits, np.ones((3, 3), np.uint8)) == logits
    rows, cols = np.nonzero(peak & (probability >= threshold))
    score = probability[rows, cols]
    centre = np.stack([cols, rows], axis=1).astype(np.float32) + np.float32(0.5)
    reach = edges[:, rows, cols].T
    corners = np.concatenate([centre - reach[:, :2], centre + reach[:, 2:]], axis=1)
    xyxy = corners * np.float32(STRIDE)
    kept = suppress_overlaps(xyxy, score)
    return xyxy[kept], score[kept]


@cache
def load() -> LiteDetector:
    """The shipped detector.

    Raises: MissingWeights: a file of data/weights is absent or damaged.
    """
    weights, entry = load_weights(PERCEPTION, "detect.")
    known = weights.pop("known")
    arrays = {**trunk_weights(TAPS), **head_weights(weights)}
    return LiteDetector(load_network(GRAPH, arrays, entry["sha256"]), known)


Found = tuple[Float32[np.ndarray, "n 4"], Float32[np.ndarray, " n"]]
"""Boxes and their scores."""
PROPOSER_GRAPH = "nanodet-coco.onnx"
PROPOSER_SIDE = 416
"""Pixels of the square to which a picture is resized; its aspect is not kept."""
STRIDES = (8, 16, 32)
BINS = 11
"""The distance of an edge is a distribution over so many strides, from 0."""
MEAN_BGR = np.array([103.53, 116.28, 123.675], np.float32)
DEVIATION_BGR = np.array([57.375, 57.12, 58.395], np.float32)
LEVELS = (np.arange(256, dtype=np.float32) - MEAN_BGR[:, None]) / DEVIATION_BGR[:, None]
"""What the network sees of every level of a channel."""
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
        xyxy, score = decode_proposals(scores[0], edges[0])
        h, w = rgb.shape[:2]
        size = np.array([w, h, w, h], np.float32)
        xyxy = np.clip(xyxy / PROPOSER_SIDE, 0, 1) * size
        sides = xyxy[:, 2:] - xyxy[:, :2]
        usable = score >= least_score
        usable &= (sides >= LEAST_SIDE_PX).all(axis=1)
        usable &= sides.prod(axis=1) <= largest_share * w * h
        xyxy, score = xyxy[usable], score[usable]
        kept = suppress_overlaps(xyxy, score, iou=NMS_IOU, most=most)
        return xyxy[kept], score[kept]


def prepare(rgb: Rgb) -> Float32[np.ndarray, "1 3 s s"]:
    """The network's input for a picture."""
    small = cv2.resize(rgb, (PROPOSER_SIDE, PROPOSER_SIDE), interpolation=cv2.INTER_LINEAR)
    return np.array([[cv2.LUT(small[..., 2 - i], levels) for i, levels in enumerate(LEVELS)]])


def decode_proposals(
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
def load_proposer() -> Proposer:
    """The shipped proposer.

    Raises: MissingWeights: a file of data/weights is absent or damaged.
    """
    graph, _ = read_checked(PROPOSER_GRAPH, remedy="restore it with git")
    return Proposer(OnnxNetwork(start_session(graph, session_options())))


@cache
def _cells() -> tuple[Float32[np.ndarray, "c 2"], Float32[np.ndarray, " c"]]:
    """The centre of every cell in pixels of the network's input, and its stride."""
    centres = []
    strides = []
    for stride in STRIDES:
        n = PROPOSER_SIDE // stride
        rows, cols = np.mgrid[:n, :n]
        cell = np.stack([cols.ravel(), rows.ravel()], axis=1).astype(np.float32)
        centres.append((cell + np.float32(0.5)) * np.float32(stride))
        strides.append(np.full(n * n, stride, np.float32))
    return np.concatenate(centres), np.concatenate(strides)


PHRASE_FLOOR = 0.03
"""Score from which on a box of the phrase head is looked at."""
FAMILIAR = 0.4
"""Best score of the phrase head from which on a view is familiar. In 200 of 209 rendered opening
views a camera of the episode reaches it, and in 24 % of 95 photos of toys, pets and other things;
with .2 it is all of them and 43 %. The vote is the same on renders, and two of 80 better on photos.
"""
LEAST_FAMILIAR, MOST_FAMILIAR = 4, 8
"""Boxes of a familiar view that need no agreement, of the best 20: so many, and then up to so many
until there are `MOST_CANDIDATES` in other places, as every crop costs a pass of the encoder. 880 of
885 rendered views with the object, 225 of them of designs that the phrase head has not seen, show
the same object as with 8 always (780 of 783 associated), and 366 of 366 without it."""
MOST_UNFAMILIAR = 40
"""Boxes of an unfamiliar view. Of 80 objects pasted into real photos 20 boxes elect 56, 40 elect 60
and 60 elect 61."""
SAME_OBJECT_IOU = 0.6
"""Of proposals that overlap by more, the best stays. In 198 views it changes no winner, and leaves
29 crops of 40 in an unfamiliar view and 8 of 9 in a familiar one."""
TILED_PX = 1_000_000
"""From so many pixels on an unfamiliar view is looked at in tiles, too. Of 60 packages pasted into
photos of 1920 x 1080, 4 to 13 % of the width, 55 are among the 40 boxes, without tiles 50."""
CUT_PX = 2
"""A box that comes this near to a tile's edge may be cut by it."""
REFERENCE_SHARE = 0.95
"""A reference's object may fill the photo."""
AGREEMENT = 0.05
AGREEMENT_IOU = 0.5
"""What a box of a reference photo gains where one of the phrase head agrees with it."""
OBJECTNESS = 0.05
"""What it gains for every natural logarithm of its score."""


def half_of(image: Rgb) -> Int64[np.ndarray, "2"]:
    """Width and height of a tile: half the picture's, rounded up."""
    return -(-np.array(image.shape[1::-1]) // 2)


def tiles_of(image: Rgb) -> list[tuple[int, int]]:
    """The near corners of nine tiles that overlap by half."""
    size = np.array(image.shape[1::-1])
    steps = np.linspace(0, size - half_of(image), 3).astype(int).T.tolist()
    return list(product(*steps))


class OpenDetector:
    """Proposes boxes of any object; the phrase says which views are familiar."""

    def __init__(self, propose: Propose, by_category: Detector) -> None:
        self.propose = propose
        self.by_category = by_category

    def __call__(
        self, images: Sequence[Rgb], phrase: str, threshold: float | None = None
    ) -> list[Boxes]:
        """The proposals of each image; `threshold` bounds the proposer's score."""
        if threshold is None:
            threshold = LEAST_SCORE
        found = []
        for image in images:
            named = self._named(image, phrase)
            familiar = _is_familiar(named)
            most = MOST if familiar else MOST_UNFAMILIAR
            parts = [self.propose(image, threshold, most, LARGEST_SHARE)]
            if not familiar and image[..., 0].size >= TILED_PX:
                parts += [self._in_tile(image, near, threshold, most) for near in tiles_of(image)]
            xyxy, score = (np.concatenate(part) for part in zip(*parts, strict=True))
            alone = suppress_overlaps(xyxy, score, iou=SAME_OBJECT_IOU, most=most)
            xyxy, score = xyxy[alone], score[alone]
            if familiar:
                kept = agreed(xyxy, named)
                kept[:LEAST_FAMILIAR] = True
                for most in range(LEAST_FAMILIAR + 1, MOST_FAMILIAR + 1):
                    places = other_places(xyxy, np.flatnonzero(kept), MOST_CANDIDATES)
                    kept[:most] |= len(places) < MOST_CANDIDATES
                xyxy, score = xyxy[kept], score[kept]
            found.append(Boxes(xyxy, score, phrase, familiar=familiar))
        return found

    def _in_tile(self, image: Rgb, near: tuple[int, int], threshold: float, most: int) -> Found:
        """What is proposed in a tile, in the picture's pixels, but for what its edges cut."""
        (x, y), size = near, half_of(image)
        xyxy, score = self.propose(
            image[y : y + size[1], x : x + size[0]], threshold, most, LARGEST_SHARE
        )
        whole = ((xyxy[:, :2] > CUT_PX) & (xyxy[:, 2:] < size - CUT_PX)).all(axis=1)
        return xyxy[whole] + np.array([x, y, x, y], np.float32), score[whole]

    def reference_boxes(
        self, photo: Rgb, phrase: str, threshold: float
    ) -> tuple[Boxes, Float32[np.ndarray, " n"]]:
        """Boxes of any size, and the evidence of score and phrase for each.

        Where the phrase head knows the object, the likeliest box that it agrees with is its own.
        """
        xyxy, score = self.propose(photo, threshold, MOST_UNFAMILIAR, REFERENCE_SHARE)
        named = self._named(photo, phrase)
        evidence = OBJECTNESS * np.log(score + np.float32(1e-3)) + AGREEMENT * agreed(xyxy, named)
        familiar = _is_familiar(named)
        if familiar:
            overlap = box_iou(xyxy, named.xyxy[:1])[:, 0]
            agreeing = np.flatnonzero(overlap >= AGREEMENT_IOU)
            if len(agreeing):
                xyxy[agreeing[evidence[agreeing].argmax()]] = named.xyxy[0]
        return Boxes(xyxy, score, phrase, familiar=familiar), evidence.astype(np.float32)

    def is_familiar(self, image: Rgb, phrase: str) -> bool:
        """Whether the image is of the world that the phrase head was trained on."""
        return _is_familiar(self._named(image, phrase))

    def _named(self, image: Rgb, phrase: str) -> Boxes:
        """The boxes of the phrase head, the unsure ones too."""
        return self.by_category([image], phrase, PHRASE_FLOOR)[0]


def agreed(xyxy: Float32[np.ndarray, "n 4"], named: Boxes) -> Bool[np.ndarray, " n"]:
    """Which proposals a sure box of the phrase head agrees with."""
    sure = named.xyxy[named.score >= THRESHOLD]
    return box_iou(xyxy, sure).max(axis=1, initial=0.0) >= AGREEMENT_IOU


def _is_familiar(named: Boxes) -> bool:
    return bool(named.score.max(initial=0.0) >= FAMILIAR)


@cache
def load_open() -> OpenDetector:
    """The shipped detector.

    Raises: MissingWeights: a file of data/weights is absent or damaged.
    """
    return OpenDetector(load_proposer(), load())
