"""Which box of each reference photo shows the object: what all photos of it have in common.

Every box that the detector proposes is a candidate. One that resembles some box of every other
photo, lies near the middle and is not small is chosen; a doubtful choice says why.
"""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32

from vap_core.base.errors import BadEncoder
from vap_core.base.types import Boxes, Rgb, value
from vap_core.perception.boxes import box_cover, box_iou, crop
from vap_core.perception.candidates import describe_fault, embed_crops, row_fault
from vap_core.perception.protocols import Detector, Encoder, ReferenceCropper

THRESHOLD = 0.05
"""Photos of the object show one of its kind, so a box needs a lower score than a proposal does."""
MOST_BOXES = 12
"""Boxes of a photo that are compared."""
SCORE_WEIGHT, CENTRE_WEIGHT, AREA_WEIGHT = 0.1, 0.3, 0.02
"""Of log score, distance from the photo's centre (in its sides) and log share of its area, beside
the cosine to the other photos."""
PRIOR_WEIGHT = 2.0
"""Of a box's prior, which takes the place of its score where a detector gives it."""
RIVAL_IOU = 0.5
"""A box that overlaps the chosen one by less would be another crop."""
ELSEWHERE = 0.1
"""A box shows something else when less than this share of the smaller of both is common."""
CLOSE, CLOSE_ALONE = 0.05, 0.1
"""Another crop that scores nearer to the chosen one than this makes it doubtful; the second holds
for a single photo."""
LEAST_COSINE = 0.5
"""Mean cosine to the best boxes of the other photos, below which the choice is doubtful."""
SMALL_SHARE = 0.01
"""Of a photo's area: a smaller box is more likely a part of the object."""
SMALL_PX = 64
"""The shorter side of a crop, below which little detail is left to compare."""
Box = Float32[np.ndarray, "4"]
ChosenBy = Literal["given", "whole", "proposed"]


@value
class Reference:
    """One reference photo with the box that is cropped.

    `agreement` is the mean cosine of the crop to the best crop of every other photo, nan for a
    single photo. `doubt` says why the box may be wrong, "" where nothing speaks against it.
    `others` are crops of the photo that show something else.
    """

    photo: Rgb
    box: Float32[np.ndarray, "4"]
    chosen_by: ChosenBy
    agreement: float
    doubt: str
    others: tuple[Rgb, ...]

    @property
    def crop(self) -> Rgb:
        if self.chosen_by == "whole":
            return self.photo
        return crop(self.photo, self.box)


def choose_references(
    photos: Sequence[Rgb],
    category: str,
    detector: Detector,
    encoder: Encoder,
    given: Mapping[int, Box | None] | None = None,
) -> tuple[Reference, ...]:
    """The box of every photo: the given one (by the photo's number), else the one that is chosen.

    A box None is none. A photo in which nothing is proposed is used whole, and its doubt says so.

    Raises: BadEncoder: its rows are no float32 array with one a crop, not finite, or not of length
        1 (within 1e-3): no box would resemble another.
    """
    boxes_given = {i: box for i, box in (given or {}).items() if box is not None}
    proposals = []
    rows = []
    for i, photo in enumerate(photos):
        boxes = _boxes_of(photo, category, detector, boxes_given.get(i))
        proposals.append(boxes)
        crops = [crop(photo, box) for box in boxes.xyxy]
        rows.append(embed_crops("remember", encoder, crops))
        fault = row_fault(rows[i], rows[0])
        if fault:
            raise BadEncoder(describe_fault("remember", encoder, fault))
    references = []
    for i, photo in enumerate(photos):
        others = [part for part in rows[:i] + rows[i + 1 :] if len(part)]
        # Of every box, the mean cosine to the most similar box of each other photo.
        best = [(rows[i] @ other.T).max(axis=1) for other in others]
        support = np.mean(best, axis=0) if others else np.full(len(rows[i]), np.nan)
        references.append(_choose(photo, proposals[i], support, i in boxes_given))
    return tuple(references)


def whole_photos(photos: Sequence[Rgb]) -> tuple[Reference, ...]:
    """References that are cut out already."""
    references = [_whole(photo, "") for photo in photos]
    return tuple(references)


def _boxes_of(photo: Rgb, category: str, detector: Detector, given: Box | None) -> Boxes:
    """The candidates of a photo: the given box first, then what is proposed."""
    if isinstance(detector, ReferenceCropper):
        found = detector.reference_boxes(photo, category, THRESHOLD)
    else:
        (found,) = detector([photo], category, THRESHOLD)
    xyxy = found.xyxy[:MOST_BOXES]
    score = found.score[:MOST_BOXES]
    evidence = np.log(score + np.float32(1e-3)) * np.float32(SCORE_WEIGHT)
    if found.prior is not None:
        evidence = np.float32(PRIOR_WEIGHT) * found.prior[:MOST_BOXES]
    if given is not None:
        xyxy = np.concatenate([given[None], xyxy])
        score = np.concatenate([np.ones(1, np.float32), score])
        evidence = np.concatenate([np.zeros(1, np.float32), evidence])
    return Boxes(xyxy, score, category, prior=evidence.astype(np.float32))


def _choose(
    photo: Rgb, boxes: Boxes, support: Float[np.ndarray, " n"], is_given: bool
) -> Reference:
    if not len(boxes):
        return _whole(photo, f"no {boxes.phrase} was found in it")
    score = _prior(photo, boxes) + np.nan_to_num(support)
    best = 0 if is_given else int(score.argmax())
    chosen = boxes.xyxy[best : best + 1]
    elsewhere = np.flatnonzero(box_cover(chosen, boxes.xyxy)[0] < ELSEWHERE)
    agreement = float(support[best])  # nan for a single photo
    rivals = score[box_iou(chosen, boxes.xyxy)[0] < RIVAL_IOU]
    close = CLOSE_ALONE if np.isnan(agreement) else CLOSE
    doubt = ""
    if is_given:
        pass
    elif float((chosen[0, 2:] - chosen[0, :2]).prod()) / photo[..., 0].size < SMALL_SHARE:
        doubt = "what was found is a small part of it"
    elif agreement < LEAST_COSINE:
        doubt = f"what was found is unlike the other photos (cosine {agreement:.2f})"
    elif len(rivals) and rivals.max() > score[best] - close:
        doubt = "two things in it could be meant"
    others = tuple(crop(photo, boxes.xyxy[i]) for i in elsewhere)
    chosen_by: ChosenBy = "given" if is_given else "proposed"
    return Reference(photo, chosen[0], chosen_by, agreement, doubt, others)


def _prior(photo: Rgb, boxes: Boxes) -> Float[np.ndarray, " n"]:
    """What speaks for each box of one photo before others are looked at."""
    assert boxes.prior is not None
    height, width = photo.shape[:2]
    size = np.array([width, height])
    centre = (boxes.xyxy[:, :2] + boxes.xyxy[:, 2:]) / 2 / size
    away = np.hypot(*(centre - 0.5).T)
    area = (boxes.xyxy[:, 2:] - boxes.xyxy[:, :2]).prod(axis=1) / (width * height)
    return boxes.prior - CENTRE_WEIGHT * away + AREA_WEIGHT * np.log(np.clip(area, 0.01, 1))


def _whole(photo: Rgb, doubt: str) -> Reference:
    height, width = photo.shape[:2]
    box = np.array([0, 0, width, height], np.float32)
    return Reference(photo, box, "whole", float("nan"), doubt, ())
