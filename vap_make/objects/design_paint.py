"""Pictures for made-up designs: plain ones, and loud ones that no other object of the scenes wears.

A picture wraps twice around a body, so that its seam can lie anywhere.
"""

import colorsys
from collections.abc import Callable

import numpy as np
from jaxtyping import Float64

from vap_core.base.types import Rgb
from vap_make.objects.textures import Srgb

SIDE = 256
"""Pixels of one turn around a body, and of its height."""
Paint = Callable[[np.random.Generator, list[Srgb]], Rgb]


def draw_colours(rng: np.random.Generator) -> list[Srgb]:
    """Four saturated colours, well apart in hue."""
    start = rng.uniform()
    colours = []
    for i in range(4):
        hue = (start + i / 4 + rng.uniform(-0.04, 0.04)) % 1
        rgb = colorsys.hsv_to_rgb(hue, rng.uniform(0.55, 0.9), rng.uniform(0.45, 0.95))
        red, green, blue = (round(255 * channel) for channel in rgb)
        colours.append((red, green, blue))
    return colours


def plain(rng: np.random.Generator, colours: list[Srgb]) -> Rgb:
    """One colour."""
    return _coloured(np.zeros((SIDE, SIDE), int), colours)


def dipped(rng: np.random.Generator, colours: list[Srgb]) -> Rgb:
    """The lower part in a second colour, along a line that goes up and down."""
    x, y = _turns()
    line = rng.uniform(0.4, 0.6) + 0.05 * np.sin(2 * np.pi * rng.integers(1, 4) * x)
    return _coloured((y > line).astype(int), colours)


def spiral(rng: np.random.Generator, colours: list[Srgb]) -> Rgb:
    """Bands that climb around the body."""
    x, y = _turns()
    bands = rng.integers(2, 5) * x + rng.uniform(2, 4) * y
    return _coloured(np.floor(bands * 2).astype(int) % 3, colours)


def mosaic(rng: np.random.Generator, colours: list[Srgb]) -> Rgb:
    """Cells around random points, each of one colour."""
    return _coloured(_nearest(rng, int(rng.integers(20, 50))) % len(colours), colours)


def camouflage(rng: np.random.Generator, colours: list[Srgb]) -> Rgb:
    """Smooth patches."""
    x, y = _turns()
    field = np.zeros((SIDE, SIDE))
    for _ in range(12):
        phase = rng.uniform(0, 2 * np.pi)
        field += np.sin(2 * np.pi * (rng.integers(-4, 5) * x + rng.uniform(-4, 4) * y) + phase)
    levels = np.quantile(field, np.arange(1, len(colours)) / len(colours))
    return _coloured(np.digitize(field, levels), colours)


def confetti(rng: np.random.Generator, colours: list[Srgb]) -> Rgb:
    """Discs of all colours on the first."""
    x, y = _turns()
    number = np.zeros((SIDE, SIDE), int)
    for i in range(int(rng.integers(25, 45))):
        at_x, at_y = rng.uniform(size=2)
        across = np.abs(x - at_x)
        across = np.minimum(across, 1 - across)
        number[np.hypot(across, y - at_y) < rng.uniform(0.03, 0.07)] = 1 + i % (len(colours) - 1)
    return _coloured(number, colours)


QUIET: tuple[Paint, ...] = (plain, dipped)
LOUD: tuple[Paint, ...] = (spiral, mosaic, camouflage, confetti)


def _turns() -> tuple[Float64[np.ndarray, "s s"], Float64[np.ndarray, "s s"]]:
    """Of every pixel the share of a turn, and of the height from above."""
    share = (np.arange(SIDE) + 0.5) / SIDE
    x, y = np.meshgrid(share, share)
    return x, y


def _nearest(rng: np.random.Generator, count: int) -> np.ndarray:
    """The number of the nearest of some random points, around the seam, too."""
    x, y = _turns()
    best = np.full((SIDE, SIDE), np.inf)
    number = np.zeros((SIDE, SIDE), int)
    for i, (at_x, at_y) in enumerate(rng.uniform(size=(count, 2))):
        across = np.abs(x - at_x)
        away = np.hypot(np.minimum(across, 1 - across), y - at_y)
        number[away < best] = i
        best = np.minimum(best, away)
    return number


def _coloured(number: np.ndarray, colours: list[Srgb]) -> Rgb:
    """The picture of colour numbers, twice side by side."""
    once = np.array(colours, np.uint8)[number]
    return np.concatenate([once, once], axis=1)
