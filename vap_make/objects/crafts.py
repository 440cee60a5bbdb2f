"""Patterns of handcraft: wicker, rattan, knitting, crochet, planks.

A craft maps wall coordinates (x once around, y downwards, both in circumferences) and a count n of
repeats around to the share of ink over base, 0..1. It uses no random numbers, unlike `fabrics`.
"""

from collections.abc import Callable

import numpy as np

Craft = Callable[[np.ndarray, np.ndarray, int], np.ndarray]


def _wave(t: np.ndarray) -> np.ndarray:
    """0 at whole numbers, 1 half way."""
    return 0.5 - 0.5 * np.cos(2 * np.pi * t)


def _wicker(x: np.ndarray, y: np.ndarray, n: int) -> np.ndarray:
    """Withies that pass in front of every other stake, n stakes around."""
    row = np.floor(1.6 * n * y)
    behind = 1 - _wave(0.5 * (n * x + row))
    gap = 1 - _wave(1.6 * n * y)
    return np.clip(0.85 * behind**3 + 0.9 * gap**4, 0, 1)


def _rattan(x: np.ndarray, y: np.ndarray, n: int) -> np.ndarray:
    """Flat cane plaited over two and under two, on the slant."""
    u, v = n * (x + y), n * (x - y)
    over = (np.floor(u) + np.floor(v)) % 2 > 0
    return np.where(over, 0.9 * (1 - _wave(u)) ** 2, 0.25 + 0.75 * (1 - _wave(v)) ** 2)


def _knit(x: np.ndarray, y: np.ndarray, n: int) -> np.ndarray:
    """Stocking stitch: columns of V."""
    slant = 1.3 * n * y - 0.7 * np.abs(2 * ((n * x) % 1) - 1)
    return np.clip((1 - _wave(slant)) ** 2 + 0.5 * (1 - _wave(n * x)) ** 6, 0, 1)


def _crochet(x: np.ndarray, y: np.ndarray, n: int) -> np.ndarray:
    """Rows of round shells, every other row shifted."""
    row = np.floor(n * y)
    u, v = (n * x + 0.5 * row) % 1 - 0.5, (n * y) % 1 - 0.5
    return np.clip(7 * (u**2 + v**2) - 0.6, 0, 1)


def _seeds(x: np.ndarray, y: np.ndarray, n: int) -> np.ndarray:
    """Slim drops, every other row shifted."""
    row = np.floor(0.9 * n * y)
    u, v = (n * x + 0.5 * row) % 1 - 0.5, (0.9 * n * y) % 1 - 0.5
    return ((u / (0.15 + 0.16 * v)) ** 2 + (v / 0.3) ** 2 < 1).astype(np.float64)


def _planks(x: np.ndarray, y: np.ndarray, n: int) -> np.ndarray:
    """Clapboards: a shadow below the edge of each."""
    return 0.55 * np.clip(((n * y) % 1 - 0.72) / 0.28, 0, 1) + 0 * x


EVALUATION_CRAFTS: dict[str, Craft] = {
    "wicker": _wicker,
    "knit": _knit,
    "seeds": _seeds,
    "planks": _planks,
}
GENERIC_CRAFTS: dict[str, Craft] = {"rattan": _rattan, "crochet": _crochet}
CRAFTS: dict[str, Craft] = {**EVALUATION_CRAFTS, **GENERIC_CRAFTS}
