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
"""Verified points from which on a crop and a reference show the same print; an accident gives 4."""
OF_USUAL = 0.7
"""Share of the points in which the references agree that proves the print, where that is more:
look-alikes of one brand share up to half of it."""
GAIN = 0.35
"""What proof adds to a cosine, and what its lack takes from it where the references have a print.
On 45 packages pasted into photos, with 30 questions for a look-alike of what is there, .25 tints
11 of the 30, this 5, and both 30 of the 45; without points it is 30 and 29."""
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
    usual = usual_points(obj, verifier)  # type: ignore[arg-type]  # verifiers are hashable
    found = proof(verified, large, usual)
    return replace(proposals, boxes=replace(boxes, verified=verified, proof=found))


def proof(
    verified: Int64[np.ndarray, " n"], compared: Bool[np.ndarray, " n"], usual: float
) -> Float32[np.ndarray, " n"]:
    """What verified points say, in units of cosine: 0 where nothing was compared.

    `usual` is how many the references have in common; from `CERTAIN` on they have a print, and a
    view of the object is expected to show it.
    """
    enough = max(CERTAIN, OF_USUAL * usual)
    certainty = np.minimum(verified, enough) / enough
    found = GAIN * certainty
    if usual >= CERTAIN:
        found -= GAIN * (1 - certainty)
    return np.where(compared, found, 0.0).astype(np.float32)


@lru_cache(maxsize=256)
def usual_points(obj: PersonalObject, verifier: Verifier) -> float:
    """The median over an object's references of the most points that each shares with another one;
    0 for a single reference.
    """
    counts = verifier(obj.crops, obj.crops)
    np.fill_diagonal(counts, 0)
    return float(np.median(counts.max(axis=1)))
