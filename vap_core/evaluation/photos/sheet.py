"""Contact sheets of a photo set: every scene with its true boxes and what was elected."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vap_core.base.photos import load_photo
from vap_core.base.types import Rgb
from vap_core.evaluation.photos.folder import PhotoSet, Scene
from vap_core.evaluation.photos.pictures import (
    GAP_PX,
    RIGHT,
    SILENT,
    TRUTH,
    WRONG,
    draw_box,
    fit,
    join_tiles,
    labelled,
    write_picture,
)
from vap_core.evaluation.photos.report import RIGHT_IOU

if TYPE_CHECKING:
    import pandas as pd

WIDTH_PX, HEIGHT_PX, TILES = 360, 270, 24


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
        write_picture(path, join_tiles(tiles[first : first + TILES], gap_px=GAP_PX))
        paths.append(path)
    return paths


def _tile(rgb: Rgb, scene: Scene, row: Mapping[str, object]) -> Rgb:
    tile, scale = fit(rgb, WIDTH_PX, HEIGHT_PX)
    name = str(row["object"])
    for box in scene.boxes[name]:
        draw_box(tile, (scale * box).tolist(), TRUTH, 2)
    verdict = "nothing proposed"
    if row["x0"] == row["x0"] and row["x0"] is not None:
        colour, verdict = _verdict(row)
        elected = np.array([row["x0"], row["y0"], row["x1"], row["y1"]], np.float64)
        draw_box(tile, (scale * elected).tolist(), colour, 2)
    presence = "in view" if row["present"] else "absent"
    return labelled(tile, [f"{name} ({presence}) in {scene.name}", f"{verdict}{evidence(row)}"])


def evidence(row: Mapping[str, object]) -> str:
    """What a label says of the elected box, tinted or not; "" where none is elected.

    Its overlap with the object, where that is in view, and the likeness that the threshold of "not
    in view" reads.
    """
    if row["likeness"] is None or row["likeness"] != row["likeness"]:
        return ""
    overlap = f", IoU {row['chosen_iou']:.2f}" if row["present"] else ""
    return f"{overlap}, likeness {row['likeness']:.2f}"


def _verdict(row: Mapping[str, object]) -> tuple[tuple[int, int, int], str]:
    if not row["tinted"]:
        return SILENT, "not tinted"
    iou = row["iou"]
    assert isinstance(iou, float)
    if iou >= RIGHT_IOU:
        return RIGHT, "right"
    return WRONG, "wrong"
