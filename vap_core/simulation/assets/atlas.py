"""A `Texture` drawn: one square RGB atlas, decoration above and swatches below."""

from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw

from vap_core.base.types import Rgb
from vap_core.simulation.assets.fills import FILLS, render_fill
from vap_core.simulation.assets.glyphs import draw_glyph, glyph_positions
from vap_core.simulation.assets.textures import (
    ATLAS_PX,
    DECORATION_SHARE,
    FIXED_COLOURS,
    Texture,
)


@lru_cache(maxsize=256)
def render_atlas(texture: Texture, aspect: float) -> Rgb:
    """The whole atlas, (512, 512, 3); `aspect` is the wall's circumference over its height."""
    top = round(ATLAS_PX * DECORATION_SHARE)
    picture = Image.new("RGB", (ATLAS_PX, ATLAS_PX))
    picture.paste(_render_decoration(texture, aspect).resize((ATLAS_PX, top), Image.Resampling.BOX))
    draw = ImageDraw.Draw(picture)
    swatches = (texture.base, texture.accent, texture.ink, *FIXED_COLOURS)
    for i, colour in enumerate(swatches):
        draw.rectangle((i * ATLAS_PX // 8, top, (i + 1) * ATLAS_PX // 8 - 1, ATLAS_PX), fill=colour)
    return np.asarray(picture)


def _render_decoration(texture: Texture, aspect: float) -> Image.Image:
    """The decorated wall unrolled, at its true proportions."""
    width = 2 * ATLAS_PX
    height = int(np.clip(round(width / aspect), 128, 2048))
    if texture.motif in FILLS:
        return _render_filled_wall(texture, width, height)
    return _render_glyph_wall(texture, width, height)


def _render_filled_wall(texture: Texture, width: int, height: int) -> Image.Image:
    picture = render_fill(texture, width, height)
    draw = ImageDraw.Draw(picture)
    if texture.layout == "half":
        draw.rectangle((0, 0, width, 0.45 * height), fill=texture.accent)
    elif texture.layout == "middle":
        draw.rectangle((0, 0, width, 0.2 * height), fill=texture.base)
        draw.rectangle((0, 0.8 * height, width, height), fill=texture.accent)
    return picture


def _render_glyph_wall(texture: Texture, width: int, height: int) -> Image.Image:
    picture = Image.new("RGB", (width, height), texture.base)
    draw = ImageDraw.Draw(picture)
    ground = texture.base
    if texture.layout == "band":
        ground = texture.accent
        draw.rectangle((0, 0.26 * height, width, 0.74 * height), fill=texture.accent)
    elif texture.layout == "row":
        for y in (0.06, 0.86):
            draw.rectangle((0, y * height, width, (y + 0.08) * height), fill=texture.accent)
    positions, radius = glyph_positions(texture, width, height)
    for x, y in positions:
        for wrap in (-width, 0, width):
            draw_glyph(draw, texture, (x + wrap, y), radius, ground)
    return picture
