"""Following what was segmented at t = 0 through a video, every proposal under its own identity (P 3.3).

The embedded tracker is label propagation: each cell of a stride-8 grid of frozen features takes the identity of the most similar
cells in the first frame and in the last few. Of each identity's cells only the component nearest to where it was survives, identities
compete for pixels, and the segmenter draws the mask from that coarse guess. An identity that vanishes is searched for in the
whole view, and taken back only if it looks like itself, and more so than like any other.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch.nn import functional as F  # noqa: N812

from vap_core.embed import Encoder, crop
from vap_core.embed import load as load_encoder
from vap_core.features import CHANNELS, features, fit
from vap_core.segment import LiteSegmenter, bounds
from vap_core.segment import load as load_segmenter
from vap_core.values import Mask, Rgb, Track, value

TAP, STRIDE, SIDE = "b4", 8, 224
RECENT = 4
"""Frames remembered besides the first."""
TOP, TEMPERATURE = 5, 0.07
ANCHOR = 0.4
"""Weight of the first frame against the recent ones."""
RADIUS = 5
"""Cells that an object may move between two remembered frames."""
LEAST_AREA = 0.12
"""A mask below this share of the identity's recent largest area is not visible."""
GROWTH = 2.0
"""A mask that many times larger than the identity's recent largest is something else; twice that much when it was lost."""
TONE = 0.75
"""Colour agreement (Bhattacharyya) with the first or the running histogram below which a mask is something else, such as the arm in front."""
SEED = 0.3
"""Share of a cell that must be an identity's for a search to start there."""
SAME = 0.62
"""Cosine at which a re-found object counts as itself."""
BINS = (6, 12, 12)
"""Colour histogram over lightness, green-red and blue-yellow."""
Labels = Float32[np.ndarray, "i p"]
"""Per grid cell, how much of it belongs to the background (row 0) and to each identity."""


@runtime_checkable
class Tracker(Protocol):
    """Follows every identity of each view; state is argument and result, and may be consumed."""

    def start(self, images: Sequence[Rgb], masks: Sequence[Bool[np.ndarray, "_n _h _w"]]) -> list[Any]:
        """One state per view (t = 0); row i of a view's masks is identity i."""
        ...

    def step(self, states: Sequence[Any], images: Sequence[Rgb]) -> tuple[list[Any], list[tuple[Track, ...]]]:
        """The next frame of every view: one Track per identity, in order; its mask is None while it is not visible."""
        ...


@value
class Memory:
    """One remembered frame: unit-length features and labels of each cell."""

    keys: Float32[np.ndarray, "p c"]
    labels: Labels


@value
class TrackState:
    """Everything known about one view: each identity's `last` box (pixels), recent largest `area` (pixels), frames `lost` since."""

    hw: tuple[int, int]
    first: Memory
    recent: tuple[Memory, ...]
    sights: tuple[Memory, ...]
    """Per identity, the frame in which it was seen last."""
    last: Float32[np.ndarray, "n 4"]
    area: Float32[np.ndarray, " n"]
    lost: Int64[np.ndarray, " n"]
    tones: Float32[np.ndarray, "2 n b"]
    """Colour histograms: of t = 0, and running."""
    crops: tuple[Rgb, ...]
    looks: Float32[np.ndarray, "n d"] | None
    """Embeddings of `crops`, computed when an identity is lost for the first time."""


