"""Measures of one attention map: how much lies inside what, and where its peak is.

The simulator's masks say what every patch shows. The chance level of a share is the area: the share
that attention would have inside if it were the same everywhere.
"""

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Float, Float32

from vap_core.base.types import Mask
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.types import EpisodeRow, Truth

TARGET = "target"
LOOKALIKES = "lookalikes"
HAND = "hand"
GOAL = "goal"
BACKGROUND = "background"
REGIONS = (TARGET, LOOKALIKES, HAND, GOAL, BACKGROUND)
"""Background is all else: table, arm and other objects."""
Heat = Float32[np.ndarray, "rows columns"]
Areas = Mapping[str, Heat]
"""The share of every patch that a region covers; the regions of a patch sum to 1."""


def kind_of(name: str, row: EpisodeRow) -> str:
    """The region that an object belongs to. Raises: UnknownName, BadObject, as `get_object`."""
    if name == row.target:
        return TARGET
    if name == row.goal:
        return GOAL
    return LOOKALIKES if get_object(name).category == row.category else BACKGROUND


def patch_areas(row: EpisodeRow, truth: Truth, camera: str, side: int) -> Areas:
    """The share of every patch of a view that each region covers. Raises: as `kind_of`."""
    masks = truth.masks[camera]
    areas: dict[str, np.ndarray] = {}
    for region in REGIONS:
        areas[region] = np.zeros((side, side), np.float32)
    for name, mask in masks.items():
        areas[kind_of(name, row)] += _covered(mask, side)
    areas[HAND] = _covered(truth.hand[camera], side)
    known = sum(areas[region] for region in REGIONS[:-1])
    areas[BACKGROUND] = np.clip(1 - known, 0, 1).astype(np.float32)
    return areas


def measure(heat: Heat, areas: Areas) -> dict[str, float | int | str | bool]:
    """The measures of one map of one view.

    `side` is the number of patches along an edge, `mass` the attention to the whole view.
    `share_<region>` is the part of it inside a region, `chance_<region>` the region's area. `peak`
    is the attention of the most attended patch, of which `peak_region` is what covers most, things
    before background. `hit` says whether the patch shows any of the target (pointing game),
    `chance_hit` is the share of patches that do. `entropy` is 1 where all patches are attended to
    alike, and 0 where only one is.
    """
    mass = float(heat.sum())
    spread = heat / max(mass, 1e-12)
    row, column = np.unravel_index(int(heat.argmax()), heat.shape)
    measures: dict[str, float | int | str | bool] = {"side": len(heat), "mass": mass}
    for region in REGIONS:
        measures[f"share_{region}"] = float((spread * areas[region]).sum())
        measures[f"chance_{region}"] = float(areas[region].mean())
    measures["peak"] = float(heat[row, column])
    measures["peak_row"] = int(row)
    measures["peak_column"] = int(column)
    measures["peak_region"] = _region_at(areas, int(row), int(column))
    measures["hit"] = bool(areas[TARGET][row, column] > 0)
    measures["chance_hit"] = float((areas[TARGET] > 0).mean())
    measures["entropy"] = _entropy(spread)
    return measures


def inside(
    weights: Float32[np.ndarray, "layers heads rows columns"], areas: Areas
) -> Float[np.ndarray, "layers heads 3"]:
    """Attention to the whole view, to the target and to the look-alikes, of every head."""
    parts = [weights.sum((2, 3))]
    for region in (TARGET, LOOKALIKES):
        parts.append((weights * areas[region]).sum((2, 3)))
    return np.stack(parts, axis=-1)


def _covered(mask: Mask, side: int) -> Heat:
    return cv2.resize(mask.astype(np.float32), (side, side), interpolation=cv2.INTER_AREA)


def _region_at(areas: Areas, row: int, column: int) -> str:
    things = {region: float(areas[region][row, column]) for region in REGIONS[:-1]}
    largest = max(things, key=lambda region: things[region])
    return largest if things[largest] > 0 else BACKGROUND


def _entropy(spread: Heat) -> float:
    positive = spread[spread > 0].astype(np.float64)
    return float(-(positive * np.log(positive)).sum() / np.log(spread.size))
