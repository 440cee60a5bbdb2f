"""Procedural decoration: a frozen `Texture` becomes one square RGB atlas.

The upper `DECOR` share of the atlas wraps once around the object (left to right as a reader walks around it, top row at the
top of the body); the strip below it holds eight flat swatches for handles, caps, eyes and other plain parts.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Literal

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from vap_core.sim.crafts import CRAFTS
from vap_core.sim.fabrics import FABRICS
from vap_core.values import Rgb, value

Ink = tuple[int, int, int]
Point = tuple[float | int, float | int]
ATLAS_PX = 512
DECOR = 0.75
BASE, ACCENT, INK, DARK, LIGHT, METAL, WARM, GLASS = range(8)
FIXED: tuple[Ink, ...] = ((44, 43, 47), (240, 236, 226), (158, 160, 164), (206, 150, 66), (66, 82, 98))

Layout = Literal["row", "brick", "band", "full", "half", "grid", "scatter", "column", "middle", "whole"]
EVALUATION_GLYPHS = ("heart", "star", "flower", "leaf", "moon", "paw", "smile", "word", "fish", "bolt")
EVALUATION_FILLS = ("stripes", "hoops", "checks", "dots", "chevron", "plaid")
EVALUATION_LAYOUTS = ("row", "brick", "band", "full", "half")
GENERIC_GLYPHS = ("triangle", "square", "ring", "diamond", "cross", "drop", "hexagon", "digit")
GENERIC_FILLS = ("gradient", "waves", "speckle", "tiles", "diagonal", "plain")
GENERIC_LAYOUTS: tuple[Layout, ...] = ("grid", "scatter", "column", "middle", "whole")


@value
class Texture:
    """A decoration. Colours are sRGB 0..255; `repeats` motifs around the body; `word` is drawn by motif "word" or "digit"; `seed` places scatter."""

    base: Ink
    ink: Ink
    accent: Ink
    motif: str
    layout: Layout
    repeats: int = 4
    word: str = ""
    seed: int = 0


def _star(arms: int, inner: float, turn: float = -np.pi / 2) -> list[Point]:
    angle = turn + np.pi * np.arange(2 * arms) / arms
    radius = np.where(np.arange(2 * arms) % 2, inner, 1.0)
    return list(zip(radius * np.cos(angle), radius * np.sin(angle), strict=True))


def _heart() -> list[Point]:
    t = np.linspace(0, 2 * np.pi, 40)
    y = 13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t)
    return list(zip(np.sin(t) ** 3, -(y + 2.5) / 15, strict=True))


def _leaf() -> list[Point]:
    t = np.linspace(-1, 1, 20)
    side = 0.5 * (1 - t**2) * (1 + 0.35 * t)
    return [*zip(side, t, strict=True), *zip(-side[::-1], t[::-1], strict=True)]


def _drop() -> list[Point]:
    t = np.linspace(0, 2 * np.pi, 30)
    return list(zip(0.62 * np.sin(t) * np.sin(t / 2), -np.cos(t), strict=True))


POLYGONS: dict[str, list[Point]] = {
    "heart": _heart(),
    "star": _star(5, 0.42),
    "bolt": [(0.15, -1), (-0.55, 0.15), (-0.05, 0.15), (-0.2, 1), (0.55, -0.25), (0.02, -0.25)],
    "triangle": _star(3, 0.5),
    "square": [(-0.75, -0.75), (0.75, -0.75), (0.75, 0.75), (-0.75, 0.75)],
    "diamond": [(0, -1), (0.65, 0), (0, 1), (-0.65, 0)],
    "cross": [(x, y) for x, y in zip((-0.28, 0.28, 0.28, 0.9, 0.9, 0.28, 0.28, -0.28, -0.28, -0.9, -0.9, -0.28),
                                     (-0.9, -0.9, -0.28, -0.28, 0.28, 0.28, 0.9, 0.9, 0.28, 0.28, -0.28, -0.28), strict=True)],
    "drop": _drop(),
    "hexagon": [(float(np.cos(a)), float(np.sin(a))) for a in np.pi / 3 * np.arange(6)],
    "leaf": _leaf(),
}  # fmt: skip


def glyph(draw: ImageDraw.ImageDraw, texture: Texture, x: float, y: float, r: float, paper: Ink) -> None:
    """Stamp the motif at pixel (x, y), r pixels from centre to rim, on a ground of colour `paper`."""
    ink, accent = texture.ink, texture.accent

    def disc(dx: float | int, dy: float | int, rx: float | int, ry: float | int, colour: Ink) -> None:
        draw.ellipse((x + r * (dx - rx), y + r * (dy - ry), x + r * (dx + rx), y + r * (dy + ry)), fill=colour)

    match texture.motif:
        case "word" | "digit":
            font = ImageFont.load_default(size=1.45 * r)
            draw.text((x, y), texture.word, font=font, fill=ink, anchor="mm", stroke_width=max(1, round(0.07 * r)), stroke_fill=ink)
        case "flower":
            for a in 2 * np.pi * np.arange(6) / 6:
                disc(0.6 * np.cos(a), 0.6 * np.sin(a), 0.38, 0.38, ink)
            disc(0, 0, 0.32, 0.32, accent)
        case "moon":
            disc(0, 0, 0.95, 0.95, ink)
            disc(0.42, -0.15, 0.75, 0.75, paper)
        case "paw":
            disc(0, 0.38, 0.58, 0.5, ink)
            for dx, dy in ((-0.72, -0.15), (-0.27, -0.6), (0.27, -0.6), (0.72, -0.15)):
                disc(dx, dy, 0.22, 0.28, ink)
        case "smile":
            disc(0, 0, 1, 1, ink)
            disc(-0.36, -0.28, 0.14, 0.2, paper)
            disc(0.36, -0.28, 0.14, 0.2, paper)
            draw.arc((x - 0.6 * r, y - 0.55 * r, x + 0.6 * r, y + 0.62 * r), 15, 165, fill=paper, width=max(2, round(0.17 * r)))
        case "fish":
            disc(-0.15, 0, 0.75, 0.45, ink)
            draw.polygon([(x + 0.4 * r, y), (x + r, y - 0.5 * r), (x + r, y + 0.5 * r)], fill=ink)
            disc(-0.52, -0.1, 0.1, 0.1, paper)
        case "ring":
            disc(0, 0, 0.95, 0.95, ink)
            disc(0, 0, 0.55, 0.55, paper)
        case _:
            draw.polygon([(x + r * px, y + r * py) for px, py in POLYGONS[texture.motif]], fill=ink)
            if texture.motif == "leaf":
                draw.line((x, y - 0.7 * r, x, y + 1.25 * r), fill=accent, width=max(2, round(0.12 * r)))


def _where(pattern: Callable[[np.ndarray, np.ndarray], np.ndarray], w: int, h: int, over: Ink, under: Ink) -> Image.Image:
    y, x = np.mgrid[0:h, 0:w]
    share = np.asarray(pattern(x / w, y / w), np.float64)[..., None]
    return Image.fromarray(np.rint(share * np.array(over) + (1 - share) * np.array(under)).astype(np.uint8))


def fill(texture: Texture, w: int, h: int) -> Image.Image:
    """A pattern over w x h pixels that closes around the object; coordinates are in circumferences."""
    n, ink, base = texture.repeats, texture.ink, texture.base
    tall = h / w

    def odd(t: np.ndarray) -> np.ndarray:
        return np.floor(t).astype(int) % 2 == 1

    match texture.motif:
        case "stripes":
            return _where(lambda x, y: odd(2 * n * x), w, h, ink, base)
        case "hoops":
            return _where(lambda x, y: odd(y / tall * (2 * (n // 2) + 1)), w, h, ink, base)
        case "checks":
            return _where(lambda x, y: odd(2 * n * x) ^ odd(2 * n * y), w, h, ink, base)
        case "dots":
            return _where(lambda x, y: ((n * x + 0.5 * odd(n * y * 1.1)) % 1 - 0.5) ** 2 + ((n * y * 1.1) % 1 - 0.5) ** 2 < 0.095, w, h, ink, base)
        case "chevron":
            return _where(lambda x, y: odd(2.2 * n * y + np.abs((n * x) % 1 - 0.5) * 2.4), w, h, ink, base)
        case "plaid":
            ground = _where(lambda x, y: 0.5 * odd(2 * n * x) + 0.5 * odd(2 * n * y), w, h, ink, base)
            lines = _where(lambda x, y: ((2 * n * x) % 2 < 0.16) | ((2 * n * y) % 2 < 0.16), w, h, (255, 255, 255), (0, 0, 0)).convert("L")
            return Image.composite(Image.new("RGB", (w, h), texture.accent), ground, lines)
        case "gradient":
            return _where(lambda x, y: np.clip(y / tall, 0, 1), w, h, ink, base)
        case "waves":
            return _where(lambda x, y: odd(2 * n * y + 0.35 * np.sin(2 * np.pi * n * x)), w, h, ink, base)
        case "diagonal":
            return _where(lambda x, y: odd(2 * n * (x + y)), w, h, ink, base)
        case "tiles":
            return _where(lambda x, y: ((n * x + 0.5 * odd(2 * n * y)) % 1 < 0.12) | ((2 * n * y) % 1 < 0.2), w, h, ink, base)
        case "speckle":
            noise = np.random.default_rng([7, texture.seed]).random((max(8, h // 14), w // 14)) < 0.06 * n
            mask = Image.fromarray((255 * noise).astype(np.uint8)).resize((w, h), Image.Resampling.BICUBIC)
            return Image.composite(Image.new("RGB", (w, h), ink), Image.new("RGB", (w, h), base), mask)
        case craft if craft in CRAFTS:
            return _where(lambda x, y: CRAFTS[craft](x, y, n), w, h, ink, base)
        case fabric if fabric in FABRICS:
            return _where(lambda x, y: FABRICS[fabric](x, y, n, np.random.default_rng([13, texture.seed])), w, h, ink, base)
        case _:
            return Image.new("RGB", (w, h), base)


def _places(texture: Texture, w: int, h: int) -> tuple[list[Point], float]:
    """Glyph centres in pixels and their radius."""
    n = texture.repeats
    pitch = w / n
    wide = 1 / max(1.0, 0.5 * len(texture.word))
    centres = (np.arange(n) + 0.5 * (n % 2)) * pitch
    match texture.layout:
        case "brick":
            r = min(0.3 * pitch, 0.17 * h)
            rows = max(2, int(h / (2.7 * r)))
            ys = (np.arange(rows) + 0.5) * h / rows
            return [(float((x + 0.5 * pitch * (i % 2)) % w), float(y)) for i, y in enumerate(ys) for x in centres], r * wide
        case "grid":
            r = min(0.28 * pitch, 0.15 * h)
            return [(float(x), h * y) for x in centres for y in (0.25, 0.5, 0.75)], r * wide
        case "column":
            return [(float(x), h * y) for x in centres[::2] for y in (0.18, 0.39, 0.6, 0.82)], min(0.4 * pitch, 0.09 * h) * wide
        case "scatter":
            spots = np.random.default_rng([11, texture.seed]).random((4 * n, 2)) * (0.9, 0.84) + (0.05, 0.08)
            return [(float(x * w), float(y * h)) for x, y in spots], min(0.22 * pitch, 0.1 * h) * wide
        case "band":
            return [(float(x), 0.5 * h) for x in centres], min(0.4 * pitch, 0.19 * h) * wide
        case _:
            return [(float(x), 0.5 * h) for x in centres], min(0.44 * pitch, 0.27 * h) * wide


def decoration(texture: Texture, aspect: float) -> Image.Image:
    """The decorated wall unrolled; `aspect` is its circumference over its height."""
    w = 2 * ATLAS_PX
    h = int(np.clip(round(w / aspect), 128, 2048))
    if texture.motif in (*EVALUATION_FILLS, *GENERIC_FILLS, *FABRICS, *CRAFTS):
        picture = fill(texture, w, h)
        draw = ImageDraw.Draw(picture)
        if texture.layout == "half":
            draw.rectangle((0, 0, w, 0.45 * h), fill=texture.accent)
        elif texture.layout == "middle":
            draw.rectangle((0, 0, w, 0.2 * h), fill=texture.base)
            draw.rectangle((0, 0.8 * h, w, h), fill=texture.accent)
        return picture
    picture = Image.new("RGB", (w, h), texture.base)
    draw = ImageDraw.Draw(picture)
    paper = texture.accent if texture.layout == "band" else texture.base
    if texture.layout == "band":
        draw.rectangle((0, 0.26 * h, w, 0.74 * h), fill=texture.accent)
    elif texture.layout == "row":
        for y in (0.06, 0.86):
            draw.rectangle((0, y * h, w, (y + 0.08) * h), fill=texture.accent)
    places, r = _places(texture, w, h)
    for x, y in places:
        for wrap in (-w, 0, w):
            glyph(draw, texture, x + wrap, y, r, paper)
    return picture


@lru_cache(maxsize=256)
def atlas(texture: Texture, aspect: float) -> Rgb:
    """The whole texture, (512, 512, 3): decoration above, swatches below."""
    top = round(ATLAS_PX * DECOR)
    picture = Image.new("RGB", (ATLAS_PX, ATLAS_PX))
    picture.paste(decoration(texture, aspect).resize((ATLAS_PX, top), Image.Resampling.BOX))
    draw = ImageDraw.Draw(picture)
    for i, colour in enumerate((texture.base, texture.accent, texture.ink, *FIXED)):
        draw.rectangle((i * ATLAS_PX // 8, top, (i + 1) * ATLAS_PX // 8 - 1, ATLAS_PX), fill=colour)
    return np.asarray(picture)