class LiteTracker:
    """The embedded tracker. Views are independent; the same frames give the same bits."""

    def __init__(self, segmenter: LiteSegmenter, encoder: Encoder) -> None:
        self.segmenter = segmenter
        self.encoder = encoder

    def start(self, images: Sequence[Rgb], masks: Sequence[Bool[np.ndarray, "_n _h _w"]]) -> list[TrackState]:
        return [self._start(image, of_view) for image, of_view in zip(images, masks, strict=True)]

    def step(self, states: Sequence[TrackState], images: Sequence[Rgb]) -> tuple[list[TrackState], list[tuple[Track, ...]]]:
        done = [self._step(state, image) for state, image in zip(states, images, strict=True)]
        return [state for state, _ in done], [tracks for _, tracks in done]

    def _start(self, image: Rgb, masks: Bool[np.ndarray, "n h w"]) -> TrackState:
        hw = image.shape[:2]
        if masks.shape[1:] != hw:
            raise ValueError(f"LiteTracker.start: masks of {masks.shape[1:]} pixels for an image of {hw}; they must agree")
        keys, grid = embed_cells(image)
        last = np.array([(0, 0, 1, 1) if (box := bounds(mask)) is None else box for mask in masks], np.float32).reshape(-1, 4)
        area = masks.sum(axis=(1, 2)).astype(np.float32)
        crops = tuple(crop(image, box) for box in last)
        lost = np.where(area > 0, 0, 1).astype(np.int64)
        tone = np.stack([tone_of(image, mask) for mask in masks]) if len(masks) else np.zeros((0, int(np.prod(BINS))), np.float32)
        first = Memory(keys, to_cells(masks, grid))
        return TrackState(hw, first, (), (first,) * len(masks), last, area, lost, np.stack([tone, tone]), crops, None)

    def _step(self, state: TrackState, image: Rgb) -> tuple[TrackState, tuple[Track, ...]]:
        n = len(state.area)
        if n == 0:
            return state, ()
        keys, grid = embed_cells(image)
        labels = propagate(keys, [state.first], grid, local=False)
        if state.recent:
            labels = ANCHOR * labels + (1 - ANCHOR) * propagate(keys, state.recent, grid, local=True)
        guesses: list[Mask | None] = [None] * n
        soft = to_pixels(labels, grid, state.hw)
        owner = strongest(soft)
        for i in np.flatnonzero(state.lost == 0):
            guesses[i] = nearest(owner == i + 1, soft[i + 1], state.last[i])
        chance = np.zeros((n, *state.hw), np.float32)
        self._draw(image, soft, guesses, chance)
        if (state.lost > 0).any():
            state = self._search(state, image, keys, grid, chance)
        masks = (chance > 0.5) & (strongest(chance) == np.arange(n)[:, None, None])
        return self._conclude(state, image, keys, grid, masks, chance)

    def _draw(self, image: Rgb, soft: Float32[np.ndarray, "i h w"], guesses: Sequence[Mask | None], chance: Float32[np.ndarray, "n h w"]) -> None:
        """Sharpen every guess with the segmenter, into `chance`."""
        for i, guess in enumerate(guesses):
            box = None if guess is None else bounds(guess)
            if box is not None:
                hint = np.where(cv2.dilate(guess.astype(np.uint8), np.ones((9, 9))) > 0, soft[i + 1], 0)  # type: ignore[union-attr]
                chance[i] = self.segmenter.chance(image, box[None], hint[None].astype(np.float32))[0]

    def _search(self, state: TrackState, image: Rgb, keys: np.ndarray, grid: tuple[int, int], chance: Float32[np.ndarray, "n h w"]) -> TrackState:
        """Look for lost identities in the whole view, guided by the first frame and the one that showed it last (P tab:occlusion_sweep)."""
        looks = self.encoder(state.crops) if state.looks is None else state.looks
        for i in np.flatnonzero(state.lost > 0):
            soft = to_pixels(propagate(keys, [state.first, state.sights[i]], grid, local=False), grid, state.hw)
            mine = strongest(soft) == i + 1
            taken = (chance > 0.5).any(axis=0) & ~mine  # another may have swallowed this one while it was hidden
            guess = largest((soft[i + 1] > SEED) & ~taken, soft[i + 1])
            found = None if guess is None else bounds(guess)
            for _ in range(2):  # the first mask shows how far the object reaches, the second is drawn from its whole box
                if found is not None:
                    here = self.segmenter.chance(image, found[None], np.where(taken, 0, soft[i + 1])[None].astype(np.float32))[0]
                    found = bounds((here > 0.5) & ~taken)
            if found is None or float((state.tones[:, i] @ tone_of(image, (here > 0.5) & ~taken)).max()) < TONE:
                continue
            cosine = looks @ self.encoder([crop(image, found)])[0]
            if cosine[i] >= SAME and cosine[i] >= cosine.max():
                chance[:, mine & (here > 0.5)] = 0
                chance[i] = np.where(taken, 0, here)
        return replace(state, looks=looks)

    def _conclude(
        self,
        state: TrackState,
        image: Rgb,
        keys: np.ndarray,
        grid: tuple[int, int],
        masks: Bool[np.ndarray, "n h w"],
        chance: Float32[np.ndarray, "n h w"],
    ) -> tuple[TrackState, tuple[Track, ...]]:
        """Decide who is visible, remember this frame, and report."""
        last, area, lost, tones = state.last.copy(), state.area.copy(), state.lost.copy(), state.tones.copy()
        tracks: list[Track] = []
        for i, mask in enumerate(masks):
            pixels = int(mask.sum())
            box = bounds(mask)
            tone = tone_of(image, mask)
            agreement = float((tones[:, i] @ tone).max())
            if box is None or agreement < TONE or not max(8.0, LEAST_AREA * area[i]) <= pixels <= GROWTH * (1 + bool(lost[i])) * area[i]:
                masks[i] = False
                lost[i] += 1
                tracks.append(Track(None, 0.0))
                continue
            lost[i], last[i] = 0, box
            area[i] = max(float(pixels), 0.95 * area[i])
            mixed = 0.9 * tones[1, i] + 0.1 * tone
            tones[1, i] = mixed / np.linalg.norm(mixed)
            tracks.append(Track(mask.copy(), float(chance[i][mask].mean()) * min(1.0, agreement)))
        now = Memory(keys, to_cells(masks, grid))
        sights = tuple(old if gone else now for old, gone in zip(state.sights, lost, strict=True))
        return replace(state, recent=(*state.recent, now)[-RECENT:], sights=sights, last=last, area=area, lost=lost, tones=tones), tuple(tracks)


