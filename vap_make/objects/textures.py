"""The motifs that a `Texture` may have, and how the atlas is laid out.

The upper `DECORATION_SHARE` of a texture atlas wraps once around the object: left to right as a
reader walks around it, top row at the top of the body. The strip below it holds eight flat
swatches for handles, caps, eyes and other plain parts.
"""

from functools import lru_cache
from typing import Literal

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from vap_core.base.types import Rgb
from vap_core.simulation.assets.objects import ATLAS_PX, atlas, speckled
from vap_core.simulation.assets.shapes import Srgb as Srgb
from vap_core.simulation.assets.shapes import Texture as Texture
from vap_make.objects.fabrics import CRAFTS, FABRICS
from vap_make.objects.shapes import Number

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
    weight = np.asarray(share, np.float64)
    mixed = [weight * o + (1 - weight) * u for o, u in zip(over, under, strict=True)]
    return Image.merge("RGB", [Image.fromarray(np.rint(part).astype(np.uint8)) for part in mixed])


GlyphPoint = tuple[Number, Number]
"""A point of a glyph (x right, y down), in its radii from its centre, or of the picture, pixels."""


def _star(arms: int, inner: Number) -> list[GlyphPoint]:
    angle = -np.pi / 2 + np.pi * np.arange(2 * arms) / arms
    radius = np.where(np.arange(2 * arms) % 2, inner, 1.0)
    return list(zip(radius * np.cos(angle), radius * np.sin(angle), strict=True))


def _heart() -> list[GlyphPoint]:
    t = np.linspace(0, 2 * np.pi, 40)
    y = 13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t)
    return list(zip(np.sin(t) ** 3, -(y + 2.5) / 15, strict=True))


def _leaf() -> list[GlyphPoint]:
    t = np.linspace(-1, 1, 20)
    side = 0.5 * (1 - t**2) * (1 + 0.35 * t)
    return [*zip(side, t, strict=True), *zip(-side[::-1], t[::-1], strict=True)]


def _drop() -> list[GlyphPoint]:
    t = np.linspace(0, 2 * np.pi, 30)
    return list(zip(0.62 * np.sin(t) * np.sin(t / 2), -np.cos(t), strict=True))


def _cross() -> list[GlyphPoint]:
    short, long = 0.28, 0.9
    x = (-short, short, short, long, long, short, short, -short, -short, -long, -long, -short)
    y = (-long, -long, -short, -short, short, short, long, long, short, short, -short, -short)
    return list(zip(x, y, strict=True))


def _hexagon() -> list[GlyphPoint]:
    corners: list[GlyphPoint] = []
    for angle in np.pi / 3 * np.arange(6):
        corners.append((float(np.cos(angle)), float(np.sin(angle))))
    return corners


POLYGONS: dict[str, list[GlyphPoint]] = {
    "heart": _heart(),
    "star": _star(5, 0.42),
    "bolt": [(0.15, -1), (-0.55, 0.15), (-0.05, 0.15), (-0.2, 1), (0.55, -0.25), (0.02, -0.25)],
    "triangle": _star(3, 0.5),
    "square": [(-0.75, -0.75), (0.75, -0.75), (0.75, 0.75), (-0.75, 0.75)],
    "diamond": [(0, -1), (0.65, 0), (0, 1), (-0.65, 0)],
    "cross": _cross(),
    "drop": _drop(),
    "hexagon": _hexagon(),
    "leaf": _leaf(),
}


