"""Category-level proposals: every box in a view that matches an open-vocabulary phrase (P 3.3).

The embedded detector is a small head on frozen Lite0 features. Each cell of a stride-8 grid carries
a visual embedding. Its dot product with the projected MiniLM embedding of the phrase says how
likely an object of that kind has its centre there; four more numbers say how far its edges are (as
in CenterNet and FCOS). The head was trained on rendered tabletop scenes alone.
"""

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float32

from vap_core.base.types import Boxes, Rgb
from vap_core.perception.boxes import suppress_overlaps
from vap_core.perception.embedded.lite0 import trunk_weights
from vap_core.perception.embedded.runtime import Network, load_network
from vap_core.perception.embedded.taps import resize_and_pad
from vap_core.perception.embedded.weights import PERCEPTION, head_weights, load_weights
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