def embed_cells(image: Rgb) -> tuple[Float32[np.ndarray, "p c"], tuple[int, int]]:
    """Unit-length features of every grid cell, row by row, and the grid's (rows, columns)."""
    maps = features([fit(image, SIDE)[0]], [TAP])[TAP][0]
    rows, cols = maps.shape[1:]
    return F.normalize(maps.reshape(CHANNELS[TAP], -1).T, dim=1).contiguous().numpy(), (rows, cols)


def propagate(keys: Float32[np.ndarray, "p c"], memory: Sequence[Memory], grid: tuple[int, int], local: bool) -> Labels:
    """Each cell's labels: the mean over its `TOP` most similar remembered cells (near it, if `local`), weighted by exp(cosine / temperature)."""
    query = torch.from_numpy(keys)
    cosine = torch.cat([query @ torch.from_numpy(m.keys).T + (_near(grid) if local else 0.0) for m in memory], dim=1)
    best, at = cosine.topk(TOP, dim=1)
    weight = torch.softmax(best / TEMPERATURE, dim=1)
    labels = torch.from_numpy(np.concatenate([m.labels for m in memory], axis=1))
    return (labels[:, at] * weight).sum(-1).numpy()


@cache
def _near(grid: tuple[int, int]) -> torch.Tensor:
    """0 between cells at most `RADIUS` apart, -10 between others."""
    rows, cols = (x.ravel() for x in np.mgrid[0 : grid[0], 0 : grid[1]])
    far = np.maximum(abs(rows[:, None] - rows), abs(cols[:, None] - cols)) > RADIUS
    return torch.from_numpy(np.where(far, np.float32(-10), np.float32(0)))


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


def tone_of(image: Rgb, mask: Mask) -> Float32[np.ndarray, " b"]:
    """Square-rooted, unit-length Lab histogram of the masked pixels; zeros for an empty mask."""
    box = bounds(mask)
    if box is None:
        return np.zeros(int(np.prod(BINS)), np.float32)
    x0, y0, x1, y1 = box.astype(int)
    lab = cv2.cvtColor(image[y0:y1, x0:x1], cv2.COLOR_RGB2LAB)
    count = cv2.calcHist([lab], [0, 1, 2], mask[y0:y1, x0:x1].astype(np.uint8), BINS, [0, 256, 64, 192, 64, 192])
    root = np.sqrt(count.ravel())
    return (root / max(float(np.linalg.norm(root)), 1e-9)).astype(np.float32)


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


@cache
def load() -> LiteTracker:
    """The shipped tracker, with the shipped segmenter and encoder."""
    return LiteTracker(load_segmenter(), load_encoder())
