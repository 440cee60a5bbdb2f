"""The vote of one target in one view, and what the views agreed on."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr

from vap_core.base.events import describe_ballot
from vap_core.base.palette import RIGHT_MARK, WRONG_MARK, Rgb8
from vap_core.base.types import Association, Grounding
from vap_core.recording.colours import ELECTED, MUTED
from vap_core.recording.entities.images import jpeg_image
from vap_core.recording.entities.labels import place_labels
from vap_core.recording.entities.paths import image_root, target_suffix
from vap_core.recording.stream import log_row

WINNER_RADIUS_PT, OTHER_RADIUS_PT = 2.5, 1.2


def log_vote(
    rec: rr.RecordingStream,
    grounding: Grounding,
    j: int,
    jpeg: np.ndarray | None,
    at: Sequence[rr.TimeColumn],
    right: bool | None = None,
    again: bool = False,
) -> None:
    """The vote of target j in one view: labelled boxes over the picture, and numbers.

    `right` says whether it elected the target, where that is known. Where it is held `again`, for
    another sub-goal, a vote without candidates takes the boxes of the one before away.
    """
    name = f"{grounding.camera}{target_suffix(j)}"
    order = _drawing_order(grounding)
    entity = f"{image_root(grounding.camera)}/candidates{target_suffix(j)}"
    if jpeg is not None:
        log_row(rec, entity, jpeg_image(jpeg), at=at)
    if order:
        _log_boxes(rec, entity, grounding, order, at, right)
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
    right: bool | None,
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
    labels[-1] = _top_label(grounding, order[-1], right)
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


def _top_label(grounding: Grounding, i: int, right: bool | None) -> str:
    """The label of the candidate on top: the ballot's words when it was elected."""
    label = _long_label(grounding, i)
    if i == grounding.ballot.winner:
        label = f"#{i} {describe_ballot(grounding)}"
    if right is None or i != grounding.winner:
        return label
    return f"{RIGHT_MARK if right else WRONG_MARK} {label}"


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
