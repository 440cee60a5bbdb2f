"""Pictures of photos with boxes and text, and contact sheets of them."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vap_core.base.files import writing
from vap_core.base.types import Rgb

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont

LABEL_PX, COLUMNS = 34, 4
GAP_PX = 10
"""Between the tiles of a sheet of scenes, whose pictures would touch."""
LARGEST_PX, SMALLEST_PX = 13, 10
"""Sizes of a label's text, from that of a short one to that of a long one."""
TRUTH, RIGHT, WRONG, SILENT = (255, 255, 255), (60, 200, 90), (235, 60, 50), (160, 160, 160)
DOUBTFUL = (250, 180, 40)


def join_tiles(tiles: Sequence[Rgb], columns: int = COLUMNS, gap_px: int = 0) -> Rgb:
    """Tiles of one size in rows, on white; `gap_px` lie between two."""
    height, width = tiles[0].shape[:2]
    down, across = height + gap_px, width + gap_px
    rows = -(-len(tiles) // columns)
    shape = (rows * down - gap_px, min(columns, len(tiles)) * across - gap_px, 3)
    out = np.full(shape, 255, np.uint8)
    for i, tile in enumerate(tiles):
        y, x = i // columns * down, i % columns * across
        out[y : y + height, x : x + width] = tile
    return out


def fit(rgb: Rgb, width: int, height: int) -> tuple[Rgb, float]:
    """The picture scaled to fit into a white tile, at its top left corner, and by how much."""
    scale = min(width / rgb.shape[1], height / rgb.shape[0])
    size = (max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale)))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    out = np.full((height, width, 3), 255, np.uint8)
    small = cv2.resize(rgb, size, interpolation=method)
    out[: small.shape[0], : small.shape[1]] = small
    return out, scale


def draw_box(rgb: Rgb, box: Sequence[float], colour: tuple[int, int, int], width: int) -> None:
    """A box on `rgb`, in place, with a dark rim so that it shows on any ground."""
    near = (round(box[0]), round(box[1]))
    far = (round(box[2]) - 1, round(box[3]) - 1)
    cv2.rectangle(rgb, near, far, (0, 0, 0), width + 2)
    cv2.rectangle(rgb, near, far, colour, width)


def labelled(rgb: Rgb, lines: Sequence[str]) -> Rgb:
    """The picture with two lines of text below, which are made to fit its width."""
    from PIL import Image, ImageDraw

    label = Image.new("RGB", (rgb.shape[1], LABEL_PX), "white")
    draw = ImageDraw.Draw(label)
    for i, line in enumerate(lines):
        text, size = fit_line(line, rgb.shape[1] - 8)
        draw.text((4, 9 + 16 * i), text, fill="black", font=_font(size), anchor="lm")
    return np.concatenate([rgb, np.asarray(label)])


def fit_line(line: str, width: int) -> tuple[str, int]:
    """The line and the size at which it is that wide at most: smaller, then without its middle."""
    for size in range(LARGEST_PX, SMALLEST_PX - 1, -1):
        if _font(size).getlength(line) <= width:
            return line, size
    for kept in range(len(line) - 1, 1, -1):
        head = (kept + 1) // 2
        shorter = f"{line[:head]}...{line[len(line) - kept + head :]}"
        if _font(SMALLEST_PX).getlength(shorter) <= width:
            return shorter, SMALLEST_PX
    return "", SMALLEST_PX


@cache
def _font(size: int) -> "FreeTypeFont":
    """Pillow's own font."""
    from PIL import ImageFont

    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont), "Pillow has FreeType"
    return font


def write_picture(path: Path, rgb: Rgb) -> None:
    """Raises: BadOutput."""
    from PIL import Image

    with writing(path, "write_picture", "choose another folder"):
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rgb).save(path)
