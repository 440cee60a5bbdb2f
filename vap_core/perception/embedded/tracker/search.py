"""Searching for an identity that was lost, in the whole view (P tab:occlusion_sweep)."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float32

from vap_core.base.types import Mask
from vap_core.perception.boxes import crop, mask_box
from vap_core.perception.embedded.segmenter import LiteSegmenter, box_plane
from vap_core.perception.embedded.tracker.appearance import embed_appearances
from vap_core.perception.embedded.tracker.cells import propagate, to_pixels
from vap_core.perception.embedded.tracker.components import argmax_planes, largest_component
from vap_core.perception.embedded.tracker.state import FrameFeatures, TrackState
from vap_core.perception.embedded.tracker.update import FOUND_EVIDENCE, evidence_for
from vap_core.perception.protocols import Encoder

MIN_SEED_SHARE = 0.3
"""Share of a cell that must be an identity's for a search to start there."""
SEED_GROWTH_PX = 17
"""Side, an odd number, of the square by which such a start is dilated."""
MAX_SWELL = 1.6
"""How many times wider or higher than it was last an object is searched for."""
EVERY_FRAME = 4
"""Frames for which a lost identity is searched for in each; then in every other one."""


def is_due(frames_lost: int) -> bool:
    """Whether an identity that has been lost for so many frames is searched for in this one."""
    return frames_lost <= EVERY_FRAME or frames_lost % 2 == 1


def search(
    state: TrackState,
    frame: FrameFeatures,
    probability: Float32[np.ndarray, "n h w"],
    identity: int,
    segmenter: LiteSegmenter,
    encoder: Encoder,
) -> tuple[TrackState, float]:
    """Search for a lost identity, by the first frame and the one that showed it last.

    What is accepted is written into `probability`, in place. Returns the state, to which the
    identities' appearances may have been added, and how sure it is that there is nothing to find.
    """
    memory = [state.first, state.last_seen[identity]]
    labels = propagate(frame.keys, memory, frame.grid, local=False)
    planes = to_pixels(labels, frame.grid, state.hw)
    share = planes[identity + 1]
    own = argmax_planes(planes) == identity + 1
    # Another identity may have grown over this one while it was hidden.
    taken = (probability > 0.5).any(axis=0) & ~own
    free = np.where(taken, 0, share).astype(np.float32)
    absence = 1 - float(np.clip(free.max(), 0, 1))
    box = _seed_box(free, share)
    if box is None:
        return state, absence
    box = _limit_size(box, state.boxes[identity])
    drawn, box = _draw(frame, segmenter, box, free, taken)
    if box is None or evidence_for(state, frame, identity, drawn > 0.5) < FOUND_EVIDENCE:
        return state, absence
    state = _with_embeddings(state, identity, encoder)
    last = state.last_rows[identity]
    assert state.appearances is not None
    assert last is not None
    row = encoder([crop(frame.image, box)])[0]
    if state.appearances.accept(row, last, identity):
        probability[:, own & (drawn > 0.5)] = 0
        probability[identity] = drawn
    return state, absence


def _with_embeddings(state: TrackState, identity: int, encoder: Encoder) -> TrackState:
    """The state with all first crops and one identity's last crop embedded."""
    if state.appearances is None:
        appearances = embed_appearances(encoder, state.first_crops, state.background)
        state = replace(state, appearances=appearances)
    if state.last_rows[identity] is None:
        last_rows = list(state.last_rows)
        last_rows[identity] = encoder([state.last_crops[identity]])[0]
        state = replace(state, last_rows=tuple(last_rows))
    return state


def _seed_box(
    free: Float32[np.ndarray, "h w"], share: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "4"] | None:
    """The box of the largest component that may be the identity, dilated; None without one."""
    seed = largest_component(free > MIN_SEED_SHARE, share)
    if seed is None:
        return None
    return mask_box(cv2.dilate(seed.astype(np.uint8), np.ones((SEED_GROWTH_PX,) * 2)) > 0)


def _limit_size(
    box: Float32[np.ndarray, "4"], last_box: Float32[np.ndarray, "4"]
) -> Float32[np.ndarray, "4"]:
    """The box, cut about its middle where it is `MAX_SWELL` times as wide or high as the last one.

    What is behind the object would otherwise be taken for it.
    """
    middle = (box[:2] + box[2:]) / 2
    half = np.minimum((box[2:] - box[:2]) / 2, MAX_SWELL * (last_box[2:] - last_box[:2]) / 2)
    return np.concatenate([middle - half, middle + half]).astype(np.float32)


def _draw(
    frame: FrameFeatures,
    segmenter: LiteSegmenter,
    box: Float32[np.ndarray, "4"],
    coarse: Float32[np.ndarray, "h w"],
    taken: Mask,
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "4"] | None]:
    """The segmenter's mask probabilities in a box, and the box of the mask, if there is one.

    The first pass shows how far the object reaches, the second draws it from its whole box.
    """
    outside = taken | (box_plane(box, taken.shape) == 0)
    for _ in range(2):
        drawn = segmenter.mask_probability(frame.image, box[None], coarse[None])[0]
        drawn = np.where(outside, 0, drawn)
        new_box = mask_box(drawn > 0.5)
        if new_box is None:
            return drawn, None
        box = new_box
    return drawn, box
