"""The vote of one target in one view, and what the views agreed on."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr

from vap_core.base.events import describe_ballot
from vap_core.base.pictures import RIGHT_MARK, WRONG_MARK, Rgb8, vote_picture
from vap_core.base.types import Association, Grounding, Rgb
from vap_core.recording.colours import ELECTED, MUTED, image_root, target_suffix
from vap_core.recording.entities.pictures import JPEG_QUALITY, encode_jpeg, jpeg_image
from vap_core.recording.stream import log_row

type Rect = tuple[float, float, float, float]
"""`x0 y0 x1 y1`, pixels."""
VIEW_POINTS = 170
"""Height of the smallest view among the layouts; text keeps its size on the screen."""
CHARACTER_POINTS, PADDING_POINTS, LINE_POINTS = 6.6, 12, 21


def are_disjoint(a: Rect, b: Rect) -> bool:
    """Whether two rectangles share no area."""
    return a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]


def place_labels(
    xyxy: np.ndarray, labels: Sequence[str], shape: tuple[int, ...]
) -> dict[int, tuple[float, float]]:
    """The top centre of each label, pixels; labels without room are left out.

    The last label is the winner's: it takes the freer of the picture's top and bottom edges.
    """
    height, width = shape
    pixels_per_point = max(height, width) / VIEW_POINTS
    sizes = []
    for label in labels:
        label_width = (CHARACTER_POINTS * len(label) + PADDING_POINTS) * pixels_per_point
        sizes.append((label_width, LINE_POINTS * pixels_per_point))
    winner_height = sizes[-1][1]
    winner_top = 0.0
    if xyxy[:, 1].min() <= height - xyxy[:, 3].max():
        winner_top = height - winner_height
    occupied: list[Rect] = [
        (0.0, winner_top, float(width), winner_top + winner_height),
        tuple(xyxy[-1].tolist()),
    ]
    spots = {len(labels) - 1: (width / 2, winner_top)}
    for i, (box, size) in enumerate(zip(xyxy[:-1].tolist(), sizes[:-1], strict=True)):
        spot = _free_spot(box, size, occupied, width, height)
        if spot is not None:
            spots[i] = spot
            occupied.append(_label_rect(spot, size))
    return spots


def _free_spot(
    box: Sequence[float],
    size: tuple[float, float],
    occupied: Sequence[Rect],
    width: int,
    height: int,
) -> tuple[float, float] | None:
    """Below the box, above it, left or right of it: the first that covers nothing."""
    x0, y0, x1, y1 = box
    label_width, label_height = size
    centre = (x0 + x1) / 2
    level = (y0 + y1 - label_height) / 2
    places = (
        (centre, y1),
        (centre, y0 - label_height),
        (x0 - label_width / 2, level),
        (x1 + label_width / 2, level),
    )
    for x, y in places:
        x = min(max(x, label_width / 2), width - label_width / 2)
        rect = _label_rect((x, y), size)
        inside = y >= 0 and y + label_height <= height
        if inside and _covers_nothing(rect, occupied):
            return x, y
    return None


def _label_rect(spot: tuple[float, float], size: tuple[float, float]) -> Rect:
    x, y = spot
    width, height = size
    return (x - width / 2, y, x + width / 2, y + height)


def _covers_nothing(rect: Rect, occupied: Sequence[Rect]) -> bool:
    return all(are_disjoint(rect, other) for other in occupied)


WINNER_RADIUS_PT, OTHER_RADIUS_PT = 2.5, 1.2


def log_vote(
    rec: rr.RecordingStream,
    grounding: Grounding,
    j: int,
    rgb: Rgb,
    references: Sequence[Rgb],
    at: Sequence[rr.TimeColumn],
    yours: int | None = None,
    again: bool = False,
) -> None:
    """The vote of target j in one view: labelled boxes over its picture, a picture, numbers.

    `yours` is the candidate that is the target, -1 where none is, None where that is unknown.
    Where it is held `again`, for another sub-goal, a vote without candidates takes the boxes of
    the one before away.
    """
    name = f"{grounding.camera}{target_suffix(j)}"
    order = _drawing_order(grounding)
    entity = f"{image_root(grounding.camera)}/candidates{target_suffix(j)}"
    drawn = vote_picture(grounding, rgb, references, yours=yours)
    for where, picture in ((entity, rgb), (f"/vap/vote_picture/{name}", drawn)):
        log_row(rec, where, jpeg_image(encode_jpeg(picture, JPEG_QUALITY)), at=at)
    if order:
        _log_boxes(rec, entity, grounding, order, at, yours)
        counts = rr.AnyValues(counts=grounding.ballot.votes)
        log_row(rec, f"/vap/votes/{name}", counts, at=at)
    elif again:
        nothing = np.zeros((0, 4), np.float32)
        log_row(rec, entity, rr.Boxes2D(array=nothing, array_format=rr.Box2DFormat.XYXY), at=at)
        log_row(rec, f"{entity}/labels", rr.Points2D(np.zeros((0, 2), np.float32)), at=at)
        log_row(rec, f"/vap/votes/{name}", rr.AnyValues(counts=np.zeros(1, np.int64)), at=at)
    log_row(rec, f"/vap/candidates/{name}", _candidate_numbers(grounding), at=at)


def log_association(
    rec: rr.RecordingStream, association: Association, j: int, at: Sequence[rr.TimeColumn]
) -> None:
    """What the views agreed on for target j, and by what scores.

    `chosen` is -1 where the target is in none of the candidates.
    """
    chosen = []
    for candidate in association.chosen.values():
        chosen.append(_number(candidate))
    support: dict[str, Any] = {}
    for camera, scores in association.support.items():
        support[f"support_{camera}"] = scores
    numbers = rr.AnyValues(
        cameras=list(association.chosen),
        chosen=np.array(chosen, np.int64),
        total=association.total,
        margin=association.margin,
        terms=list(association.terms),
        scores=np.array(list(association.terms.values())),
        **support,
    )
    log_row(rec, f"/vap/association{target_suffix(j)}", numbers, at=at)


def mean_cosines(grounding: Grounding) -> np.ndarray:
    """Every candidate's mean cosine to the references."""
    if len(grounding.similarity) == 0:
        return np.zeros(0, np.float32)
    return grounding.similarity.mean(axis=1)


