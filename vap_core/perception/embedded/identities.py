"""What is remembered of one view, which masks are believed, and the search for lost identities.

Its size does not grow with the episode.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64

from vap_core.base.types import Mask, Rgb, Track, value
from vap_core.perception.boxes import crop, mask_box, mask_iou
from vap_core.perception.embedded.cells import (
    N_BINS,
    Appearances,
    FrameMemory,
    Grid,
    argmax_planes,
    background_crop,
    blur_shares,
    colour_shares,
    cosine_lead,
    embed_appearances,
    embed_cells,
    familiar_share,
    largest_component,
    propagate,
    to_cells,
    to_pixels,
)
from vap_core.perception.embedded.networks import Network
from vap_core.perception.embedded.segmenter import LiteSegmenter, box_plane
from vap_core.perception.protocols import Encoder

RECENT = 3
"""Frames remembered besides the first."""
THUMBNAIL_SCALE = 4
"""Pixels of the image to one of a thumbnail."""
CHANGE_LEVEL = 9.0
"""Grey levels of a thumbnail, more than sensors add, by which something changed there."""
CHANGE_MARGIN = 2
"""Pixels of a thumbnail around a box in which changes count."""
Thumbnail = Float32[np.ndarray, "_a _b 3"]


@value
class TrackState:
    """One view; everything but `recent` and `hw` is per identity, or of t = 0."""

    hw: tuple[int, int]
    first: FrameMemory
    """The frame of t = 0."""
    recent: tuple[FrameMemory, ...]
    """The last frames, oldest first."""
    last_seen: tuple[FrameMemory, ...]
    """The frame that showed the identity last."""
    masks: Bool[np.ndarray, "n h w"]
    """The last masks; empty while the identity is not visible."""
    scores: Float32[np.ndarray, " n"]
    thumbnails: tuple[Thumbnail, ...]
    """The thumbnail of the frame in which the mask was drawn."""
    boxes: Float32[np.ndarray, "n 4"]
    """The last boxes, pixels."""
    area: Float32[np.ndarray, " n"]
    """The largest mask of late, pixels."""
    lost: Int64[np.ndarray, " n"]
    """Frames since the identity was visible."""
    followed: Bool[np.ndarray, " n"]
    """The others have no mask after t = 0, count as lost and are not searched for."""
    colours: Float32[np.ndarray, "2 n b"]
    """Blurred shares of colours: of t = 0, and a running mean."""
    first_crops: tuple[Rgb, ...]
    last_crops: tuple[Rgb, ...]
    """From the last frame that showed the identity well."""
    background: Rgb
    """A crop of the bare background at t = 0."""
    last_rows: tuple[Float32[np.ndarray, " d"] | None, ...]
    """Embeddings of `last_crops`, made when a search first needs them."""
    appearances: Appearances | None = None
    """Made when an identity is searched for the first time."""


@value
class FrameFeatures:
    """One frame while it is processed: image, thumbnail, and the features of its cells."""

    image: Rgb
    thumbnail: Thumbnail
    keys: Float32[np.ndarray, "p c"]
    grid: Grid


def initial_state(
    image: Rgb,
    masks: Bool[np.ndarray, "n h w"],
    network: Network,
    targets: Sequence[int] | None = None,
) -> TrackState:
    """The state at t = 0; row i of the masks is identity i. `network` embeds cells.

    All identities are followed, or the `targets` alone.
    """
    n = len(masks)
    followed: Bool[np.ndarray, " n"] = np.ones(n, bool)
    if targets is not None:
        followed = np.isin(np.arange(n), targets)
    keys, grid = embed_cells(image, network)
    area = masks.sum(axis=(1, 2))
    visible: Bool[np.ndarray, " n"] = area > 0
    boxes = np.tile(np.array([0, 0, 1, 1], np.float32), (n, 1))
    colours = np.zeros((n, N_BINS), np.float32)
    crops: list[Rgb] = []
    for i, mask in enumerate(masks):
        if visible[i]:
            boxes[i] = mask_box(mask)
        if followed[i]:
            colours[i] = blur_shares(colour_shares(image, mask))
        crops.append(crop(image, boxes[i]))
    first = FrameMemory(keys, to_cells(masks, grid))
    return TrackState(
        hw=image.shape[:2],
        first=first,
        recent=(),
        last_seen=(first,) * n,
        masks=masks & followed[:, None, None],
        scores=(visible & followed).astype(np.float32),
        thumbnails=(thumbnail_of(image),) * n,
        boxes=boxes,
        area=area.astype(np.float32),
        lost=(~(visible & followed)).astype(np.int64),
        followed=followed,
        colours=np.stack([colours, colours]),
        first_crops=tuple(crops),
        last_crops=tuple(crops),
        background=background_crop(image, boxes[visible]),
        last_rows=(None,) * n,
    )


def thumbnail_of(image: Rgb) -> Thumbnail:
    """Means of `THUMBNAIL_SCALE` x `THUMBNAIL_SCALE` pixels, grey levels."""
    h, w = image.shape[:2]
    size = (max(1, w // THUMBNAIL_SCALE), max(1, h // THUMBNAIL_SCALE))
    return cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA)


def changed_nearby(state: TrackState, thumbnail: Thumbnail) -> Bool[np.ndarray, " n"]:
    """For each identity, whether its box, or what is near it, changed since its mask was drawn."""
    changed = np.zeros(len(state.boxes), bool)
    for i, (x0, y0, x1, y1) in enumerate((state.boxes / THUMBNAIL_SCALE).astype(int)):
        top = max(0, y0 - CHANGE_MARGIN)
        left = max(0, x0 - CHANGE_MARGIN)
        window = np.s_[top : y1 + CHANGE_MARGIN + 1, left : x1 + CHANGE_MARGIN + 1]
        difference = np.abs(thumbnail[window] - state.thumbnails[i][window])
        changed[i] = bool((difference > CHANGE_LEVEL).any())
    return changed


def tracks_of(state: TrackState) -> tuple[Track, ...]:
    """What the tracker reports of a view.

    The score of an identity without a mask says how sure it is that it is not visible.
    """
    tracks = [
        Track(None if lost else mask.copy(), float(np.clip(score, 0, 1)))
        for mask, score, lost in zip(state.masks, state.scores, state.lost, strict=True)
    ]
    return tuple(tracks)


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
    # New masks of the judged identities: likely pixels that no other identity claims more.
    masks = state.masks.copy()
    claiming = np.flatnonzero(state.followed)  # the others claim nothing
    winner = argmax_planes(probability[claiming])
    for place, identity in enumerate(claiming):
        if identity in judged:
            masks[identity] = (probability[identity] > 0.5) & (winner == place)
    for i in judged:
        box = mask_box(masks[i])
        pixels = int(masks[i].sum())
        # There is no evidence where it is too small or too large to be the identity.
        growth = 2 * MAX_GROWTH if state.lost[i] else MAX_GROWTH
        evidence, needed = 0.0, CONTINUED_EVIDENCE
        if MIN_MASK_PX <= pixels <= growth * state.area[i]:
            evidence = evidence_for(state, frame, int(i), masks[i])
        if state.lost[i]:
            needed = FOUND_EVIDENCE
        elif pixels < SUDDEN * state.area[i] or mask_iou(masks[i], state.masks[i]) < SUDDEN:
            needed = SUDDEN_EVIDENCE
        if box is None or evidence < needed:
            masks[i] = False
            scores[i] = absence[i]
            if not state.lost[i]:
                scores[i] = 1 - float(np.clip(evidence, 0, 1))
            lost[i] += 1
            continue
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
    # The box of the largest component that may be the identity, dilated.
    seed = largest_component(free > MIN_SEED_SHARE, share)
    if seed is None:
        return state, absence
    grown = cv2.dilate(seed.astype(np.uint8), np.ones((SEED_GROWTH_PX,) * 2)) > 0
    box = mask_box(grown)
    assert box is not None
    last_box = state.boxes[identity]
    middle = (box[:2] + box[2:]) / 2
    half = np.minimum((box[2:] - box[:2]) / 2, MAX_SWELL * (last_box[2:] - last_box[:2]) / 2)
    box = np.concatenate([middle - half, middle + half]).astype(np.float32)
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
