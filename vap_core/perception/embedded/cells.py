"""Label propagation over a grid of frozen features, masks from planes of shares, and appearance.

Every cell takes the labels of the cells most like it in remembered frames.
"""

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64

from vap_core.base.types import Mask, Rgb, value
from vap_core.perception.boxes import crop, mask_box
from vap_core.perception.embedded.networks import STRIDE, Network, resize_and_pad
from vap_core.perception.protocols import Encoder

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


MIN_REACH = 0.05
"""The least distance over which nearness falls, as a share of the image's longer side."""


def argmax_planes(planes: Float32[np.ndarray, "i h w"]) -> Int64[np.ndarray, "h w"]:
    """`planes.argmax(axis=0)`, which NumPy computes ten times slower."""
    best = planes[0].copy()
    winner = np.zeros(planes.shape[1:], np.int64)
    for i, plane in enumerate(planes[1:], start=1):
        better = plane > best
        winner[better] = i
        np.copyto(best, plane, where=better)
    return winner


def nearest_component(
    mask: Mask, weight: Float32[np.ndarray, "h w"], last_box: Float32[np.ndarray, "4"]
) -> Mask | None:
    """The component of `mask` that best joins mass and nearness to a box; None when it is empty.

    `weight` is the mass of every pixel.
    """
    count, parts, _, centres = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if count < 2:
        return None
    centre = (last_box[:2] + last_box[2:]) / 2
    reach = max(float((last_box[2:] - last_box[:2]).max()), MIN_REACH * max(mask.shape))
    mass = np.bincount(parts.ravel(), weight.ravel(), minlength=count)[1:]
    distance = np.linalg.norm(centres[1:] - centre, axis=1) / reach
    return parts == 1 + int((mass * np.exp(-(distance**2))).argmax())


def largest_component(mask: Mask, weight: Float32[np.ndarray, "h w"]) -> Mask | None:
    """The component of greatest mass; None when there is none."""
    count, parts = cv2.connectedComponents(mask.astype(np.uint8))
    if count < 2:
        return None
    mass = np.bincount(parts.ravel(), weight.ravel(), minlength=count)[1:]
    return parts == 1 + int(mass.argmax())


BINS = (6, 12, 12)
"""Colour histogram over lightness, green-red and blue-yellow."""
N_BINS = int(np.prod(BINS))
RANGES = [0, 256, 64, 192, 64, 192]
"""8-bit Lab values that the histogram covers."""
MAX_EXCESS = 3.0
"""How much more frequent a colour may be in a part of an identity than in the whole."""
MIN_LIKENESS = 0.3
"""How far between the bare background's cosine (0) and its own (1) an accepted crop must lie. Nine
in ten views of held-out generic objects do, from any side; so do one in four views of other
objects, so a crop must also be more like the identity than like any other one."""
NO_OBJECT_PX = 32.0
"""Side of the background crop where nothing is followed."""
ColourShares = Float32[np.ndarray, " b"]
"""The share of an identity's pixels in each colour."""


@value
class Appearances:
    """Embeddings of every identity's first crop, and the least cosine of an accepted crop."""

    embeddings: Float32[np.ndarray, "n d"]
    min_cosine: Float32[np.ndarray, " n"]

    def accept(
        self, row: Float32[np.ndarray, " d"], last: Float32[np.ndarray, " d"], identity: int
    ) -> bool:
        """Whether the embedding `row` is like `identity`, and more so than like any other one.

        It may be like the identity's first crop, or like its last one, whose embedding is `last`.
        """
        cosine = self.embeddings @ row
        own = max(float(cosine[identity]), float(last @ row))
        best_other = float(np.delete(cosine, identity).max(initial=-1.0))
        return own >= float(self.min_cosine[identity]) and own >= best_other


def embed_appearances(encoder: Encoder, crops: tuple[Rgb, ...], background: Rgb) -> Appearances:
    """The appearances of all identities.

    The least cosine is relative to that of the bare background: what means nothing differs from one
    encoder to the next.
    """
    rows = encoder(crops)
    floor = rows @ encoder([background])[0]
    return Appearances(rows, floor + np.float32(MIN_LIKENESS) * (1 - floor))


def colour_shares(image: Rgb, mask: Mask) -> ColourShares:
    """Lab histogram of the masked pixels, as shares; zeros for an empty mask."""
    box = mask_box(mask)
    if box is None:
        return np.zeros(N_BINS, np.float32)
    x0, y0, x1, y1 = box.astype(int)
    lab = cv2.cvtColor(image[y0:y1, x0:x1], cv2.COLOR_RGB2LAB)
    inside = mask[y0:y1, x0:x1].astype(np.uint8)
    count = cv2.calcHist([lab], [0, 1, 2], inside, BINS, RANGES).ravel()
    return (count / max(float(count.sum()), 1.0)).astype(np.float32)


def blur_shares(shares: ColourShares) -> ColourShares:
    """Give each colour's neighbours half its share, unless they have more.

    A shade lighter or darker then counts as the same colour.
    """
    cube = shares.reshape(BINS)
    for axis, bins in enumerate(BINS):
        padding = np.zeros((3, 2), int)
        padding[axis] = 1
        padded = np.pad(cube, padding)
        below = np.take(padded, np.arange(bins), axis)
        above = np.take(padded, np.arange(bins) + 2, axis)
        cube = np.maximum(cube, 0.5 * np.maximum(below, above))
    return cube.ravel()


def familiar_share(shares: ColourShares, known: ColourShares) -> float:
    """The share of pixels in colours that the identity has shown.

    It is high for any larger part of the identity, low for a thing in front of it.
    """
    return float(np.minimum(shares, MAX_EXCESS * known).sum())


def background_crop(image: Rgb, boxes: Float32[np.ndarray, "n 4"]) -> Rgb:
    """A square about as large as the boxes, from where the image is farthest from all of them."""
    h, w = image.shape[:2]
    side = NO_OBJECT_PX
    if len(boxes):
        areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
        side = np.sqrt(areas.mean())
    half = 0.5 * float(np.clip(side, 16.0, min(h, w)))
    free = np.zeros((h + 2, w + 2), np.uint8)
    free[1:-1, 1:-1] = 1
    for x0, y0, x1, y1 in boxes.astype(int):
        free[y0 + 1 : y1 + 1, x0 + 1 : x1 + 1] = 0
    distance = cv2.distanceTransform(free, cv2.DIST_C, 3)[1:-1, 1:-1]
    y, x = np.unravel_index(int(distance.argmax()), (h, w))
    return crop(image, np.array([x - half, y - half, x + half, y + half], np.float32))