def _drawing_order(grounding: Grounding) -> list[int]:
    """Candidates from the bottom to the top; on top the winner, or else the elected one."""
    order = list(range(len(grounding.similarity)))
    top = grounding.ballot.winner if grounding.chosen is None else grounding.chosen
    if top is not None:
        order.remove(top)
        order.append(top)
    return order


def _log_boxes(
    rec: rr.RecordingStream,
    entity: str,
    grounding: Grounding,
    order: list[int],
    at: Sequence[rr.TimeColumn],
    yours: int | None,
) -> None:
    """Every candidate's box, and the labels that have room; `order` is that of drawing."""
    xyxy = grounding.candidates.xyxy[order]
    colours: list[Rgb8] = []
    radii = []
    long_labels = []
    labels = []
    for i in order:
        is_winner = i == grounding.winner
        colours.append(ELECTED if is_winner else MUTED)
        radii.append(WINNER_RADIUS_PT if is_winner else OTHER_RADIUS_PT)
        long_labels.append(_long_label(grounding, i))
        labels.append(f"#{i} v{grounding.ballot.votes[i]}")
    labels[-1] = _top_label(grounding, order[-1], yours)
    boxes = rr.Boxes2D(
        array=xyxy.reshape(-1, 4),
        array_format=rr.Box2DFormat.XYXY,
        labels=long_labels,
        colors=colours,
        radii=rr.components.Radius.ui_points(radii),
        show_labels=False,
    )
    log_row(rec, entity, boxes, at=at)
    spots = place_labels(xyxy, labels, grounding.masks.shape[1:])
    points = rr.Points2D(
        list(spots.values()),
        radii=0,
        labels=[labels[i] for i in spots],
        colors=[colours[i] for i in spots],
        show_labels=True,
    )
    # A label says "#2"; where some have no room, its place in the list does not.
    candidates = rr.AnyValues(candidate=np.array([order[i] for i in spots], np.int64))
    log_row(rec, f"{entity}/labels", points, candidates, at=at)


def _long_label(grounding: Grounding, i: int) -> str:
    """Detection score, votes and mean cosine of one candidate."""
    score = grounding.candidates.score[i]
    votes = f"votes {grounding.ballot.votes[i]} of {grounding.similarity.shape[1]}"
    return f"#{i} {score:.2f} · {votes} · cos {mean_cosines(grounding)[i]:.2f}"


def _top_label(grounding: Grounding, i: int, yours: int | None) -> str:
    """The label of the candidate on top: the ballot's words when it was elected."""
    label = _long_label(grounding, i)
    if i == grounding.ballot.winner:
        label = f"#{i} {describe_ballot(grounding)}"
    if yours is None or i != grounding.winner:
        return label
    return f"{RIGHT_MARK if i == yours else WRONG_MARK} {label}"


def _candidate_numbers(grounding: Grounding) -> rr.AnyValues:
    """Everything that the vote compared, and its result; -1 stands for no candidate."""
    boxes, ballot = grounding.candidates, grounding.ballot
    numbers: dict[str, Any] = {}
    if grounding.threshold is not None:
        numbers["threshold"] = grounding.threshold
    if len(boxes):
        numbers |= {
            "score": boxes.score,
            "xyxy": boxes.xyxy.reshape(-1),
            "votes": ballot.votes,
            "tied": ballot.tied,
            "mean_cosine": mean_cosines(grounding),
            "similarity": grounding.similarity.reshape(-1),
            "likeness": grounding.likeness,
        }
        if boxes.prior is not None:
            numbers["prior"] = boxes.prior
        if boxes.verified is not None and boxes.proof is not None:
            numbers |= {"verified": boxes.verified, "proof": boxes.proof}
    return rr.AnyValues(
        phrase=boxes.phrase,
        object=grounding.object,
        winner=_number(grounding.winner),
        references=np.int64(grounding.similarity.shape[1]),
        margin=ballot.margin,
        elected=_number(ballot.winner),
        cosine_margin=ballot.cosine_margin,
        rejected=_number(grounding.rejected),
        **numbers,
    )


def _number(candidate: int | None) -> np.int64:
    return np.int64(-1 if candidate is None else candidate)
