"""What the method makes of an object in the opening views of episodes: proposed, elected, masked.

The object is registered from five rendered reference photos, as in every run. A row per view.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vap_core.attend import Attender
from vap_core.base.types import Grounding, Rgb
from vap_core.evaluation.perception.first_frames import (
    SAME_BOX,
    USUAL_K,
    View,
    find_candidates,
    object_under_box,
    opening_views,
    registered_object,
)
from vap_core.evaluation.photos.pictures import RIGHT, SILENT, TRUTH, WRONG, draw_box, fit, labelled
from vap_core.perception.boxes import box_iou, mask_iou
from vap_core.perception.candidates import Proposals, segment
from vap_core.perception.protocols import Stack
from vap_core.simulation.types import EpisodeRow
from vap_core.vote import nominate

Row = dict[str, Any]
TILE_PX = 224


def measure_openings(rows: Sequence[EpisodeRow], stack: Stack) -> tuple[list[Row], Rgb]:
    """A row for every camera of every episode, and a picture: a reference, and the first episode's
    views with the true box (white) and the elected one.

    Raises: UnknownName, BadObject, as `registered_object`; BadEncoder, as `Attender.ground`.
    """
    personal, _ = registered_object(stack, rows[0].target, USUAL_K)
    attender = Attender(stack, {personal.name: personal})
    table = []
    tiles = [_square(personal.crops[0])]
    for episode in opening_views(rows):
        for view, offered in zip(episode, find_candidates(episode, stack), strict=True):
            few = nominate(view.rgb, personal, offered, stack)
            candidates = segment(view.rgb, few, stack)
            grounding = attender.reject(attender.ground(view.camera, personal, candidates))
            row = _view_row(view, offered, grounding)
            table.append(row)
            if view.row == rows[0]:
                tiles.append(_tile(view, grounding, row))
    first = table[0]
    title = f"{personal.name} ({first['suite']}/{first['task']})"
    return table, labelled(np.concatenate(tiles, axis=1), [title])


def _view_row(view: View, offered: Proposals, grounding: Grounding) -> Row:
    """`proposed` and `right` are None in a view that shows less of the target than counts."""
    row: Row = {
        **view.key,
        "counts": view.row.target in view.visible(),
        "familiar": offered.boxes.familiar,
        "proposed": None,
        "right": None,
        "tinted": grounding.winner is not None,
        "elected": _elected(view, grounding),
        "likeness": None,
        "mask_iou": None,
    }
    chosen = grounding.chosen
    if chosen is not None:
        row["likeness"] = float(grounding.likeness[chosen])
    if not row["counts"]:
        return row
    target = view.row.target
    overlap = box_iou(offered.boxes.xyxy, view.boxes()[target][None])
    row["proposed"] = bool(overlap.max(initial=0.0) >= SAME_BOX)
    row["right"] = row["elected"] == target
    if row["right"] and chosen is not None:
        row["mask_iou"] = mask_iou(grounding.masks[chosen], view.masks[target])
    return row


def _elected(view: View, grounding: Grounding) -> str:
    """The object under the elected box; "" where there is none."""
    if grounding.chosen is None:
        return ""
    return object_under_box(view, grounding.candidates.xyxy[grounding.chosen])


def _tile(view: View, grounding: Grounding, row: Row) -> Rgb:
    tile = view.rgb.copy()
    box = view.boxes().get(view.row.target)
    if box is not None:
        draw_box(tile, box.tolist(), TRUTH, 1)
    if grounding.chosen is not None:
        colour = RIGHT if row["elected"] == view.row.target else WRONG
        if not row["tinted"]:
            colour = SILENT
        draw_box(tile, grounding.candidates.xyxy[grounding.chosen].tolist(), colour, 1)
    return _square(tile)


def _square(rgb: Rgb) -> Rgb:
    tile, _ = fit(rgb, TILE_PX, TILE_PX)
    return tile
