"""A `Texture` drawn: one square RGB atlas, decoration above and swatches below."""

from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw

from vap_core.base.types import Rgb
from vap_core.simulation.assets.objects import ATLAS_PX, atlas, speckled
from vap_make.objects.fills import FILLS, draw_spots, render_fill
from vap_make.objects.glyphs import draw_glyph, glyph_positions
from vap_make.objects.textures import Texture


@lru_cache(maxsize=256)
def render_atlas(texture: Texture, aspect: float) -> Rgb:
    """The whole atlas, (512, 512, 3); `aspect` is the wall's circumference over its height."""
    width, height = 2 * ATLAS_PX, wall_px(aspect)
    if texture.motif == "speckle":
        return speckled(texture, draw_spots(texture, width, height), height)
    render = render_fill if texture.motif in FILLS else _render_glyph_wall
    return atlas(texture, render(texture, width, height))


def wall_px(aspect: float) -> int:
    """The height of the unrolled wall, drawn twice as wide as the atlas."""
    return int(np.clip(round(2 * ATLAS_PX / aspect), 128, 2048))


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
