"""Category-level proposals: every box in a view that matches an open-vocabulary phrase (P 3.3).

The embedded detector is a small head on frozen Lite0 features. Each cell of a stride-8 grid carries a visual embedding; its
dot product with the projected MiniLM embedding of the phrase says how likely an object of that kind has its centre there, and
four more numbers say how far its edges are (as CenterNet and FCOS do). It was trained on rendered tabletop scenes alone.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from vap_core.features import CHANNELS, features, fit
from vap_core.text import WIDTH as TEXT_WIDTH
from vap_core.text import embed_text
from vap_core.values import Boxes, Rgb
from vap_core.weights import load_weights

TAPS = ("b4", "b10", "b14")
STRIDE = 8
TRAINED_SIDE, SIDE = 224, 384
"""The longer side, pixels, of the training views, and to which they are enlarged to be searched. Sharper pictures are found less
well (recall .90 against .96 at 448 pixels, cropped references 75 % against 98 %), so larger ones are reduced to the first beforehand."""
THRESHOLD, TOP, NMS_IOU = 0.1, 10, 0.5
SNAP = 0.55
"""A phrase whose cosine to a trained one exceeds this is searched for as that one, which may be one that names nothing."""


@runtime_checkable
class Detector(Protocol):
    """Finds every box that matches an open-vocabulary phrase."""

    def __call__(self, images: Sequence[Rgb], phrase: str, threshold: float | None = None) -> list[Boxes]:
        """One `Boxes` per image, best first, in that image's pixels; empty when nothing scores `threshold` (None: the detector's own)."""
        ...


class DetectHead(nn.Module):
    """Feature pyramid in, one score map per phrase and one box per cell out: what it is, at stride 16; where its edges are, at stride 8."""

    known: Tensor
    """MiniLM embeddings of the phrases it was trained with, those that name nothing too; kept so that loading does not compute them again."""

    def __init__(self, n_names: int, coarse: int = 96, fine: int = 64, words: int = 96) -> None:
        super().__init__()
        self.register_buffer("known", torch.zeros(n_names, TEXT_WIDTH))
        self.lateral = nn.ModuleDict({tap: nn.Conv2d(CHANNELS[tap], fine if tap == "b4" else coarse, 1) for tap in TAPS})
        self.coarse, self.fine = Mix(coarse), Mix(fine)
        self.down = nn.Conv2d(coarse, fine, 1)
        self.see = nn.Conv2d(fine, words, 1)
        self.edges = nn.Conv2d(fine, 4, 1)
        self.read = nn.Sequential(nn.Linear(TEXT_WIDTH, 128), nn.ReLU(), nn.Linear(128, words))
        self.bias = nn.Parameter(torch.tensor(-4.0))

    def forward(self, taps: Mapping[str, Tensor], text: Float[Tensor, "p 384"]) -> tuple[Float[Tensor, "n p h w"], Float[Tensor, "n 4 h w"]]:
        """Logits per phrase, and distances from the cell's centre to the left, top, right and bottom edge in cells."""
        b4, b10, b14 = (self.lateral[tap](taps[tap]) for tap in TAPS)
        x = self.down(self.coarse(b10 + F.interpolate(b14, b10.shape[-2:], mode="nearest")))
        x = self.fine(b4 + F.interpolate(x, b4.shape[-2:], mode="nearest"))
        logits = torch.einsum("nchw,pc->nphw", self.see(x), self.read(text)) / self.see.out_channels**0.5 + self.bias
        return logits, 4 * F.softplus(self.edges(x))


