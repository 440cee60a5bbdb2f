"""f: what an object looks like, as one L2-normalised row per crop (P 3.3), and how crops are cut.

The embedded encoder joins three descriptions, each L2-normalised: GeM-pooled Lite0 features (shape and texture, what kind of
thing), half as strong a centre-weighted Lab histogram, and a row learned to tell look-alikes apart (which of them). The cosine of
two joined rows is the mean of the three cosines, weighted by the squares of their weights.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from vap_core.features import CHANNELS, features, fit, normalise
from vap_core.values import Rgb
from vap_core.weights import load_weights

MARGIN = 0.03
"""Context kept around a box on each side, as a fraction of its longer side: background is what look-alikes share."""
LOOK_TAPS, LOOK_SIDE, LOOK = ("b4", "b10", "b14"), 112, 1.0
"""Of the look head: the features it reads, the side of the pixels it sees, and its weight beside the frozen features. Held-out generic
look-alikes: 75.1 % right without it, 84.7 at 0.7, 86.3 at 1; real photos, of which it has seen none: 98.8, 98.8, 98.0."""


@runtime_checkable
class Encoder(Protocol):
    """Embeds crops; `name` is stored with every memory, because rows of different encoders must never be compared."""

    name: str

    def __call__(self, crops: Sequence[Rgb]) -> Float32[np.ndarray, "n d"]:
        """One L2-normalised row per crop; n may be 0."""
        ...


def crop(image: Rgb, box_xyxy: Float[np.ndarray, "4"], margin: float = MARGIN) -> Rgb:
    """The box with `margin` context, clipped to the image: references and candidates are cut alike."""
    x0, y0, x1, y1 = (float(v) for v in box_xyxy)
    extra = margin * max(x1 - x0, y1 - y0)
    h, w = image.shape[:2]
    left, top = int(np.clip(np.floor(x0 - extra), 0, w - 1)), int(np.clip(np.floor(y0 - extra), 0, h - 1))
    right, bottom = int(np.clip(np.ceil(x1 + extra), left + 1, w)), int(np.clip(np.ceil(y1 + extra), top + 1, h))
    return image[top:bottom, left:right].copy()


class LookHead(nn.Module):
    """What tells look-alikes apart: a small network on frozen Lite0 features and the pixels of a crop, trained on generic look-alikes only.

    Features of three depths and the pixels meet on a 14 x 14 grid; eight attention heads choose where to look, so the table is left out.
    """

    GRID, HEADS, WIDTH, DIM = 14, 8, 96, 128

    def __init__(self, colours: int) -> None:
        super().__init__()
        self.pixels = nn.Sequential(
            nn.Conv2d(3, 16, 3, 2, 1), nn.ReLU(), nn.Conv2d(16, 32, 3, 2, 1), nn.ReLU(), nn.Conv2d(32, 48, 3, 2, 1)
        )  # fmt: skip
        self.lateral = nn.ModuleDict({tap: nn.Conv2d(CHANNELS[tap], 32 if tap == "b4" else 48, 1) for tap in LOOK_TAPS})
        self.merge = nn.Conv2d(48 + 32 + 48 + 48, self.WIDTH, 3, 2, 1)
        self.norm = nn.ModuleList(nn.GroupNorm(8, width) for width in (176, self.WIDTH))
        self.place = nn.Parameter(torch.zeros(self.WIDTH, self.GRID // 2, self.GRID // 2))
        self.mix = nn.Conv2d(self.WIDTH, self.WIDTH, 3, padding=1)
        self.where, self.what = nn.Conv2d(self.WIDTH, self.HEADS, 1), nn.Conv2d(self.WIDTH, self.HEADS * 24, 1)
        self.colour = nn.Linear(colours, 64)
        self.out = nn.Sequential(nn.Linear(self.HEADS * 24 + self.WIDTH + 64, 256), nn.ReLU(), nn.Linear(256, self.DIM))

    def forward(self, taps: Mapping[str, Tensor], pixels: Float[Tensor, "n 3 s s"], colour: Float[Tensor, "n b"]) -> Float[Tensor, "n d"]:
        """Rows of length 1. `taps` on grids of 14, 14 and 7 cells a side, `pixels` 112 x 112 and normalised as for the backbone."""
        size = (self.GRID, self.GRID)
        maps = [self.pixels(pixels), *(F.interpolate(self.lateral[tap](taps[tap]), size, mode="nearest") for tap in LOOK_TAPS)]
        x = self.norm[1](self.merge(F.relu(self.norm[0](torch.cat(maps, 1))))) + self.place
        x = x + F.relu(self.mix(F.relu(x)))
        at = self.where(x).flatten(2).softmax(-1)
        seen = torch.einsum("nhp,nhcp->nhc", at, self.what(x).flatten(2).unflatten(1, (self.HEADS, 24))).flatten(1)
        pooled = F.relu(x).pow(3).mean((2, 3)).clamp(min=1e-6).pow(1 / 3)
        return F.normalize(self.out(torch.cat([seen, pooled, F.relu(self.colour(colour))], 1)), dim=1)


class LiteEncoder:
    """GeM (p = 3) of Lite0's head features, `lab_weight` times a centre-weighted Lab histogram, and `look_weight` times the look head's row."""

    SIDE = 224
    BINS = (4, 8, 8)
    """Lightness, green-red, blue-yellow."""
    SIGMA = 0.4

    def __init__(self, head: LookHead | None = None, tag: str = "", *, lab_weight: float = 0.5, look_weight: float = LOOK) -> None:
        self.head = None if head is None else head.requires_grad_(False).eval()
        self.weights = (1.0, lab_weight, look_weight)
        self.name = f"lite0-gem3-lab{lab_weight:g}" + (f"-look{look_weight:g}{tag}" if head is not None else "")
        self.dim = CHANNELS["head"] + int(np.prod(self.BINS)) + (0 if head is None else head.DIM)

    def __call__(self, crops: Sequence[Rgb]) -> Float32[np.ndarray, "n d"]:
        if not crops:
            return np.zeros((0, self.dim), np.float32)
        return np.stack([self._row(rgb) for rgb in crops])

    def _row(self, rgb: Rgb) -> Float32[np.ndarray, " d"]:
        whole, colour = square(rgb, self.SIDE), _unit(lab_histogram(rgb, self.SIGMA, self.BINS))
        taps = features([whole], ["head"] if self.head is None else [*LOOK_TAPS, "head"])
        parts = [_unit(gem(taps["head"][0].numpy())), colour]
        if self.head is not None:
            parts.append(self.look(taps, whole, colour))
        return _unit(np.concatenate([weight * part for weight, part in zip(self.weights, parts, strict=False)])).astype(np.float32)

    @torch.inference_mode()
    def look(self, taps: Mapping[str, Tensor], whole: Rgb, colour: Float[np.ndarray, " b"]) -> Float32[np.ndarray, " d"]:
        """The look head's row of one crop."""
        assert self.head is not None
        small = normalise(torch.from_numpy(cv2.resize(whole, (LOOK_SIDE, LOOK_SIDE), interpolation=cv2.INTER_AREA))[None])
        return self.head(look_taps(taps), small, torch.from_numpy(colour.astype(np.float32))[None])[0].numpy()


