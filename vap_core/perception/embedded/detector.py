"""Category-level proposals: every box in a view that matches an open-vocabulary phrase (P 3.3).

The embedded detector is a small head on frozen Lite0 features. Each cell of a stride-8 grid carries
a visual embedding. Its dot product with the projected MiniLM embedding of the phrase says how
likely an object of that kind has its centre there; four more numbers say how far its edges are (as
in CenterNet and FCOS). The head was trained on rendered tabletop scenes alone.
"""

from collections.abc import Mapping, Sequence
from functools import cache

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from vap_core.base.types import Boxes, Rgb
from vap_core.perception.boxes import suppress_overlaps
from vap_core.perception.embedded.backbone import CHANNELS, Trunk, normalise, resize_and_pad
from vap_core.perception.embedded.runtime import Network, load_network
from vap_core.perception.embedded.weights import PERCEPTION, load_weights
from vap_core.perception.text_encoder import WIDTH as TEXT_WIDTH
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
COARSE_WIDTH = 96
FINE_WIDTH = 64
PHRASE_HIDDEN_WIDTH = 128
PHRASE_WIDTH = 96
"""Channels of the head: at stride 16, at stride 8, and of embedded phrases."""


class DetectHead(nn.Module):
    """Feature maps in; one score map per phrase and one box per cell out.

    Stride 16 decides what an object is, stride 8 where its edges are. The attributes' names are the
    tensors' names in the weight file.
    """

    known: Tensor
    """MiniLM embeddings of the trained phrases, those that name nothing too; kept so that loading
    does not compute them again."""

    def __init__(self, n_phrases: int) -> None:
        super().__init__()
        self.register_buffer("known", torch.zeros(n_phrases, TEXT_WIDTH))
        self.lateral = nn.ModuleDict(
            {
                "b4": nn.Conv2d(CHANNELS["b4"], FINE_WIDTH, 1),
                "b10": nn.Conv2d(CHANNELS["b10"], COARSE_WIDTH, 1),
                "b14": nn.Conv2d(CHANNELS["b14"], COARSE_WIDTH, 1),
            }
        )
        self.coarse = ResidualConvolutions(COARSE_WIDTH)
        self.fine = ResidualConvolutions(FINE_WIDTH)
        self.down = nn.Conv2d(COARSE_WIDTH, FINE_WIDTH, 1)
        self.see = nn.Conv2d(FINE_WIDTH, PHRASE_WIDTH, 1)
        self.edges = nn.Conv2d(FINE_WIDTH, 4, 1)
        self.read = nn.Sequential(
            nn.Linear(TEXT_WIDTH, PHRASE_HIDDEN_WIDTH),
            nn.ReLU(),
            nn.Linear(PHRASE_HIDDEN_WIDTH, PHRASE_WIDTH),
        )
        self.bias = nn.Parameter(torch.tensor(-4.0))

    def forward(
        self, taps: Mapping[str, Tensor], text: Float[Tensor, "p 384"]
    ) -> tuple[Float[Tensor, "n p h w"], Float[Tensor, "n 4 h w"]]:
        """Logits per phrase, and how far the edges are.

        Edges are distances, in cells, from the cell's centre to the left, top, right and bottom.
        """
        b4 = self.lateral["b4"](taps["b4"])
        b10 = self.lateral["b10"](taps["b10"])
        b14 = self.lateral["b14"](taps["b14"])
        x = self.down(self.coarse(b10 + F.interpolate(b14, b10.shape[-2:], mode="nearest")))
        x = self.fine(b4 + F.interpolate(x, b4.shape[-2:], mode="nearest"))
        product = torch.einsum("nchw,pc->nphw", self.see(x), self.read(text))
        logits = product / PHRASE_WIDTH**0.5 + self.bias
        return logits, 4 * F.softplus(self.edges(x))


class ResidualConvolutions(nn.Module):
    """Two residual 3 x 3 convolutions between group norms."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.mix = nn.ModuleList()
        self.norm = nn.ModuleList([nn.GroupNorm(8, width)])
        for _ in range(2):
            self.mix.append(nn.Conv2d(width, width, 3, padding=1))
            self.norm.append(nn.GroupNorm(8, width))

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        x = self.norm[0](x)
        for mix, norm in zip(self.mix, list(self.norm)[1:], strict=True):
            x = x + F.relu(norm(mix(F.relu(x))))
        return x


class DetectNetwork(nn.Module):
    """Backbone and head: a view and embedded phrases in, what `DetectHead` gives out."""

    def __init__(self, head: DetectHead) -> None:
        super().__init__()
        self.trunk = Trunk(TAPS)
        self.head = head

    def forward(
        self, rgb: UInt8[Tensor, "n h w 3"], text: Float[Tensor, "p 384"]
    ) -> tuple[Float[Tensor, "n p y x"], Float[Tensor, "n 4 y x"]]:
        return self.head(self.trunk(normalise(rgb)), text)


class LiteDetector:
    """The embedded detector; `network` computes a `DetectNetwork`.

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
    head = DetectHead(len(weights["known"]))
    head.load_state_dict(weights)
    network = load_network(GRAPH, DetectNetwork(head), entry["sha256"])
    return LiteDetector(network, head.known.numpy())
