"""All that is known of one view while its identities are followed; its size does not grow with the episode."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64

from vap_core.embed import crop
from vap_core.segment import bounds
from vap_core.track.cells import Memory, embed_cells, to_cells
from vap_core.track.looks import BINS, Looks, bare, spread, tone_of
from vap_core.values import Rgb, value

RECENT = 3
"""Frames remembered besides the first."""
SHRINK = 4
"""Pixels of the picture to one of a thumbnail."""
RESTLESS = 9.0
"""Grey levels in a thumbnail, beyond what sensors add, by which something changed there."""


@value
class TrackState:
    """One view. Per identity: its last `masks` and `scores`, the thumbnail in which they were drawn, its `last` box (pixels), recent largest
    `area` (pixels), and frames `lost` since.
    """

    hw: tuple[int, int]
    first: Memory
    recent: tuple[Memory, ...]
    sights: tuple[Memory, ...]
    """Per identity, the frame in which it was seen last."""
    masks: Bool[np.ndarray, "n h w"]
    scores: Float32[np.ndarray, " n"]
    thumbs: tuple[Float32[np.ndarray, "_a _b 3"], ...]
    last: Float32[np.ndarray, "n 4"]
    area: Float32[np.ndarray, " n"]
    lost: Int64[np.ndarray, " n"]
    tones: Float32[np.ndarray, "2 n b"]
    """Shares of colours: of t = 0, and running."""
    early: tuple[Rgb, ...]
    late: tuple[Rgb, ...]
    """Crops of t = 0, and of the last frame that showed the identity well."""
    ground: Rgb
    """Bare surroundings at t = 0."""
    looks: Looks | None = None
    """Made when an identity is searched for the first time."""


def begin(image: Rgb, masks: Bool[np.ndarray, "n h w"]) -> TrackState:
    """The state at t = 0."""
    n = len(masks)
    keys, grid = embed_cells(image)
    last = np.array([(0, 0, 1, 1) if (box := bounds(mask)) is None else box for mask in masks], np.float32).reshape(n, 4)
    tones = np.array([spread(tone_of(image, mask)) for mask in masks], np.float32).reshape(n, int(np.prod(BINS)))
    first, small, crops = Memory(keys, to_cells(masks, grid)), thumb(image), tuple(crop(image, box) for box in last)
    shown = np.array([mask.any() for mask in masks], bool)
    return TrackState(
        hw=image.shape[:2], first=first, recent=(), sights=(first,) * n, masks=masks.copy(), scores=shown.astype(np.float32), thumbs=(small,) * n,
        last=last, area=masks.sum(axis=(1, 2)).astype(np.float32), lost=(~shown).astype(np.int64), tones=np.stack([tones, tones]), early=crops,
        late=crops, ground=bare(image, last[shown]),
    )  # fmt: skip


def thumb(image: Rgb) -> Float32[np.ndarray, "a b 3"]:
    """Means of `SHRINK` x `SHRINK` pixels, grey levels."""
    h, w = image.shape[:2]
    return cv2.resize(image.astype(np.float32), (max(1, w // SHRINK), max(1, h // SHRINK)), interpolation=cv2.INTER_AREA)


def stirred(state: TrackState, small: Float32[np.ndarray, "a b 3"]) -> Bool[np.ndarray, " n"]:
    """For each identity, whether anything in its box, or near it, differs from when its mask was drawn."""
    found = np.zeros(len(state.last), bool)
    for i, (x0, y0, x1, y1) in enumerate((state.last / SHRINK).astype(int)):
        window = np.s_[max(0, y0 - 2) : y1 + 3, max(0, x0 - 2) : x1 + 3]
        found[i] = bool((np.abs(small[window] - state.thumbs[i][window]) > RESTLESS).any())
    return found
