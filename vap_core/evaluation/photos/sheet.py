"""Contact sheets of a photo set: every scene with its true boxes and what was elected."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vap_core.base.errors import BadOutput
from vap_core.base.photos import load_photo
from vap_core.base.types import Rgb
from vap_core.evaluation.photos.folder import PhotoSet, Scene
from vap_core.evaluation.photos.report import RIGHT_IOU

if TYPE_CHECKING:
    import pandas as pd

SIDE_PX, LABEL_PX, COLUMNS, TILES = 360, 34, 4, 24
TRUTH, RIGHT, WRONG, SILENT = (255, 255, 255), (60, 200, 90), (235, 60, 50), (160, 160, 160)
FONT = cv2.FONT_HERSHEY_SIMPLEX


def write_sheets(photo_set: PhotoSet, table: "pd.DataFrame", folder: Path) -> list[Path]:
    """Write sheet-01.png and so on, at most 24 questions each, in the order of the scenes.

    White: the true box. Green: tinted and right. Red: tinted and wrong. Grey: elected, not tinted.

    Raises: BadOutput.
    """
    scenes = {scene.name: scene for scene in photo_set.scenes}
    tiles = []
    for name, part in table.groupby("scene", sort=True):
        rgb = load_photo(scenes[str(name)].path, long_side=None)
        for row in part.to_dict("records"):
            tiles.append(_tile(rgb, scenes[str(name)], row))
    paths = []
    for first in range(0, len(tiles), TILES):
        path = folder / f"sheet-{1 + first // TILES:02}.png"
        write_picture(path, join_tiles(tiles[first : first + TILES]))
        paths.append(path)
    return paths


def join_tiles(tiles: Sequence[Rgb], columns: int = COLUMNS) -> Rgb:
    """Tiles of one size in rows."""
    height, width = tiles[0].shape[:2]
    rows = -(-len(tiles) // columns)
    out = np.full((rows * height, min(columns, len(tiles)) * width, 3), 255, np.uint8)
    for i, tile in enumerate(tiles):
        y, x = i // columns * height, i % columns * width
        out[y : y + height, x : x + width] = tile
    return out


def fit(rgb: Rgb, side: int) -> tuple[Rgb, float]:
    """The picture shrunk into a square of `side` pixels, and by how much."""
    scale = side / max(rgb.shape[:2])
    size = (max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale)))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    out = np.full((side, side, 3), 255, np.uint8)
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


def _tile(rgb: Rgb, scene: Scene, row: Mapping[str, object]) -> Rgb:
    tile, scale = fit(rgb, SIDE_PX)
    name = str(row["object"])
    for box in scene.boxes[name]:
        draw_box(tile, (scale * box).tolist(), TRUTH, 2)
    verdict = "nothing proposed"
    if row["x0"] == row["x0"] and row["x0"] is not None:
        colour, verdict = _verdict(row)
        elected = np.array([row["x0"], row["y0"], row["x1"], row["y1"]], np.float64)
        draw_box(tile, (scale * elected).tolist(), colour, 2)
        verdict += f", IoU {row['iou']:.2f}, cosine {row['cosine']:.2f}"
    presence = "in view" if row["present"] else "absent"
    return labelled(tile, [f"{name} ({presence}) in {scene.name}", verdict])


def _verdict(row: Mapping[str, object]) -> tuple[tuple[int, int, int], str]:
    if not row["tinted"]:
        return SILENT, "not tinted"
    iou = row["iou"]
    assert isinstance(iou, float)
    if iou >= RIGHT_IOU:
        return RIGHT, "right"
    return WRONG, "wrong"
