"""What is remembered of one view while its identities are followed.

Its size does not grow with the episode.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64

from vap_core.base.types import Rgb, Track, value
from vap_core.perception.boxes import crop, mask_box
from vap_core.perception.embedded.runtime import Network
from vap_core.perception.embedded.tracker.appearance import (
    N_BINS,
    Appearances,
    background_crop,
    blur_shares,
    colour_shares,
)
from vap_core.perception.embedded.tracker.cells import FrameMemory, Grid, embed_cells, to_cells

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
    tracks: list[Track] = []
    for mask, score, lost in zip(state.masks, state.scores, state.lost, strict=True):
        tracks.append(Track(None if lost else mask.copy(), float(np.clip(score, 0, 1))))
    return tuple(tracks)
