"""Pictures of photos with boxes and text, and contact sheets of them."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from vap_core.base.errors import BadOutput
from vap_core.base.types import Rgb

LABEL_PX, COLUMNS = 34, 4
TRUTH, RIGHT, WRONG, SILENT = (255, 255, 255), (60, 200, 90), (235, 60, 50), (160, 160, 160)
DOUBTFUL = (250, 180, 40)
FONT = cv2.FONT_HERSHEY_SIMPLEX


def join_tiles(tiles: Sequence[Rgb], columns: int = COLUMNS) -> Rgb:
    """Tiles of one size in rows."""
    height, width = tiles[0].shape[:2]
    rows = -(-len(tiles) // columns)
    out = np.full((rows * height, min(columns, len(tiles)) * width, 3), 255, np.uint8)
    for i, tile in enumerate(tiles):
        y, x = i // columns * height, i % columns * width
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
    """The picture with two lines of text below."""
    out = np.full((rgb.shape[0] + LABEL_PX, rgb.shape[1], 3), 255, np.uint8)
    out[: rgb.shape[0]] = rgb
    for i, line in enumerate(lines):
        at = (4, rgb.shape[0] + 13 + 15 * i)
        cv2.putText(out, line[:52], at, FONT, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return out


def write_picture(path: Path, rgb: Rgb) -> None:
    """Raises: BadOutput."""
    from PIL import Image

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rgb).save(path)
    except OSError as error:
        raise BadOutput(
            f"write_picture: {path} cannot be written ({error.strerror}); choose another folder."
        ) from error
