"""The embedded tracker: label propagation proposes, the segmenter draws, and an identity that vanishes is searched for.

Each cell of a grid of frozen features takes the identity of the most similar cells in the first frame and in the last few; of each
identity's cells the component nearest to where it was survives, and the segmenter draws the mask from that coarse guess. Identities compete
for pixels. One whose surroundings have not changed since its mask was drawn keeps it and costs nothing. A mask that shrinks or jumps is
believed only on the evidence of its colours and features; an identity without a mask is looked for in the whole view, and taken back only
if it looks like itself, and more so than like any other.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64

from vap_core.embed import Encoder, crop
from vap_core.segment import LiteSegmenter, bounds, box_plane, iou
from vap_core.track.cells import Labels, Memory, around, embed_cells, largest, lead, nearest, propagate, strongest, to_cells, to_pixels
from vap_core.track.looks import familiar, remember, spread, tone_of
from vap_core.track.state import RECENT, TrackState, begin, stirred, thumb
from vap_core.values import Mask, Rgb, Track, value

ANCHOR = 0.4
"""Weight of the first frame against the recent ones."""
FAINT = 0.2
"""Share of a cell with which an identity that wins no cell keeps its place."""
REACH = 0.12
"""A mask that goes beyond its guess by this share of its size is drawn again, from its own box."""
LEAST_PX = 24
"""A mask of fewer pixels is not visible."""
GROWTH = 2.5
"""A mask that many times larger than the identity's recent largest is something else; twice that when it was lost."""
STEADY = 0.5
"""A mask that overlaps the one before by less IoU, or is that much smaller than the identity's largest, has changed suddenly."""
LEAD = 3.0
"""What a cosine of lead counts beside a share of familiar colours."""
TRUST, FOUND, DOUBT = 0.4, 0.6, 1.0
"""Evidence that a mask needs: one that goes on, one that was lost, one that changed suddenly."""
SEED = 0.3
"""Share of a cell that must be an identity's for a search to start there."""
AROUND, SWELL = 17, 1.6
"""Pixels, an odd number, of the square by which such a start is widened; and how much larger than it was last, each way, an object is looked for."""
EAGER = 4
"""Frames for which a lost identity is searched for in each; then in every other one."""


@value
class Look:
    """One frame under way: picture and thumbnail, features of its cells, and how strongly each identity claims each pixel."""

    image: Rgb
    small: Float32[np.ndarray, "a b 3"]
    keys: Float32[np.ndarray, "p c"]
    grid: tuple[int, int]
    chance: Float32[np.ndarray, "n h w"]


class LiteTracker:
    """The embedded tracker. Views are independent; the same frames give the same bits."""

    def __init__(self, segmenter: LiteSegmenter, encoder: Encoder) -> None:
        self.segmenter = segmenter
        self.encoder = encoder

    def start(self, images: Sequence[Rgb], masks: Sequence[Bool[np.ndarray, "_n _h _w"]]) -> list[TrackState]:
        for image, of_view in zip(images, masks, strict=True):
            if of_view.shape[1:] != image.shape[:2]:
                raise ValueError(f"LiteTracker.start: masks of {of_view.shape[1:]} pixels for an image of {image.shape[:2]}; they must agree")
        return [begin(image, of_view) for image, of_view in zip(images, masks, strict=True)]

    def step(self, states: Sequence[TrackState], images: Sequence[Rgb]) -> tuple[list[TrackState], list[tuple[Track, ...]]]:
        done = [self._step(state, image) for state, image in zip(states, images, strict=True)]
        return [state for state, _ in done], [tracks for _, tracks in done]

    def _step(self, state: TrackState, image: Rgb) -> tuple[TrackState, tuple[Track, ...]]:
        small = thumb(image)
        moving, lost = np.flatnonzero((state.lost == 0) & stirred(state, small)), np.flatnonzero(state.lost > 0)
        if not len(moving) and not len(lost):
            return state, _tracks(state)
        keys, grid = embed_cells(image)
        chance = np.where(state.masks, state.scores[:, None, None], np.float32(0))
        if len(moving):
            soft = to_pixels(_labels(state, keys, grid, moving), grid, state.hw)
            owner = strongest(soft)
            for i in moving:
                guess = nearest(owner == i + 1, soft[i + 1], state.last[i])
                guess = nearest(soft[i + 1] > FAINT, soft[i + 1], state.last[i]) if guess is None else guess
                chance[i] = 0 if guess is None else self._draw(image, soft[i + 1], guess)
        look, unsure = Look(image, small, keys, grid, chance), state.scores.copy()
        for i in lost:
            if state.lost[i] <= EAGER or state.lost[i] % 2:
                state, unsure[i] = self._search(state, look, int(i))
        return _conclude(state, look, np.union1d(moving, lost), unsure)

    def _draw(self, image: Rgb, soft: Float32[np.ndarray, "h w"], guess: Mask) -> Float32[np.ndarray, "h w"]:
        """The segmenter's mask of what the guess means."""
        hint = np.where(cv2.dilate(guess.astype(np.uint8), np.ones((9, 9))) > 0, soft, 0).astype(np.float32)
        box = bounds(guess)
        assert box is not None
        chance = self.segmenter.chance(image, box[None], hint[None])[0]
        wide = bounds(chance > 0.5)
        if wide is None or np.abs(wide - box).max() <= REACH * max(float((wide[2:] - wide[:2]).max()), 12.0):
            return chance
        return self.segmenter.chance(image, wide[None], hint[None])[0]

    def _search(self, state: TrackState, look: Look, i: int) -> tuple[TrackState, float]:
        """Look for a lost identity in the whole view, by the first frame and the one that showed it last (P tab:occlusion_sweep).

        What is found goes into `look.chance`. Returned besides the state: how sure it is that there is nothing to be found.
        """
        soft = to_pixels(propagate(look.keys, [state.first, state.sights[i]], look.grid, local=False), look.grid, state.hw)
        mine = strongest(soft) == i + 1
        taken = (look.chance > 0.5).any(axis=0) & ~mine  # another may have swallowed this one while it was hidden
        free = np.where(taken, 0, soft[i + 1]).astype(np.float32)
        nothing = 1 - float(np.clip(free.max(), 0, 1))
        guess = largest(free > SEED, soft[i + 1])
        found = None if guess is None else bounds(cv2.dilate(guess.astype(np.uint8), np.ones((AROUND, AROUND))) > 0)
        if found is None:
            return state, nothing
        found = _within(found, state.last[i])
        out = taken | (box_plane(found, state.hw) == 0)
        for _ in range(2):  # the first mask shows how far the object reaches, the second is drawn from its whole box
            here = np.where(out, 0, self.segmenter.chance(look.image, found[None], free[None])[0])
            found = bounds(here > 0.5)
            if found is None:
                return state, nothing
        if _evidence(state, look, i, here > 0.5) < FOUND:
            return state, nothing
        if state.looks is None:
            state = replace(state, looks=remember(self.encoder, state.early, state.ground))
        assert state.looks is not None
        row, late = self.encoder([crop(look.image, found), state.late[i]])
        if state.looks.accept(row, late, i):
            look.chance[:, mine & (here > 0.5)] = 0
            look.chance[i] = here
        return state, nothing


