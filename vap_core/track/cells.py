"""Label propagation: every cell of a grid of frozen features takes the labels of the cells most like it in remembered frames."""

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch.nn import functional as F  # noqa: N812

from vap_core.features import CHANNELS, features, fit
from vap_core.values import Mask, Rgb, value

TAP, STRIDE, SIDE = "b4", 8, 224
TOP, TEMPERATURE = 5, 0.07
RADIUS = 5
"""Cells that an object may move between two remembered frames."""
Labels = Float32[np.ndarray, "i p"]
"""Per grid cell, how much of it belongs to the background (row 0) and to each identity."""


@value
class Memory:
    """One remembered frame: unit-length features and labels of each cell."""

    keys: Float32[np.ndarray, "p c"]
    labels: Labels


def embed_cells(image: Rgb) -> tuple[Float32[np.ndarray, "p c"], tuple[int, int]]:
    """Unit-length features of every grid cell, row by row, and the grid's (rows, columns)."""
    maps = features([fit(image, SIDE)[0]], [TAP])[TAP][0]
    rows, cols = maps.shape[1:]
    return F.normalize(maps.reshape(CHANNELS[TAP], -1).T, dim=1).contiguous().numpy(), (rows, cols)


def propagate(
    keys: Float32[np.ndarray, "p c"], memory: Sequence[Memory], grid: tuple[int, int], local: bool, rows: Bool[np.ndarray, " p"] | None = None
) -> Labels:
    """Each cell's labels: the mean over its `TOP` most similar remembered cells (near it, if `local`), weighted by exp(cosine / temperature).

    Only the cells in `rows` are asked, when given; the others are background.
    """
    asked = np.arange(len(keys)) if rows is None else np.flatnonzero(rows)
    query = torch.from_numpy(keys[asked])
    bias = _near(grid)[asked] if local else 0.0
    cosine = torch.cat([query @ torch.from_numpy(m.keys).T + bias for m in memory], dim=1)
    best, at = cosine.topk(TOP, dim=1)
    weight = torch.softmax(best / TEMPERATURE, dim=1)
    known = torch.from_numpy(np.concatenate([m.labels for m in memory], axis=1))
    labels = np.zeros((len(known), len(keys)), np.float32)
    labels[0] = 1
    labels[:, asked] = (known[:, at] * weight).sum(-1).numpy()
    return labels


@cache
def _near(grid: tuple[int, int]) -> torch.Tensor:
    """0 between cells at most `RADIUS` apart, -10 between others."""
    rows, cols = (x.ravel() for x in np.mgrid[0 : grid[0], 0 : grid[1]])
    far = np.maximum(abs(rows[:, None] - rows), abs(cols[:, None] - cols)) > RADIUS
    return torch.from_numpy(np.where(far, np.float32(-10), np.float32(0)))


def around(memory: Sequence[Memory], grid: tuple[int, int], identities: Int64[np.ndarray, " k"]) -> Bool[np.ndarray, " p"]:
    """The cells within `RADIUS` of wherever one of the identities was in the remembered frames."""
    was = np.zeros(grid, np.uint8)
    for m in memory:
        was |= (m.labels[1 + identities] > 0).any(axis=0).reshape(grid).astype(np.uint8)
    return cv2.dilate(was, np.ones((2 * RADIUS + 1, 2 * RADIUS + 1))).ravel() > 0


def to_cells(masks: Bool[np.ndarray, "n h w"], grid: tuple[int, int]) -> Labels:
    """Masks averaged over grid cells, background first."""
    h, w = masks.shape[1:]
    scale = SIDE / max(h, w)
    small = (max(1, round(w * scale)), max(1, round(h * scale)))
    labels = np.zeros((len(masks) + 1, grid[0] * STRIDE, grid[1] * STRIDE), np.float32)
    for i, mask in enumerate(masks):
        labels[i + 1, : small[1], : small[0]] = cv2.resize(mask.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    cells = labels.reshape(len(labels), grid[0], STRIDE, grid[1], STRIDE).mean(axis=(2, 4)).reshape(len(labels), -1)
    cells[0] = np.clip(1 - cells[1:].sum(axis=0), 0, 1)
    return cells


def to_pixels(labels: Labels, grid: tuple[int, int], hw: tuple[int, int]) -> Float32[np.ndarray, "i h w"]:
    """Cell labels interpolated to the image's pixels."""
    scale = max(hw) / SIDE
    whole = (round(grid[1] * STRIDE * scale), round(grid[0] * STRIDE * scale))
    return np.stack([cv2.resize(row.reshape(grid), whole, interpolation=cv2.INTER_LINEAR)[: hw[0], : hw[1]] for row in labels])


def strongest(planes: Float32[np.ndarray, "i h w"]) -> Int64[np.ndarray, "h w"]:
    """`planes.argmax(axis=0)`, which NumPy computes ten times slower."""
    best, at = planes[0].copy(), np.zeros(planes.shape[1:], np.int64)
    for i, plane in enumerate(planes[1:], start=1):
        better = plane > best
        at[better] = i
        np.copyto(best, plane, where=better)
    return at


def nearest(mine: Mask, soft: Float32[np.ndarray, "h w"], box: Float32[np.ndarray, "4"]) -> Mask | None:
    """The component that best joins mass and nearness to where the identity was; None when there is none."""
    count, parts, _, centres = cv2.connectedComponentsWithStats(mine.astype(np.uint8))
    if count < 2:
        return None
    was, reach = (box[:2] + box[2:]) / 2, max(float((box[2:] - box[:2]).max()), 0.05 * max(mine.shape))
    mass = np.bincount(parts.ravel(), soft.ravel(), minlength=count)[1:]
    away = np.linalg.norm(centres[1:] - was, axis=1) / reach
    return parts == 1 + int((mass * np.exp(-(away**2))).argmax())


def largest(mine: Mask, soft: Float32[np.ndarray, "h w"]) -> Mask | None:
    """The component of greatest mass; None when there is none."""
    count, parts = cv2.connectedComponents(mine.astype(np.uint8))
    if count < 2:
        return None
    return parts == 1 + int(np.bincount(parts.ravel(), soft.ravel(), minlength=count)[1:].argmax())


def lead(keys: Float32[np.ndarray, "p c"], share: Float32[np.ndarray, " p"], memory: Sequence[Memory], identity: int) -> float:
    """How much more the cells of `share` look like the identity's remembered ones than like anything else: a mean difference of cosines."""
    inside = share >= min(0.5, float(share.max()))
    known, held = np.concatenate([m.keys for m in memory]), np.concatenate([m.labels[1 + identity] for m in memory])
    mine, other = held >= min(0.4, float(held.max())), held < 0.1
    if not held.any() or not other.any():
        return 0.0
    cosine = keys[inside] @ known.T
    return float((cosine[:, mine].max(axis=1) - cosine[:, other].max(axis=1)).mean())
