"""Which of a frame's masks are believed, and what the state becomes."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32, Int64

from vap_core.base.types import Mask
from vap_core.perception.boxes import crop, mask_box, mask_iou
from vap_core.perception.embedded.tracker.appearance import (
    blur_shares,
    colour_shares,
    familiar_share,
)
from vap_core.perception.embedded.tracker.cells import FrameMemory, cosine_lead, to_cells
from vap_core.perception.embedded.tracker.components import argmax_planes
from vap_core.perception.embedded.tracker.state import RECENT, FrameFeatures, TrackState

MIN_MASK_PX = 24
"""A mask of fewer pixels is not visible."""
MAX_GROWTH = 2.5
"""A mask that many times larger than the identity's recent largest is something else; twice that
when it was lost."""
SUDDEN = 0.5
"""A mask that overlaps the one before by less IoU, or has a smaller share of the identity's recent
largest area, has changed suddenly."""
LEAD_WEIGHT = 3.0
"""What a cosine of lead counts beside a share of familiar colours."""
CONTINUED_EVIDENCE = 0.4
FOUND_EVIDENCE = 0.6
SUDDEN_EVIDENCE = 1.0
"""Evidence that a mask needs: one that goes on, one that was lost, one that changed suddenly."""
AREA_DECAY = 0.95
COLOUR_DECAY = 0.9
"""What a frame leaves of the recent largest area, and of the running colours."""
WELL_SHOWN = 0.7
"""Share of the recent largest area from which a frame shows the identity well."""


def evidence_for(state: TrackState, frame: FrameFeatures, identity: int, mask: Mask) -> float:
    """Evidence that `mask` is that identity; about 1.5 is usual.

    It is the share of familiar colours plus the lead of the mask's cells, which is about 0.2 when
    the mask is right.
    """
    memory = [state.first, *state.recent]
    if state.lost[identity]:
        memory = [state.first, state.last_seen[identity]]
    known = state.colours[:, identity].max(axis=0)
    familiar = familiar_share(colour_shares(frame.image, mask), known)
    share = to_cells(mask[None], frame.grid)[1]
    return familiar + LEAD_WEIGHT * cosine_lead(frame.keys, share, memory, identity)


def update_state(
    state: TrackState,
    frame: FrameFeatures,
    probability: Float32[np.ndarray, "n h w"],
    judged: Int64[np.ndarray, " k"],
    absence: Float32[np.ndarray, " n"],
) -> TrackState:
    """The state after a frame.

    `probability` says how strongly each identity claims each pixel. Only the identities in `judged`
    may change. `absence` says how sure it is that a lost identity is not in view.
    """
    boxes = state.boxes.copy()
    area = state.area.copy()
    lost = state.lost.copy()
    colours = state.colours.copy()
    scores = state.scores.copy()
    thumbnails = list(state.thumbnails)
    last_crops = list(state.last_crops)
    last_rows = list(state.last_rows)
    masks = _compete(state, probability, judged)
    for i in judged:
        box = mask_box(masks[i])
        evidence = _evidence_of_size(state, frame, int(i), masks[i])
        if box is None or evidence < _needed_evidence(state, int(i), masks[i]):
            masks[i] = False
            scores[i] = absence[i]
            if not state.lost[i]:
                scores[i] = 1 - float(np.clip(evidence, 0, 1))
            lost[i] += 1
            continue
        pixels = int(masks[i].sum())
        scores[i] = float(probability[i][masks[i]].mean()) * min(1.0, evidence)
        lost[i] = 0
        boxes[i] = box
        thumbnails[i] = frame.thumbnail
        area[i] = max(float(pixels), AREA_DECAY * float(area[i]))
        if evidence >= SUDDEN_EVIDENCE and pixels > WELL_SHOWN * area[i]:
            shown = blur_shares(colour_shares(frame.image, masks[i]))
            colours[1, i] = COLOUR_DECAY * colours[1, i] + 0.1 * shown
            last_crops[i] = crop(frame.image, box)
            last_rows[i] = None

    memory = FrameMemory(frame.keys, to_cells(masks, frame.grid))
    last_seen = list(state.last_seen)
    for i in np.flatnonzero(lost == 0):
        last_seen[i] = memory
    return replace(
        state,
        recent=(*state.recent, memory)[-RECENT:],
        last_seen=tuple(last_seen),
        masks=masks,
        scores=scores,
        thumbnails=tuple(thumbnails),
        boxes=boxes,
        area=area,
        lost=lost,
        colours=colours,
        last_crops=tuple(last_crops),
        last_rows=tuple(last_rows),
    )


def _compete(
    state: TrackState,
    probability: Float32[np.ndarray, "n h w"],
    judged: Int64[np.ndarray, " k"],
) -> np.ndarray:
    """New masks of the judged identities: likely pixels that no other identity claims more."""
    masks = state.masks.copy()
    claiming = np.flatnonzero(state.followed)  # the others claim nothing
    winner = argmax_planes(probability[claiming])
    for place, identity in enumerate(claiming):
        if identity in judged:
            masks[identity] = (probability[identity] > 0.5) & (winner == place)
    return masks


def _evidence_of_size(state: TrackState, frame: FrameFeatures, identity: int, mask: Mask) -> float:
    """The evidence for a mask; none where it is too small or too large to be the identity."""
    growth = MAX_GROWTH
    if state.lost[identity]:
        growth = 2 * MAX_GROWTH
    if not MIN_MASK_PX <= int(mask.sum()) <= growth * state.area[identity]:
        return 0.0
    return evidence_for(state, frame, identity, mask)


def _needed_evidence(state: TrackState, identity: int, mask: Mask) -> float:
    if state.lost[identity]:
        return FOUND_EVIDENCE
    smaller = int(mask.sum()) < SUDDEN * state.area[identity]
    if smaller or mask_iou(mask, state.masks[identity]) < SUDDEN:
        return SUDDEN_EVIDENCE
    return CONTINUED_EVIDENCE
