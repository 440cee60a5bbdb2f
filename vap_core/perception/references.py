"""Which box of each reference photo shows the object: what all photos of it have in common.

Every box that the detector proposes is a candidate. One that resembles some box of every other
photo, lies near the middle and is not small is chosen. Then the chosen boxes vote on each other
until they agree; a doubtful choice says why.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32

from vap_core.base.errors import BadEncoder
from vap_core.base.types import Boxes, Rgb, value
from vap_core.perception.boxes import box_cover, box_iou, crop
from vap_core.perception.candidates import describe_fault, detect, embed_crops, row_fault
from vap_core.perception.protocols import Detector, Encoder, ReferenceCropper

THRESHOLD = 0.05
"""Photos of the object show one of its kind, so a box needs a lower score than a proposal does."""
MOST_BOXES = 12
"""Boxes of a photo that are compared."""
SCORE_WEIGHT, CENTRE_WEIGHT, AREA_WEIGHT = 0.1, 0.3, 0.02
"""Of log score, distance from the photo's centre (in its sides) and log share of its area, beside
the cosine to the other photos."""
ROUNDS = 4
"""How often boxes are chosen: first by all boxes of the other photos, then by the chosen ones."""
RIVAL_IOU = 0.5
"""A box that overlaps the chosen one by less would be another crop."""
ELSEWHERE = 0.1
"""A box shows something else when less than this share of the smaller of both is common."""
FEWEST = 3
"""Photos from which on their votes decide, and references that are enough."""
AGREED = 2 / 3
"""Share of the other photos' votes below which a choice is doubtful."""
CLOSE, CLOSE_ALONE = 0.05, 0.1
"""Another crop that scores nearer to the chosen one than this by all that the other photos show
makes it doubtful: any of fewer photos than FEWEST, else one that shows something else. The second
holds for a single photo."""
LEAST_COSINE = 0.5
"""Mean cosine to the chosen boxes of the other photos, below which the choice is doubtful."""
SMALL_SHARE = 0.01
"""Of a photo's area: a smaller box is more likely a part of the object."""
PART_SIZE, PART_COSINE = 0.25, 0.05
"""A crop is more likely a part where it is smaller than this share of the usual crop, and that much
less like the other photos' crops than is usual."""
SMALL_PX = 64
"""The shorter side of a crop, below which little detail is left to compare."""
Box = Float32[np.ndarray, "4"]
ChosenBy = Literal["given", "whole", "proposed"]


@value
class Reference:
    """One reference photo with the box that is cropped.

    `agreement` is the mean cosine of the crop to the best crop of every other photo, nan for a
    single photo. `doubt` says why the box may be wrong, "" where nothing speaks against it.
    `rival` is the next best box of a photo, another crop. `others` are crops of the photo that show
    something else.
    """

    photo: Rgb
    box: Float32[np.ndarray, "4"]
    chosen_by: ChosenBy
    agreement: float
    doubt: str
    rival: Box | None
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
    priors = [_prior(photo, boxes) for photo, boxes in zip(photos, proposals, strict=True)]
    shown = rows
    first: list[np.ndarray] = []
    for _ in range(ROUNDS):
        # Of every other photo, the cosine of what it shows to every box of this one.
        ballots = []
        for i, part in enumerate(rows):
            others = [other for other in shown[:i] + shown[i + 1 :] if len(other)]
            cosines = [(part @ other.T).max(axis=1) for other in others]
            ballots.append(np.array(cosines or [np.full(len(part), np.nan)]))
        first = first or ballots
        best = [
            0 if i in boxes_given or not prior.size else int(_score(prior, ballot).argmax())
            for i, (prior, ballot) in enumerate(zip(priors, ballots, strict=True))
        ]
        shown = [part[k : k + 1] for part, k in zip(rows, best, strict=True)]
    references = [
        _choose(photos[i], proposals[i], priors[i], best[i], first[i], ballots[i], i in boxes_given)
        for i in range(len(photos))
    ]
    size = np.array([(r.box[2:] - r.box[:2]).prod() / r.photo[..., 0].size for r in references])
    cosine = np.array([r.agreement for r in references])
    small = (size < PART_SIZE * np.median(size)) & (cosine < np.median(cosine) - PART_COSINE)
    return tuple(
        replace(r, doubt="what was found may be a part of it")
        if is_small and r.chosen_by == "proposed" and not r.doubt
        else r
        for r, is_small in zip(references, small, strict=True)
    )