def look_taps(taps: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The taps that a look head reads, b4 halved."""
    return {tap: F.avg_pool2d(taps[tap], 2) if tap == "b4" else taps[tap] for tap in LOOK_TAPS}


def gem(features_chw: Float32[np.ndarray, "c h w"], p: float = 3.0) -> Float32[np.ndarray, " c"]:
    """Generalised-mean pooling: (mean of x^p)^(1/p) per channel; p = 1 is the average, large p the maximum."""
    return (np.maximum(features_chw, 1e-6) ** p).mean((1, 2)) ** (1 / p)


def lab_histogram(rgb: Rgb, sigma: float, bins: tuple[int, int, int], side: int = 64) -> Float[np.ndarray, " b"]:
    """Square-rooted histogram over CIE Lab; a pixel weighs exp(-r^2 / 2 sigma^2), r its distance from the centre in half-sides."""
    lab = cv2.cvtColor(cv2.resize(rgb, (side, side), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2LAB).astype(np.float32)
    r = np.linspace(-1, 1, side)
    weight = np.exp(-(r[:, None] ** 2 + r[None] ** 2) / (2 * sigma**2))
    lightness, chroma = lab[..., :1] / 255.0, (lab[..., 1:] - 64.0) / 128.0  # chroma beyond +-64 shares the outer bins
    index = np.clip((np.concatenate([lightness, chroma], axis=-1) * bins).astype(int), 0, np.array(bins) - 1)
    flat = np.ravel_multi_index((index[..., 0], index[..., 1], index[..., 2]), bins)
    return np.sqrt(np.bincount(flat.ravel(), weight.ravel(), minlength=int(np.prod(bins))))


@cache
def load() -> LiteEncoder:
    """The shipped encoder; the backbone itself loads with the first crop.

    Raises:
        MissingWeights: data/weights/perception.safetensors is absent or not what the manifest promises.
    """
    weights, entry = load_weights("perception.safetensors", "look.")
    head = LookHead(int(np.prod(LiteEncoder.BINS)))
    head.load_state_dict(weights)
    return LiteEncoder(head, f"-{entry['sha256'][:6]}")


def square(rgb: Rgb, side: int) -> Rgb:
    """Resize with the aspect kept and centre on grey, which the backbone sees as zero."""
    small, _ = fit(rgb, side, multiple=1)
    h, w = small.shape[:2]
    out = np.full((side, side, 3), 127, np.uint8)
    top, left = (side - h) // 2, (side - w) // 2
    out[top : top + h, left : left + w] = small
    return out


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-12)