def _within(box: Float32[np.ndarray, "4"], last: Float32[np.ndarray, "4"]) -> Float32[np.ndarray, "4"]:
    """The box, cut about its middle where it is `SWELL` times as wide or high as the last one: what stands behind is not the object."""
    middle, half = (box[:2] + box[2:]) / 2, np.minimum((box[2:] - box[:2]) / 2, SWELL * (last[2:] - last[:2]) / 2)
    return np.concatenate([middle - half, middle + half]).astype(np.float32)


def _labels(state: TrackState, keys: Float32[np.ndarray, "p c"], grid: tuple[int, int], moving: Int64[np.ndarray, " k"]) -> Labels:
    """Who each cell belongs to, by the first frame and the recent ones; asked only where those that move may be."""
    recent = state.recent or (state.first,)
    rows = around(recent, grid, moving)
    return ANCHOR * propagate(keys, [state.first], grid, False, rows) + (1 - ANCHOR) * propagate(keys, recent, grid, True, rows)


def _evidence(state: TrackState, look: Look, i: int, mask: Mask) -> float:
    """That `mask` is identity i: its share of familiar colours, and the lead of its cells, about 0.2 when it is. About 1.5 is usual."""
    memory = [state.first, state.sights[i]] if state.lost[i] else [state.first, *state.recent]
    known = state.tones[:, i].max(axis=0)
    return familiar(tone_of(look.image, mask), known) + LEAD * lead(look.keys, to_cells(mask[None], look.grid)[1], memory, i)


def _conclude(
    state: TrackState, look: Look, judged: Int64[np.ndarray, " k"], unsure: Float32[np.ndarray, " n"]
) -> tuple[TrackState, tuple[Track, ...]]:
    """Decide who of those `judged` is visible, remember this frame, and report."""
    last, area, lost, tones, scores = (part.copy() for part in (state.last, state.area, state.lost, state.tones, state.scores))
    thumbs, late = list(state.thumbs), list(state.late)
    masks = (look.chance > 0.5) & (strongest(look.chance) == np.arange(len(area))[:, None, None])
    masks = np.where(np.isin(np.arange(len(area)), judged)[:, None, None], masks, state.masks)
    for i in judged:
        box, trust = bounds(masks[i]), 0.0
        pixels = int(masks[i].sum())
        if box is not None and LEAST_PX <= pixels <= GROWTH * (2 if lost[i] else 1) * area[i]:
            trust = _evidence(state, look, int(i), masks[i])
        sudden = pixels < STEADY * area[i] or iou(masks[i], state.masks[i]) < STEADY
        if box is None or trust < (FOUND if lost[i] else DOUBT if sudden else TRUST):
            masks[i] = False
            scores[i] = unsure[i] if lost[i] else 1 - float(np.clip(trust, 0, 1))
            lost[i] += 1
            continue
        scores[i] = float(look.chance[i][masks[i]].mean()) * min(1.0, trust)
        lost[i], last[i], thumbs[i], area[i] = 0, box, look.small, max(float(pixels), 0.95 * float(area[i]))
        if trust >= DOUBT and pixels > 0.7 * area[i]:
            tones[1, i] = 0.9 * tones[1, i] + 0.1 * spread(tone_of(look.image, masks[i]))
            late[i] = crop(look.image, box)
    now = Memory(look.keys, to_cells(masks, look.grid))
    sights = tuple(old if gone else now for old, gone in zip(state.sights, lost, strict=True))
    state = replace(
        state, recent=(*state.recent, now)[-RECENT:], sights=sights, masks=masks, scores=scores, thumbs=tuple(thumbs), last=last, area=area,
        lost=lost, tones=tones, late=tuple(late),
    )  # fmt: skip
    return state, _tracks(state)


def _tracks(state: TrackState) -> tuple[Track, ...]:
    """What is reported; without a mask, the score says how sure it is that the identity is not visible."""
    return tuple(
        Track(None if gone else mask.copy(), float(np.clip(score, 0, 1)))
        for mask, score, gone in zip(state.masks, state.scores, state.lost, strict=True)
    )