def whole_photos(photos: Sequence[Rgb]) -> tuple[Reference, ...]:
    """References that are cut out already."""
    references = [_whole(photo, "") for photo in photos]
    return tuple(references)


def _boxes_of(photo: Rgb, category: str, detector: Detector, given: Box | None) -> Boxes:
    """The candidates of a photo: the given box first, then what is proposed."""
    if isinstance(detector, ReferenceCropper):
        found, _ = detector.reference_boxes(photo, category, THRESHOLD)
    else:
        (found,) = detect(detector, [photo], category, THRESHOLD)
    xyxy = found.xyxy[:MOST_BOXES]
    score = found.score[:MOST_BOXES]
    if given is not None:
        xyxy = np.concatenate([given[None], xyxy])
        score = np.concatenate([np.ones(1, np.float32), score])
    return Boxes(xyxy, score, category)


def _choose(
    photo: Rgb,
    boxes: Boxes,
    prior: Float[np.ndarray, " n"],
    best: int,
    first: Float[np.ndarray, "k n"],
    ballots: Float[np.ndarray, "k n"],
    is_given: bool,
) -> Reference:
    if not len(boxes):
        return _whole(photo, f"no {boxes.phrase} was found in it")
    enough = len(ballots) >= FEWEST - 1
    score = _score(prior, first)
    chosen = boxes.xyxy[best : best + 1]
    agreement = float(ballots[:, best].mean())
    rivals = box_iou(chosen, boxes.xyxy)[0] < RIVAL_IOU
    apart = box_cover(chosen, boxes.xyxy)[0] < ELSEWHERE
    lead = np.where(rivals, score[best] - score, np.inf)
    close = lead < (CLOSE_ALONE if np.isnan(agreement) else CLOSE)
    outvoted = enough and rivals[(prior + ballots).argmax(axis=1)].mean() > 1 - AGREED
    doubt = ""
    if is_given:
        pass
    elif float((chosen[0, 2:] - chosen[0, :2]).prod()) / photo[..., 0].size < SMALL_SHARE:
        doubt = "what was found is a small part of it"
    elif agreement < LEAST_COSINE:
        doubt = f"what was found is unlike the other photos (cosine {agreement:.2f})"
    elif outvoted or (close & (apart if enough else True)).any():
        doubt = "two things in it could be meant"
    rival = boxes.xyxy[lead.argmin()] if rivals.any() else None
    others = tuple(crop(photo, box) for box in boxes.xyxy[apart])
    chosen_by: ChosenBy = "given" if is_given else "proposed"
    return Reference(photo, chosen[0], chosen_by, agreement, doubt, rival, others)


def _score(
    prior: Float[np.ndarray, " n"], ballots: Float[np.ndarray, "k n"]
) -> Float[np.ndarray, " n"]:
    return prior + np.nan_to_num(ballots.mean(axis=0))


def _prior(photo: Rgb, boxes: Boxes) -> Float[np.ndarray, " n"]:
    """What speaks for each box of one photo before others are looked at."""
    height, width = photo.shape[:2]
    size = np.array([width, height])
    centre = (boxes.xyxy[:, :2] + boxes.xyxy[:, 2:]) / 2 / size
    away = np.hypot(*(centre - 0.5).T)
    area = (boxes.xyxy[:, 2:] - boxes.xyxy[:, :2]).prod(axis=1) / (width * height)
    evidence = np.log(boxes.score + np.float32(1e-3)) * np.float32(SCORE_WEIGHT)
    return evidence - CENTRE_WEIGHT * away + AREA_WEIGHT * np.log(np.clip(area, 0.01, 1))


def _whole(photo: Rgb, doubt: str) -> Reference:
    height, width = photo.shape[:2]
    box = np.array([0, 0, width, height], np.float32)
    return Reference(photo, box, "whole", float("nan"), doubt, None, ())
