"""Label propagation over a grid of frozen features.

Every cell takes the labels of the cells most like it in remembered frames.
"""

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64

from vap_core.base.types import Rgb, value
from vap_core.perception.embedded.runtime import Network
from vap_core.perception.embedded.taps import STRIDE, resize_and_pad

GRAPH = "tracker.onnx"
TAP = "b4"
CELL_PX = STRIDE[TAP]
SIDE = 224
"""The longer side to which an image is resized, pixels; a cell is `CELL_PX` of them."""
NEIGHBOURS = 5
"""Remembered cells that decide over a cell."""
TEMPERATURE = 0.07
RADIUS = 5
"""Cells that an object may move between two remembered frames."""
TOO_FAR = -10.0
"""Added to the cosine of cells that are farther apart."""
Grid = tuple[int, int]
"""Rows and columns of cells."""
Labels = Float32[np.ndarray, "i p"]
"""Per grid cell, how much of it belongs to the background (row 0) and to each identity."""


@value
class FrameMemory:
    """One remembered frame: unit-length features and labels of each cell."""

    keys: Float32[np.ndarray, "p c"]
    labels: Labels


def embed_cells(image: Rgb, network: Network) -> tuple[Float32[np.ndarray, "p c"], Grid]:
    """Unit-length features of every cell, row by row, and the grid.

    `network` computes a `cell_network.CellNetwork`.
    """
    resized, _ = resize_and_pad(image, SIDE)
    (keys,) = network(resized[None])
    return keys, (resized.shape[0] // CELL_PX, resized.shape[1] // CELL_PX)


def propagate(
    keys: Float32[np.ndarray, "p c"],
    memory: Sequence[FrameMemory],
    grid: Grid,
    local: bool,
    selected: Bool[np.ndarray, " p"] | None = None,
) -> Labels:
    """Each cell's labels: a weighted mean over its `NEIGHBOURS` most similar remembered cells.

    Weights are exp(cosine / temperature); `local` compares only cells at most `RADIUS` apart. Where
    `selected` is given, cells outside it are background.
    """
    if selected is None:
        selected = np.ones(len(keys), bool)
    cells = np.flatnonzero(selected)
    bias = _distance_bias(grid)[cells] if local else np.float32(0)
    cosines = [keys[cells] @ frame.keys.T + bias for frame in memory]
    neighbours, best = largest(np.concatenate(cosines, axis=1), NEIGHBOURS)
    weight = np.exp((best - best[:, :1]) / np.float32(TEMPERATURE))
    weight /= weight.sum(axis=1, keepdims=True)
    known = np.concatenate([frame.labels for frame in memory], axis=1)
    labels = np.zeros((len(known), len(keys)), np.float32)
    labels[0] = 1
    labels[:, cells] = (known[:, neighbours] * weight).sum(axis=-1)
    return labels


def largest(
    rows: Float32[np.ndarray, "q p"], k: int
) -> tuple[Int64[np.ndarray, "q k"], Float32[np.ndarray, "q k"]]:
    """Columns and values of the k largest numbers of every row, in falling order; consumes `rows`.

    For a handful of numbers this takes a fifth of the time of a partition.
    """
    columns = np.zeros((len(rows), k), np.int64)
    values = np.zeros((len(rows), k), np.float32)
    row = np.arange(len(rows))
    for i in range(k):
        column = rows.argmax(axis=1)
        columns[:, i] = column
        values[:, i] = rows[row, column]
        rows[row, column] = -np.inf
    return columns, values


def cells_near(
    memory: Sequence[FrameMemory], grid: Grid, identities: Int64[np.ndarray, " k"]
) -> Bool[np.ndarray, " p"]:
    """The cells within `RADIUS` of the identities' cells in the remembered frames."""
    occupied = np.zeros(grid, np.uint8)
    for frame in memory:
        labelled = (frame.labels[1 + identities] > 0).any(axis=0)
        occupied |= labelled.reshape(grid).astype(np.uint8)
    return cv2.dilate(occupied, np.ones((2 * RADIUS + 1, 2 * RADIUS + 1))).ravel() > 0


def to_cells(masks: Bool[np.ndarray, "n h w"], grid: Grid) -> Labels:
    """Masks averaged over grid cells, background first."""
    rows, cols = grid
    n, h, w = masks.shape
    scale = SIDE / max(h, w)
    small_w = max(1, round(w * scale))
    small_h = max(1, round(h * scale))
    cells = np.zeros((n + 1, rows * cols), np.float32)
    plane = np.zeros((rows * CELL_PX, cols * CELL_PX), np.float32)
    blocks = plane.reshape(rows, CELL_PX, cols, CELL_PX)
    for i in np.flatnonzero(masks.any(axis=(1, 2))):  # most are not followed
        plane[:small_h, :small_w] = cv2.resize(
            masks[i].astype(np.float32), (small_w, small_h), interpolation=cv2.INTER_AREA
        )
        cells[i + 1] = blocks.mean(axis=(1, 3)).ravel()
    cells[0] = np.clip(1 - cells[1:].sum(axis=0), 0, 1)
    return cells


def to_pixels(labels: Labels, grid: Grid, hw: tuple[int, int]) -> Float32[np.ndarray, "i h w"]:
    """Cell labels interpolated to the image's pixels."""
    rows, cols = grid
    h, w = hw
    scale = max(hw) / SIDE
    # A side that is rounded down may fall a pixel or two short of the image.
    whole = (max(w, round(cols * CELL_PX * scale)), max(h, round(rows * CELL_PX * scale)))
    planes: list[np.ndarray] = []
    for row in labels:
        plane = cv2.resize(row.reshape(grid), whole, interpolation=cv2.INTER_LINEAR)
        planes.append(plane[:h, :w])
    return np.stack(planes)


def cosine_lead(
    keys: Float32[np.ndarray, "p c"],
    share: Float32[np.ndarray, " p"],
    memory: Sequence[FrameMemory],
    identity: int,
) -> float:
    """How much more like an identity's remembered cells some cells are than like anything else.

    `share` says how much of each cell belongs to them. The lead is a mean difference of cosines.
    """
    inside = share >= min(0.5, float(share.max()))
    known = np.concatenate([frame.keys for frame in memory])
    labels = np.concatenate([frame.labels[1 + identity] for frame in memory])
    own = labels >= min(0.4, float(labels.max()))
    other = labels < 0.1
    if not labels.any() or not other.any():
        return 0.0
    cosine = keys[inside] @ known.T
    return float((cosine[:, own].max(axis=1) - cosine[:, other].max(axis=1)).mean())


@cache
def _distance_bias(grid: Grid) -> Float32[np.ndarray, "p p"]:
    """0 between cells at most `RADIUS` apart, `TOO_FAR` between others."""
    rows, cols = np.mgrid[0 : grid[0], 0 : grid[1]].reshape(2, -1)
    distance = np.maximum(abs(rows[:, None] - rows), abs(cols[:, None] - cols))
    return np.where(distance > RADIUS, np.float32(TOO_FAR), np.float32(0))
