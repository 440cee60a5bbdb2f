"""f: what an object looks like, as one L2-normalised row per crop (P 3.3), and how crops are cut.

The embedded encoder joins two descriptions, each L2-normalised: GeM-pooled Lite0 features (shape and texture, what kind of
thing) and half as strong a centre-weighted Lab histogram (which of the look-alikes). The cosine of two joined rows is the
weighted mean of both cosines.
"""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, Float32

from vap_core.features import CHANNELS, features, fit
from vap_core.values import Rgb

MARGIN = 0.03
"""Context kept around a box on each side, as a fraction of its longer side: background is what look-alikes share."""


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


class LiteEncoder:
    """GeM (p = 3) of Lite0's head features, and `lab_weight` times a centre-weighted Lab histogram."""

    SIDE = 224
    BINS = (4, 8, 8)
    """Lightness, green-red, blue-yellow."""

    def __init__(self, lab_weight: float = 0.5, sigma: float = 0.4) -> None:
        self.lab_weight = lab_weight
        self.sigma = sigma
        self.name = f"lite0-gem3-lab{lab_weight:g}"
        self.dim = CHANNELS["head"] + int(np.prod(self.BINS))

    def __call__(self, crops: Sequence[Rgb]) -> Float32[np.ndarray, "n d"]:
        if not crops:
            return np.zeros((0, self.dim), np.float32)
        shape = np.stack([gem(features([_square(rgb, self.SIDE)], ["head"])["head"][0].numpy()) for rgb in crops])
        colour = np.stack([lab_histogram(rgb, self.sigma, self.BINS) for rgb in crops])
        return _unit(np.concatenate([_unit(shape), self.lab_weight * _unit(colour)], axis=1)).astype(np.float32)


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


def load() -> LiteEncoder:
    """The embedded encoder; the backbone itself loads with the first crop."""
    return LiteEncoder()


def _square(rgb: Rgb, side: int) -> Rgb:
    """Resize with the aspect kept and centre on grey, which the backbone sees as zero."""
    small, _ = fit(rgb, side, multiple=1)
    h, w = small.shape[:2]
    out = np.full((side, side, 3), 127, np.uint8)
    top, left = (side - h) // 2, (side - w) // 2
    out[top : top + h, left : left + w] = small
    return out


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
