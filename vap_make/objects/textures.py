"""The motifs that a `Texture` may have, and how the atlas is laid out.

The upper `DECORATION_SHARE` of a texture atlas wraps once around the object: left to right as a
reader walks around it, top row at the top of the body. The strip below it holds eight flat
swatches for handles, caps, eyes and other plain parts.
"""

from typing import Literal

import numpy as np

from vap_core.simulation.assets.shapes import Srgb as Srgb
from vap_core.simulation.assets.shapes import Texture as Texture

DECORATION_SHARE = 0.75

DECORATED = -1
"""Stands for a swatch's number where a part shows the decoration."""
BASE, ACCENT, INK, DARK, LIGHT, METAL, WARM, GLASS = range(8)
"""Swatches by their place in the strip: the texture's own colours, then fixed ones."""
SWATCHES: dict[str, int] = {
    "base": BASE,
    "ink": INK,
    "accent": ACCENT,
    "dark": DARK,
    "light": LIGHT,
    "warm": WARM,
}

MotifLayout = Literal[
    "row", "brick", "band", "full", "half", "grid", "scatter", "column", "middle", "whole"
]
EVALUATION_FILLS = ("stripes", "hoops", "checks", "dots", "chevron", "plaid")
"""Fills of evaluation objects; their glyphs and layouts, too, are all outside the lists below."""
GENERIC_GLYPHS = ("triangle", "square", "ring", "diamond", "cross", "drop", "hexagon", "digit")
GENERIC_FILLS = ("gradient", "waves", "speckle", "tiles", "diagonal", "plain")
GENERIC_GLYPH_LAYOUTS: tuple[MotifLayout, ...] = ("grid", "scatter", "column")
GENERIC_FILL_LAYOUTS: tuple[MotifLayout, ...] = ("middle", "whole")


def swatch_uv(swatch: int, shape: tuple[int, ...]) -> np.ndarray:
    """Texture coordinates (*shape, 2), all in the middle of a swatch."""
    return np.broadcast_to([(swatch + 0.5) / 8, (1 + DECORATION_SHARE) / 2], (*shape, 2))


def decoration_v(down: np.ndarray) -> np.ndarray:
    """Image y of rows of the decoration, which `down` counts from 0 (top) to 1 (bottom)."""
    return 0.004 + (DECORATION_SHARE - 0.012) * down
