"""The embedded stack's detector: boxes of any object, and the evidence that one is of the phrase's
kind.

Boxes come from the proposer, which takes no phrase. The phrase head (detector.py) was trained on
rendered scenes: on renders it knows kinds of things apart, on photos it finds next to nothing. So
its boxes raise the prior of the proposals that they agree with and remove none, and its best score
in a view says whether the view is of the world that it was trained on.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
from jaxtyping import Bool, Float32

from vap_core.base.types import Boxes, Rgb
from vap_core.perception.boxes import box_iou, suppress_overlaps
from vap_core.perception.embedded import detector, proposer
from vap_core.perception.embedded.proposer import LARGEST_SHARE, LEAST_SCORE, MOST, Propose
from vap_core.perception.protocols import Detector

PHRASE_FLOOR = 0.03
"""Score from which on a box of the phrase head is looked at."""
FAMILIAR = 0.4
"""Best score of the phrase head from which on a view is familiar. In 200 of 209 rendered opening
views a camera of the episode reaches it, and in 24 % of 95 photos of toys, pets and other things;
with .2 it is all of them and 43 %. The vote is the same on renders, and two of 80 better on photos.
"""
MOST_FAMILIAR = 8
"""Boxes of a familiar view that need no agreement, of the best 20. In 209 rendered views, 0 to 20
elect the same; the more, the better for designs that the phrase head has not seen. Every crop costs
a pass of the encoder."""
MOST_UNFAMILIAR = 40
"""Boxes of an unfamiliar view. Of 80 objects pasted into real photos 20 boxes elect 56, 40 elect 60
and 60 elect 61."""
SAME_OBJECT_IOU = 0.6
"""Of proposals that overlap by more, the best stays. In 198 views it changes no winner, and leaves
29 crops of 40 in an unfamiliar view and 8 of 9 in a familiar one."""
REFERENCE_SHARE = 0.95
"""A reference's object may fill the photo."""
AGREEMENT = 0.05
AGREEMENT_IOU = 0.5
"""What a proposal gains in units of cosine where a box of the phrase head agrees with it."""
OBJECTNESS = 0.05
"""What a proposal gains for every natural logarithm of its score."""


class OpenDetector:
    """Proposes boxes of any object, with the phrase as evidence."""

    def __init__(self, propose: Propose, by_category: Detector) -> None:
        self.propose = propose
        self.by_category = by_category

    def __call__(
        self, images: Sequence[Rgb], phrase: str, threshold: float | None = None
    ) -> list[Boxes]:
        """The proposals of each image with their priors; `threshold` bounds the proposer's score.

        A word that the phrase head does not know changes nothing but the priors.
        """
        if threshold is None:
            threshold = LEAST_SCORE
        found = []
        for image in images:
            named = self._named(image, phrase)
            familiar = _is_familiar(named)
            most = MOST if familiar else MOST_UNFAMILIAR
            xyxy, score = self.propose(image, threshold, most, LARGEST_SHARE)
            alone = suppress_overlaps(xyxy, score, iou=SAME_OBJECT_IOU, most=len(xyxy))
            xyxy = xyxy[alone]
            score = score[alone]
            if familiar:
                kept = agreed(xyxy, named)
                kept[:MOST_FAMILIAR] = True
                xyxy = xyxy[kept]
                score = score[kept]
            boxes = Boxes(
                xyxy=xyxy,
                score=score,
                phrase=phrase,
                prior=prior(xyxy, score, named),
                familiar=familiar,
            )
            found.append(boxes)
        return found

    def reference_boxes(self, photo: Rgb, phrase: str, threshold: float) -> Boxes:
        """Boxes of any size, with their priors.

        Where the phrase head knows the object, the likeliest box that it agrees with is its own.
        """
        xyxy, score = self.propose(photo, threshold, MOST_UNFAMILIAR, REFERENCE_SHARE)
        named = self._named(photo, phrase)
        evidence = prior(xyxy, score, named)
        familiar = _is_familiar(named)
        if familiar:
            overlap = box_iou(xyxy, named.xyxy[:1])[:, 0]
            agreeing = np.flatnonzero(overlap >= AGREEMENT_IOU)
            if len(agreeing):
                xyxy[agreeing[evidence[agreeing].argmax()]] = named.xyxy[0]
        return Boxes(xyxy=xyxy, score=score, phrase=phrase, prior=evidence, familiar=familiar)

    def is_familiar(self, image: Rgb, phrase: str) -> bool:
        """Whether the image is of the world that the phrase head was trained on."""
        return _is_familiar(self._named(image, phrase))

    def _named(self, image: Rgb, phrase: str) -> Boxes:
        """The boxes of the phrase head, the unsure ones too."""
        return self.by_category([image], phrase, PHRASE_FLOOR)[0]


def prior(
    xyxy: Float32[np.ndarray, "n 4"], score: Float32[np.ndarray, " n"], named: Boxes
) -> Float32[np.ndarray, " n"]:
    """The evidence for each proposal besides the references', in units of cosine."""
    objectness = np.log(score + np.float32(1e-3))
    evidence = OBJECTNESS * objectness + AGREEMENT * agreed(xyxy, named)
    return evidence.astype(np.float32)


def agreed(xyxy: Float32[np.ndarray, "n 4"], named: Boxes) -> Bool[np.ndarray, " n"]:
    """Which proposals a sure box of the phrase head agrees with."""
    sure = named.xyxy[named.score >= detector.THRESHOLD]
    return box_iou(xyxy, sure).max(axis=1, initial=0.0) >= AGREEMENT_IOU


def _is_familiar(named: Boxes) -> bool:
    return bool(named.score.max(initial=0.0) >= FAMILIAR)


@cache
def load() -> OpenDetector:
    """The shipped detector.

    Raises: MissingWeights: a file of data/weights is absent or damaged.
    """
    return OpenDetector(proposer.load(), detector.load())
