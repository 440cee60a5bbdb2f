"""Patterns of materials: cloth, fur, hide and stone.

A fabric maps wall coordinates (x once around, y downwards, both in circumferences), a count n of
repeats around, and a random generator to the share of ink over base, 0..1. All close around the
body.
"""

from collections.abc import Callable

import numpy as np

Fabric = Callable[[np.ndarray, np.ndarray, int, np.random.Generator], np.ndarray]


def _clouds(x: np.ndarray, y: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Smooth random field with about n maxima around, standard deviation near 1."""
    total = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    for _ in range(10):
        across = rng.integers(-n, n + 1)
        down = rng.uniform(-n, n)
        phase = rng.uniform(0, 2 * np.pi)
        total += np.cos(2 * np.pi * (across * x + down * y) + phase)
    return total / np.sqrt(5)


def _cell_noise(
    x: np.ndarray, y: np.ndarray, rng: np.random.Generator, across: int, down: int
) -> np.ndarray:
    """A random value, 0..1, in every cell of a fine grid."""
    table = rng.random((97, across))
    return table[(y * down).astype(int) % 97, (x * across).astype(int) % across]


def _ridge(t: np.ndarray) -> np.ndarray:
    """0 in the middle of each unit, 1 at its borders."""
    return np.abs(2 * (t % 1) - 1)


def _quilt(x: np.ndarray, y: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    seam = np.maximum(_ridge(n * (x + y)), _ridge(n * (x - y)))
    return 0.9 * np.clip((seam - 0.82) / 0.1, 0, 1) + 0.25 * seam**3 * (seam < 0.92)


def _fuzz(x: np.ndarray, y: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    hairs = 0.45 * _cell_noise(x, y, rng, 40 * n, 16 * n) ** 2
    return np.clip(hairs + 0.12 * _clouds(x, y, n, rng), 0, 1)


def _ribs(x: np.ndarray, y: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    return 0.9 * _ridge(4 * n * x) ** 3 + 0 * y


def _hide(x: np.ndarray, y: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    grain = 0.08 + 0.09 * _clouds(x, y, 12 * n, rng)
    return np.clip(grain + 0.06 * _clouds(x, y, n, rng), 0, 0.4)


def _tabby(x: np.ndarray, y: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    bend = 0.35 * _clouds(x, y, 2, rng) + 0.5 * _ridge(x)
    stripes = np.cos(2 * np.pi * (n * y + bend)) + 0.25 * _clouds(x, y, 6, rng)
    return (stripes > 0.35).astype(np.float64)


def _patches(x: np.ndarray, y: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    return (_clouds(x, y, max(2, n // 2), rng) > 0.45).astype(np.float64)


def _sleek(x: np.ndarray, y: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    return 0.1 * _ridge(2 * x) ** 2 + 0 * y


def _cord(x: np.ndarray, y: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    return 0.7 * _ridge(3 * n * y) ** 4 + 0 * x


def _channels(x: np.ndarray, y: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    return np.clip(0.75 * _ridge(n * y) ** 6 + 0.1 * _ridge(2 * n * x), 0, 1)


def _fleece(x: np.ndarray, y: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    return np.clip(0.22 + 0.2 * _clouds(x, y, 7 * n, rng), 0, 0.8)


def _weave(x: np.ndarray, y: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    over = (np.floor(3 * n * x) + np.floor(3 * n * y)) % 2
    return 0.5 * np.where(over > 0, _ridge(3 * n * x), _ridge(3 * n * y)) ** 2


def _suede(x: np.ndarray, y: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    nap = 0.12 + 0.12 * _clouds(x, y, n, rng)
    return np.clip(nap + 0.1 * _cell_noise(x, y, rng, 60 * n, 60 * n), 0, 0.5)


def _marble(x: np.ndarray, y: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    return (np.abs(_clouds(x, y, n, rng)) < 0.28).astype(np.float64)


EVALUATION_FABRICS: dict[str, Fabric] = {
    "quilt": _quilt,
    "fuzz": _fuzz,
    "ribs": _ribs,
    "hide": _hide,
    "tabby": _tabby,
    "patches": _patches,
    "sleek": _sleek,
    "cord": _cord,
}
GENERIC_FABRICS: dict[str, Fabric] = {
    "channels": _channels,
    "fleece": _fleece,
    "weave": _weave,
    "suede": _suede,
    "marble": _marble,
}
FABRICS: dict[str, Fabric] = {**EVALUATION_FABRICS, **GENERIC_FABRICS}


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
