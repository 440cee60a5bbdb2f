"""Motifs that fill the whole wall: stripes, checks, waves, fabrics and crafts."""

import numpy as np
from PIL import Image

from vap_make.objects.crafts import CRAFTS
from vap_make.objects.fabrics import FABRICS
from vap_make.objects.textures import EVALUATION_FILLS, GENERIC_FILLS, Srgb, Texture

FILLS = frozenset((*EVALUATION_FILLS, *GENERIC_FILLS, *FABRICS, *CRAFTS))
"""Every motif that `render_fill` draws."""


def render_fill(texture: Texture, width: int, height: int) -> Image.Image:
    """The texture's pattern over width x height pixels; it closes around the object."""
    match texture.motif:
        case "plaid":
            return _render_plaid(texture, width, height)
        case "plain":
            return Image.new("RGB", (width, height), texture.base)
        case _:
            return _blend(_ink_share(texture, width, height), texture.ink, texture.base)


def _ink_share(texture: Texture, width: int, height: int) -> np.ndarray:
    """Where the pattern shows ink (1) and where base (0)."""
    x, y = _wall_coordinates(width, height)
    n, tall = texture.repeats, height / width
    match texture.motif:
        case "stripes":
            return _is_odd(2 * n * x)
        case "hoops":
            return _is_odd(y / tall * (2 * (n // 2) + 1))
        case "checks":
            return _is_odd(2 * n * x) ^ _is_odd(2 * n * y)
        case "dots":
            across = (n * x + 0.5 * _is_odd(n * y * 1.1)) % 1 - 0.5
            down = (n * y * 1.1) % 1 - 0.5
            return across**2 + down**2 < 0.095
        case "chevron":
            return _is_odd(2.2 * n * y + np.abs((n * x) % 1 - 0.5) * 2.4)
        case "gradient":
            return np.clip(y / tall, 0, 1)
        case "waves":
            return _is_odd(2 * n * y + 0.35 * np.sin(2 * np.pi * n * x))
        case "diagonal":
            return _is_odd(2 * n * (x + y))
        case "tiles":
            joint_across = (n * x + 0.5 * _is_odd(2 * n * y)) % 1 < 0.12
            return joint_across | ((2 * n * y) % 1 < 0.2)
        case motif if motif in CRAFTS:
            return CRAFTS[motif](x, y, n)
        case motif:
            return FABRICS[motif](x, y, n, np.random.default_rng([13, texture.seed]))


def _render_plaid(texture: Texture, width: int, height: int) -> Image.Image:
    """Two crossing bands of half-strength ink with thin lines of accent between them."""
    x, y = _wall_coordinates(width, height)
    n = texture.repeats
    bands = 0.5 * _is_odd(2 * n * x) + 0.5 * _is_odd(2 * n * y)
    lines = ((2 * n * x) % 2 < 0.16) | ((2 * n * y) % 2 < 0.16)
    ground = _blend(bands, texture.ink, texture.base)
    mask = _blend(lines, (255, 255, 255), (0, 0, 0)).convert("L")
    return Image.composite(Image.new("RGB", (width, height), texture.accent), ground, mask)


def draw_spots(texture: Texture, width: int, height: int) -> np.ndarray:
    """Where a speckled wall has a spot of ink, on a coarse grid."""
    rng = np.random.default_rng([7, texture.seed])
    return rng.random((max(8, height // 14), width // 14)) < 0.06 * texture.repeats


def _wall_coordinates(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """x (around) and y (downwards) of every pixel, both in circumferences."""
    y, x = np.mgrid[0:height, 0:width]
    return x / width, y / width


def _is_odd(t: np.ndarray) -> np.ndarray:
    return np.floor(t).astype(int) % 2 == 1


def _blend(share: np.ndarray, over: Srgb, under: Srgb) -> Image.Image:
    """A picture with `share` of the colour `over` and the rest of the colour `under`."""
    weight = np.asarray(share, np.float64)[..., None]
    pixels = weight * np.array(over) + (1 - weight) * np.array(under)
    return Image.fromarray(np.rint(pixels).astype(np.uint8))
