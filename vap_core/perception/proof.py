"""Whether a candidate shows the very points of the references: proof where an embedding is unsure.

A look-alike embeds like the object, but its print differs. In views of a world that the stack's own
models have not seen, photos above all, crops are compared with the references point by point, and
what is found is added to their cosines. Views of the trained world are left alone: their crops are
too small for points.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float32, Int64

from vap_core.base.types import PersonalObject, Rgb
from vap_core.perception.boxes import crop
from vap_core.perception.candidates import Proposals
from vap_core.perception.protocols import Verifier

CERTAIN = 16
"""Verified points from which on a crop and a reference show the same print: an accident
gives 4, look-alikes of one brand 5 to 40, half of them fewer than this."""
GAIN = 0.25
"""What `CERTAIN` points add to a cosine, and what their lack takes from it where the references
have prints that agree."""
LEAST_PX = 64
"""The longer side of a box from which on its points are looked for."""
MOST_COMPARED = 8
"""Proposals of a view that are compared, the best by cosine."""


def prove(rgb: Rgb, obj: PersonalObject, proposals: Proposals, verifier: Verifier) -> Proposals:
    """The proposals with their verified points, and what these say."""
    boxes = proposals.boxes
    sides = (boxes.xyxy[:, 2:] - boxes.xyxy[:, :2]).max(axis=1, initial=0.0)
    large = sides >= LEAST_PX
    verified = np.zeros(len(boxes), np.int64)
    crops = [crop(rgb, box) for box in boxes.xyxy[large]]
    verified[large] = verifier(crops, obj.crops).max(axis=1, initial=0)
    found = proof(verified, large, is_printed(obj, verifier))
    return replace(proposals, boxes=replace(boxes, verified=verified, proof=found))


def proof(
    verified: Int64[np.ndarray, " n"], compared: Bool[np.ndarray, " n"], printed: bool
) -> Float32[np.ndarray, " n"]:
    """What verified points say, in units of cosine: 0 where nothing was compared."""
    certainty = np.minimum(verified, CERTAIN) / CERTAIN
    found = GAIN * certainty
    if printed:
        found -= GAIN * (1 - certainty)
    return np.where(compared, found, 0.0).astype(np.float32)


@lru_cache(maxsize=256)
def is_printed(obj: PersonalObject, verifier: Verifier) -> bool:
    """Whether most references agree with another one in `CERTAIN` points: then a view of the object
    is expected to as well.
    """
    counts = verifier(obj.crops, obj.crops)
    np.fill_diagonal(counts, 0)
    best = counts.max(axis=1)
    return bool(len(best) > 1 and np.mean(best >= CERTAIN) > 0.5)