class Mix(nn.Module):
    """Two residual 3 x 3 convolutions between group norms."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.mix = nn.ModuleList(nn.Conv2d(width, width, 3, padding=1) for _ in range(2))
        self.norm = nn.ModuleList(nn.GroupNorm(8, width) for _ in range(3))

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        x = self.norm[0](x)
        for mix, norm in zip(self.mix, list(self.norm)[1:], strict=True):
            x = x + F.relu(norm(mix(F.relu(x))))
        return x


class LiteDetector:
    """The embedded detector; a near synonym of a name it was trained with is read as that name."""

    def __init__(self, head: DetectHead, *, threshold: float = THRESHOLD, snap: float | None = SNAP) -> None:
        self.head = head.requires_grad_(False).eval()
        self.threshold = threshold
        self.snap = snap

    def read(self, phrase: str) -> Float32[np.ndarray, "1 384"]:
        """The phrase's embedding, or that of the nearest known name when it is near enough."""
        row = embed_text([phrase])
        if self.snap is None:
            return row
        known = self.head.known.numpy()
        cosine = (known @ row[0]).round(6)
        return known[[cosine.argmax()]] if cosine.max() >= self.snap else row

    @torch.inference_mode()
    def __call__(self, images: Sequence[Rgb], phrase: str, threshold: float | None = None) -> list[Boxes]:
        text = torch.from_numpy(self.read(phrase))
        found = []
        for image in images:
            small, scale = enlarge(image)
            logits, edges = self.head(features([small], TAPS), text)
            xyxy, score = decode(logits[0, 0], edges[0], self.threshold if threshold is None else threshold)
            h, w = image.shape[:2]
            xyxy = np.clip(xyxy / scale, 0, (w, h, w, h)).astype(np.float32)
            real = (xyxy[:, 2:] - xyxy[:, :2] >= 1).all(axis=1)
            found.append(Boxes(xyxy[real], score[real], phrase))
        return found


def enlarge(image: Rgb) -> tuple[Rgb, float]:
    """The view as the head was trained to see it, and its scale."""
    scale = 1.0
    if max(image.shape[:2]) > TRAINED_SIDE:
        image, scale = fit(image, TRAINED_SIDE, multiple=1)
    small, enlarged = fit(image, SIDE)
    return small, scale * enlarged


def decode(
    logits: Float[Tensor, "h w"], edges: Float[Tensor, "4 h w"], threshold: float, top: int = TOP
) -> tuple[Float32[np.ndarray, "n 4"], Float32[np.ndarray, " n"]]:
    """Peaks of one score map as boxes (pixels of the searched picture) and scores, best first, overlaps removed."""
    peak = F.max_pool2d(logits[None], 3, 1, 1)[0] == logits
    rows, cols = torch.nonzero(peak & (logits.sigmoid() >= threshold), as_tuple=True)
    score, order = logits[rows, cols].sigmoid().sort(descending=True, stable=True)
    rows, cols = rows[order], cols[order]
    centre = torch.stack([cols, rows], 1) + 0.5
    reach = edges[:, rows, cols].T
    xyxy = torch.cat([centre - reach[:, :2], centre + reach[:, 2:]], 1).numpy() * STRIDE
    keep: list[int] = []
    for i in range(len(xyxy)):
        if len(keep) < top and (not keep or box_iou(xyxy[[i]], xyxy[keep]).max() < NMS_IOU):
            keep.append(i)
    return xyxy[keep].astype(np.float32).reshape(-1, 4), score.numpy()[keep].astype(np.float32).reshape(-1)


def box_iou(a: Float[np.ndarray, "n 4"], b: Float[np.ndarray, "m 4"]) -> Float[np.ndarray, "n m"]:
    """Intersection over union of every pair of `x0 y0 x1 y1` boxes."""
    near, far = np.maximum(a[:, None, :2], b[None, :, :2]), np.minimum(a[:, None, 2:], b[None, :, 2:])
    both = np.clip(far - near, 0, None).prod(-1)
    area_a, area_b = ((x[:, 2:] - x[:, :2]).prod(-1) for x in (a, b))
    return both / np.maximum(area_a[:, None] + area_b[None] - both, 1e-9)


@cache
def load() -> LiteDetector:
    """The shipped detector.

    Raises:
        MissingWeights: data/weights/perception.safetensors is absent or not what the manifest promises.
    """
    weights, _ = load_weights("perception.safetensors", "detect.")
    head = DetectHead(len(weights["known"]))
    head.load_state_dict(weights)
    return LiteDetector(head)
