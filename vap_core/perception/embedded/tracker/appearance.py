"""An identity's appearance: the colours it has shown, and embeddings of its crops.

Colours are compared in every frame. Embeddings decide whether what a search found is the identity.
"""

import cv2
import numpy as np
from jaxtyping import Float32

from vap_core.base.types import Mask, Rgb, value
from vap_core.perception.boxes import crop, mask_box
from vap_core.perception.protocols import Encoder

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