def draw_glyph(
    draw: ImageDraw.ImageDraw, texture: Texture, centre: GlyphPoint, radius: Number, ground: Srgb
) -> None:
    """Stamp the texture's motif at a pixel, `radius` pixels from centre to rim.

    Holes in the motif show the colour `ground`.
    """
    (x, y), r = centre, radius
    ink, accent = texture.ink, texture.accent

    def disc(dx: Number, dy: Number, half_x: Number, half_y: Number, colour: Srgb) -> None:
        """An ellipse; its centre and half-sizes are in radii of the glyph."""
        box = (
            x + r * (dx - half_x),
            y + r * (dy - half_y),
            x + r * (dx + half_x),
            y + r * (dy + half_y),
        )
        draw.ellipse(box, fill=colour)

    match texture.motif:
        case "word" | "digit":
            draw.text(
                (x, y),
                texture.word,
                font=ImageFont.load_default(size=1.45 * r),
                fill=ink,
                anchor="mm",
                stroke_width=max(1, round(0.07 * r)),
                stroke_fill=ink,
            )
        case "flower":
            for angle in 2 * np.pi * np.arange(6) / 6:
                disc(0.6 * np.cos(angle), 0.6 * np.sin(angle), 0.38, 0.38, ink)
            disc(0, 0, 0.32, 0.32, accent)
        case "moon":
            disc(0, 0, 0.95, 0.95, ink)
            disc(0.42, -0.15, 0.75, 0.75, ground)
        case "paw":
            disc(0, 0.38, 0.58, 0.5, ink)
            for dx, dy in ((-0.72, -0.15), (-0.27, -0.6), (0.27, -0.6), (0.72, -0.15)):
                disc(dx, dy, 0.22, 0.28, ink)
        case "smile":
            disc(0, 0, 1, 1, ink)
            disc(-0.36, -0.28, 0.14, 0.2, ground)
            disc(0.36, -0.28, 0.14, 0.2, ground)
            draw.arc(
                (x - 0.6 * r, y - 0.55 * r, x + 0.6 * r, y + 0.62 * r),
                start=15,
                end=165,
                fill=ground,
                width=max(2, round(0.17 * r)),
            )
        case "fish":
            disc(-0.15, 0, 0.75, 0.45, ink)
            draw.polygon([(x + 0.4 * r, y), (x + r, y - 0.5 * r), (x + r, y + 0.5 * r)], fill=ink)
            disc(-0.52, -0.1, 0.1, 0.1, ground)
        case "ring":
            disc(0, 0, 0.95, 0.95, ink)
            disc(0, 0, 0.55, 0.55, ground)
        case _:
            points = np.array([x, y]) + r * np.array(POLYGONS[texture.motif])
            draw.polygon(points.ravel().tolist(), fill=ink)
            if texture.motif == "leaf":
                stem = (x, y - 0.7 * r, x, y + 1.25 * r)
                draw.line(stem, fill=accent, width=max(2, round(0.12 * r)))


def glyph_positions(texture: Texture, width: int, height: int) -> tuple[list[GlyphPoint], float]:
    """Centres of the glyphs in pixels of a width x height picture, and their radius."""
    repeats = texture.repeats
    pitch = width / repeats
    centres = (np.arange(repeats) + 0.5 * (repeats % 2)) * pitch
    narrowing = 1 / max(1.0, 0.5 * len(texture.word))
    match texture.layout:
        case "brick":
            radius = min(0.3 * pitch, 0.17 * height)
            rows = max(2, int(height / (2.7 * radius)))
            positions = _brick_positions(centres, pitch, rows, width, height)
        case "grid":
            radius = min(0.28 * pitch, 0.15 * height)
            positions = _column_positions(centres, (0.25, 0.5, 0.75), height)
        case "column":
            radius = min(0.4 * pitch, 0.09 * height)
            positions = _column_positions(centres[::2], (0.18, 0.39, 0.6, 0.82), height)
        case "scatter":
            radius = min(0.22 * pitch, 0.1 * height)
            positions = _scattered_positions(texture, width, height)
        case "band":
            radius = min(0.4 * pitch, 0.19 * height)
            positions = _column_positions(centres, (0.5,), height)
        case _:
            radius = min(0.44 * pitch, 0.27 * height)
            positions = _column_positions(centres, (0.5,), height)
    return positions, radius * narrowing


def _brick_positions(
    centres: np.ndarray, pitch: Number, rows: int, width: int, height: int
) -> list[GlyphPoint]:
    """Rows of glyphs, every other row shifted by half a pitch."""
    positions: list[GlyphPoint] = []
    row_y = (np.arange(rows) + 0.5) * height / rows
    for i, y in enumerate(row_y):
        for x in centres:
            positions.append((float((x + 0.5 * pitch * (i % 2)) % width), float(y)))
    return positions


def _column_positions(
    centres: np.ndarray, shares: tuple[Number, ...], height: int
) -> list[GlyphPoint]:
    """In every column one glyph at each share of the height."""
    positions: list[GlyphPoint] = []
    for x in centres:
        for share in shares:
            positions.append((float(x), height * share))
    return positions


def _scattered_positions(texture: Texture, width: int, height: int) -> list[GlyphPoint]:
    rng = np.random.default_rng([11, texture.seed])
    shares = rng.random((4 * texture.repeats, 2)) * (0.9, 0.84) + (0.05, 0.08)
    positions: list[GlyphPoint] = []
    for x, y in shares:
        positions.append((float(x * width), float(y * height)))
    return positions


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
