"""What a view offers to the vote: proposals of one phrase, and the candidates of one target.

Identities are the indices that the view's tracker gives to what it follows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Int64

from vap_core.base.types import Boxes, Rgb, Views, value
from vap_core.perception.boxes import box_iou, crop
from vap_core.perception.protocols import Stack
from vap_core.perception.rows import embed_crops

SAME_BOX_IOU = 0.7
"""Boxes of two phrases that overlap by more than this IoU are the same object."""


@value
class Proposals:
    """The boxes that a detector proposed for one phrase in one view, and their embeddings."""

    boxes: Boxes
    embeddings: Float32[np.ndarray, "n d"]

    def take(self, rows: Int64[np.ndarray, " m"]) -> "Proposals":
        """These of them, in this order."""
        return Proposals(self.boxes.take(rows), self.embeddings[rows])


@value
class Candidates:
    """Candidate i has identity `ids[i]` in its view's tracker."""

    boxes: Boxes
    embeddings: Float32[np.ndarray, "n d"]
    masks: Bool[np.ndarray, "n h w"]
    ids: tuple[int, ...]


def propose(views: Views, phrase: str, stack: Stack) -> dict[str, Proposals]:
    """What the detector proposes for a phrase in every view, embedded."""
    detected = stack.detector(list(views.values()), phrase)
    return embed_views(views, dict(zip(views, detected, strict=True)), stack)


def embed_views(views: Views, boxes: Mapping[str, Boxes], stack: Stack) -> dict[str, Proposals]:
    """The boxes of every view, embedded.

    Cameras of one robot see one world: where one view is familiar all are, so that all are embedded
    by one encoder.
    """
    familiar = any(of_view.familiar for of_view in boxes.values())
    proposals = {}
    for camera, rgb in views.items():
        proposals[camera] = embed(rgb, replace(boxes[camera], familiar=familiar), stack)
    return proposals


def embed(rgb: Rgb, boxes: Boxes, stack: Stack) -> Proposals:
    """The embeddings of every box of one view. Raises: BadEncoder, as `embed_crops` does."""
    crops = [crop(rgb, box) for box in boxes.xyxy]
    return Proposals(boxes, embed_crops("embed", stack.encoder_of(boxes), crops))


def segment(
    rgb: Rgb, proposals: Proposals, stack: Stack, known: Sequence[Candidates] = ()
) -> Candidates:
    """The masks of all proposals.

    A box that is a candidate for an earlier target too keeps its identity.
    """
    boxes = proposals.boxes
    masks = stack.segmenter(rgb, boxes)
    return Candidates(boxes, proposals.embeddings, masks, _assign_ids(boxes, known))


def masks_by_id(parts: Sequence[Candidates]) -> Bool[np.ndarray, "n h w"]:
    """One mask per identity of a view, in the order of identities."""
    masks = np.concatenate([part.masks for part in parts])
    first_rows: dict[int, int] = {}
    for row, identity in enumerate(_ids(parts)):
        first_rows.setdefault(identity, row)
    return masks[[first_rows[identity] for identity in sorted(first_rows)]]


def _ids(parts: Sequence[Candidates]) -> list[int]:
    """The identities of several phrases' candidates, one after the other."""
    ids: list[int] = []
    for part in parts:
        ids += part.ids
    return ids


def _assign_ids(boxes: Boxes, known: Sequence[Candidates]) -> tuple[int, ...]:
    """A known identity for each box that is known already, the next free one for every other."""
    known_xyxy = np.concatenate([np.zeros((0, 4), np.float32), *(c.boxes.xyxy for c in known)])
    known_ids = _ids(known)
    next_id = 1 + max(known_ids, default=-1)
    ids: list[int] = []
    for overlap in box_iou(boxes.xyxy, known_xyxy):
        if len(known_xyxy) and overlap.max() > SAME_BOX_IOU:
            ids.append(known_ids[int(overlap.argmax())])
        else:
            ids.append(next_id)
            next_id += 1
    return tuple(ids)
