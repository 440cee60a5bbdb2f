"""Candidates of a view: boxes, checked rows of the encoder, and local features."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int64

from vap_core.base.errors import BadEncoder, BadPart
from vap_core.base.types import Boxes, PersonalObject, Rgb, Track, Views, kind_of, value
from vap_core.perception.boxes import box_iou, crop
from vap_core.perception.protocols import (
    Detector,
    Encoder,
    FamiliarityJudge,
    Segmenter,
    Stack,
    Tracker,
    Verifier,
)

LENGTH_TOLERANCE = 1e-3
"""How far from 1 an embedding's length may be."""


def embed_crops(what: str, encoder: Encoder, crops: Sequence[Rgb]) -> Float32[np.ndarray, "n d"]:
    """The rows of an encoder, as the protocol has them; their numbers may be any.

    Raises: BadEncoder: they are no NumPy array of type float32 with one row a crop; the message
        begins with `what`.
    """
    rows = encoder(crops)
    kind = kind_of(rows)
    if kind.startswith("ndarray float32 (") and rows.ndim == 2 and len(rows) == len(crops):
        return rows
    fault = f"{kind}, not ndarray float32 ({len(crops)} crops, width)"
    raise BadEncoder(describe_fault(what, encoder, fault))


def row_fault(rows: Float32[np.ndarray, "n _d"], references: Float32[np.ndarray, "k _e"]) -> str:
    """What is wrong with the rows of crops, "" where nothing is."""
    if rows.shape[1] != references.shape[1]:
        return f"{rows.shape[1]} numbers a crop, and {references.shape[1]} for the references"
    if not np.isfinite(rows).all():
        return "numbers that are not finite"
    length = np.linalg.norm(rows, axis=1)
    far = np.abs(length - 1) > LENGTH_TOLERANCE
    return f"a row of length {length[far][0]:.3g}, not of length 1" if far.any() else ""


def describe_fault(what: str, part: object, fault: str, role: str = "encoder") -> str:
    """The line about a part of a stack that gave `fault` when `what` asked it."""
    name = getattr(part, "name", type(part).__name__)
    return (
        f"{what}: {role} {name!r} gave {fault}; test it with "
        f"pytest --pyargs vap_core.contracts --{role} MODULE:NAME."
    )


MOST_CANDIDATES = 4
"""Proposals that are kept as candidates, unless more have votes. Each is segmented."""
SAME_BOX_IOU = 0.7
"""Boxes of two phrases that overlap by more than this IoU are the same object."""


def detect(
    detector: Detector, images: Sequence[Rgb], phrase: str, threshold: float | None = None
) -> list[Boxes]:
    """What a detector finds, as the protocol has it. Raises: BadPart."""
    found = detector(images, phrase, threshold)
    fits = isinstance(found, list | tuple) and len(found) == len(images)
    for boxes, image in zip(found if fits else (), images, strict=False):
        h, w = image.shape[:2]
        within = isinstance(boxes, Boxes) and boxes.xyxy * (1, 1, -1, -1) < (w, h, 0, 0)
        fits = fits and bool(np.all(within))
    if fits:
        return list(found)
    fault = f"{' '.join(repr(found).split()):.200}, not Boxes inside each of {len(images)} views"
    raise BadPart(describe_fault("detect", detector, fault, "detector"))


def draw_masks(segmenter: Segmenter, image: Rgb, boxes: Boxes) -> Bool[np.ndarray, "n h w"]:
    """The segmenter's masks, as the protocol has them. Raises: BadPart."""
    masks = segmenter(image, boxes)
    wanted = f"ndarray bool {(len(boxes), *image.shape[:2])}"
    if kind_of(masks) == wanted:
        return masks
    fault = f"{kind_of(masks)}, not {wanted}"
    raise BadPart(describe_fault("segment", segmenter, fault, "segmenter"))


def follow(
    tracker: Tracker, states: Sequence[Any], images: Sequence[Rgb]
) -> tuple[list[Any], list[tuple[Track, ...]]]:
    """The tracker's step, as the protocol has it. Raises: BadPart."""
    states, tracks = tracker.step(states, images)
    for of_view, image in zip(tracks, images, strict=True):
        wanted = f"ndarray bool {image.shape[:2]}"
        for mask in (track.mask for track in of_view):
            if mask is not None and kind_of(mask) != wanted:
                fault = f"{kind_of(mask)} as a mask, not {wanted}"
                raise BadPart(describe_fault("step", tracker, fault, "tracker"))
    return list(states), list(tracks)


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
    detected = detect(stack.detector, list(views.values()), phrase)
    return embed_views(views, dict(zip(views, detected, strict=True)), stack)


def embed_views(views: Views, boxes: Mapping[str, Boxes], stack: Stack) -> dict[str, Proposals]:
    """The boxes of every view, embedded.

    Cameras of one robot see one world: where one view is familiar all are, so that all are embedded
    by one encoder.
    """
    familiar = any(of_view.familiar for of_view in boxes.values())
    return {
        camera: embed(rgb, replace(boxes[camera], familiar=familiar), stack)
        for camera, rgb in views.items()
    }


def judge(rgb: Rgb, boxes: Boxes, phrase: str, stack: Stack) -> Boxes:
    """Boxes given by hand, with whether their picture is familiar."""
    if isinstance(stack.detector, FamiliarityJudge):
        return replace(boxes, familiar=stack.detector.is_familiar(rgb, phrase))
    return boxes


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
    masks = draw_masks(stack.segmenter, rgb, boxes)
    return Candidates(boxes, proposals.embeddings, masks, _assign_ids(boxes, known))


def masks_by_id(parts: Sequence[Candidates]) -> Bool[np.ndarray, "n h w"]:
    """One mask per identity of a view, in the order of identities."""
    masks = np.concatenate([part.masks for part in parts])
    _, first_rows = np.unique([i for part in parts for i in part.ids], return_index=True)
    return masks[first_rows]


def _assign_ids(boxes: Boxes, known: Sequence[Candidates]) -> tuple[int, ...]:
    """A known identity for each box that is known already, the next free one for every other."""
    known_xyxy = np.concatenate([np.zeros((0, 4), np.float32), *(c.boxes.xyxy for c in known)])
    known_ids = [i for part in known for i in part.ids]
    next_id = 1 + max(known_ids, default=-1)
    ids: list[int] = []
    for overlap in box_iou(boxes.xyxy, known_xyxy):
        if len(known_xyxy) and overlap.max() > SAME_BOX_IOU:
            ids.append(known_ids[int(overlap.argmax())])
        else:
            ids.append(next_id)
            next_id += 1
    return tuple(ids)


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
