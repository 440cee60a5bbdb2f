"""What an identity looks like, twice: the colours it has shown, checked in every frame, and embedded crops, by which it is taken back."""

import cv2
import numpy as np
from jaxtyping import Float32

from vap_core.embed import Encoder, crop
from vap_core.segment import bounds
from vap_core.values import Mask, Rgb, value

BINS = (6, 12, 12)
"""Colour histogram over lightness, green-red and blue-yellow."""
MORE = 3.0
"""How much more frequent a colour may be in a part of an identity than in the whole."""
LIKE = 0.3
"""How far from the bare surroundings' cosine (0) to its own (1) whatever is taken back must lie. Of views of held-out generic objects nine in ten
lie there, seen from wherever; of views of other objects one in four, so it must also be more like itself than like any other identity."""
Tone = Float32[np.ndarray, " b"]
"""The share of an identity's pixels in each colour."""


def tone_of(image: Rgb, mask: Mask) -> Tone:
    """Lab histogram of the masked pixels, as shares; zeros for an empty mask."""
    box = bounds(mask)
    if box is None:
        return np.zeros(int(np.prod(BINS)), np.float32)
    x0, y0, x1, y1 = box.astype(int)
    lab = cv2.cvtColor(image[y0:y1, x0:x1], cv2.COLOR_RGB2LAB)
    count = cv2.calcHist([lab], [0, 1, 2], mask[y0:y1, x0:x1].astype(np.uint8), BINS, [0, 256, 64, 192, 64, 192]).ravel()
    return (count / max(float(count.sum()), 1.0)).astype(np.float32)


def spread(tone: Tone) -> Tone:
    """Each colour's neighbours get half its share, unless they have more: a shade lighter or darker is the same colour."""
    cube = tone.reshape(BINS)
    for axis in range(3):
        wide = np.pad(cube, [(int(a == axis), int(a == axis)) for a in range(3)])
        below, above = (np.take(wide, np.arange(cube.shape[axis]) + shift, axis) for shift in (0, 2))
        cube = np.maximum(cube, 0.5 * np.maximum(below, above))
    return cube.ravel()


def familiar(tone: Tone, known: Tone) -> float:
    """The share of pixels in colours that the identity has shown: high for any larger part of it, low for a thing in front of it."""
    return float(np.minimum(tone, MORE * known).sum())


@value
class Looks:
    """Embeddings of every identity's first crop, and the cosine that each asks of what is to be taken for it."""

    rows: Float32[np.ndarray, "n d"]
    least: Float32[np.ndarray, " n"]

    def accept(self, row: Float32[np.ndarray, " d"], late: Float32[np.ndarray, " d"], identity: int) -> bool:
        """Whether `row` is like `identity`, as it was at first or of `late`, and more so than like any other."""
        cosine = self.rows @ row
        own = max(float(cosine[identity]), float(late @ row))
        return own >= float(self.least[identity]) and own >= float(np.delete(cosine, identity).max(initial=-1.0))


def remember(encoder: Encoder, crops: tuple[Rgb, ...], ground: Rgb) -> Looks:
    """Looks whose measure is relative: `ground`, bare surroundings, tells what cosine means nothing in this encoder."""
    rows, bare = encoder(crops), encoder([ground])[0]
    floor = rows @ bare
    return Looks(rows, floor + np.float32(LIKE) * (1 - floor))


def bare(image: Rgb, boxes: Float32[np.ndarray, "n 4"]) -> Rgb:
    """A square as large as the boxes, from where the picture is farthest from all of them."""
    h, w = image.shape[:2]
    areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    half = 0.5 * float(np.clip(np.sqrt(areas.mean()) if len(boxes) else 32.0, 16.0, min(h, w)))
    free = np.zeros((h + 2, w + 2), np.uint8)
    free[1:-1, 1:-1] = 1
    for x0, y0, x1, y1 in boxes.astype(int):
        free[y0 + 1 : y1 + 1, x0 + 1 : x1 + 1] = 0
    y, x = np.unravel_index(int(cv2.distanceTransform(free, cv2.DIST_C, 3)[1:-1, 1:-1].argmax()), (h, w))
    return crop(image, np.array([x - half, y - half, x + half, y + half], np.float32))
