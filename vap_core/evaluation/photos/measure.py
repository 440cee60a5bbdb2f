"""What the method does with the scenes of a photo set, one row per scene and object.

A row has the elected box against the true ones, and the vote when the true boxes of the scene are
the candidates.
"""

from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter, process_time
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from vap_core.attend import Attender
from vap_core.base.errors import BadPhotoSet
from vap_core.base.photos import load_photo
from vap_core.base.types import Boxes, Grounding, PersonalObject, Rgb
from vap_core.evaluation.photos.folder import PhotoSet, Scene
from vap_core.perception.boxes import box_iou
from vap_core.perception.candidates import Candidates, Proposals, embed, segment
from vap_core.perception.proof import prove
from vap_core.perception.protocols import FamiliarityJudge, Stack

CAMERA = "photo"
BEYOND_PX = 4
"""How far a box that is drawn by hand may reach beyond its photo; it is clipped."""
Row = dict[str, Any]
Memory = Mapping[str, PersonalObject]


def measure_scene(
    scene: Scene, photo_set: PhotoSet, memory: Memory, attender: Attender
) -> list[Row]:
    """One row for every remembered object that the scene's lines name.

    Raises: BadPhoto when the photo cannot be read; BadPhotoSet, as `clip_boxes`.
    """
    rgb = load_photo(scene.path, long_side=None)
    scene = clip_boxes(scene, rgb)
    true_boxes, owners = _true_boxes(scene)
    candidates = _candidates(rgb, true_boxes, attender.stack)
    rows = []
    for name, boxes in scene.boxes.items():
        if name not in memory:
            continue
        category = photo_set.categories[name]
        kinds = [photo_set.categories[owner] for owner in owners]
        own = np.array([owner == name for owner in owners], bool)
        same_kind = np.array([kind == category for kind in kinds], bool)
        row: Row = {
            "scene": scene.name,
            "object": name,
            "category": category,
            "present": len(boxes) > 0,
            "lookalikes": int((same_kind & ~own).sum()),
        }
        row |= _ground(rgb, boxes, memory[name], attender)
        if len(boxes):
            every = np.ones(len(own), bool)
            row |= _vote("all", own, every, candidates, memory[name], attender, rgb)
            row |= _vote("kind", own, same_kind, candidates, memory[name], attender, rgb)
        rows.append(row)
    return rows


def clip_boxes(scene: Scene, rgb: Rgb) -> Scene:
    """The scene with its boxes clipped to its photo.

    Raises: BadPhotoSet: a box lies outside the photo, or reaches more than BEYOND_PX beyond it.
    """
    height, width = rgb.shape[:2]
    clipped = {}
    for name, boxes in scene.boxes.items():
        clipped[name] = np.clip(boxes, 0, (width, height, width, height)).astype(np.float32)
        for box, inside in zip(boxes, clipped[name], strict=True):
            flaw = ""
            if abs(box - inside).max() > BEYOND_PX:
                flaw = "reaches beyond"
            if (inside[2:] - inside[:2] < 1).any():
                flaw = "lies outside"
            if flaw:
                raise BadPhotoSet(
                    f"measure photos: the box {box.tolist()} of {name!r} {flaw} {scene.path}, "
                    f"which has {width}x{height} pixels when upright; mend scenes.csv."
                )
    return replace(scene, boxes=clipped)


def _true_boxes(scene: Scene) -> tuple[Boxes, list[str]]:
    """Every box of the scene, and whose it is."""
    every = [np.zeros((0, 4), np.float32)]
    owners = []
    for name, boxes in scene.boxes.items():
        every.append(boxes)
        owners += [name] * len(boxes)
    xyxy = np.concatenate(every)
    return Boxes(xyxy, np.ones(len(xyxy), np.float32), "true boxes"), owners


def _candidates(rgb: Rgb, boxes: Boxes, stack: Stack) -> Candidates:
    """The true boxes, embedded as boxes of such a photo are, and their masks."""
    judged = judge(rgb, boxes, stack)
    return segment(rgb, embed(rgb, judged, stack), stack)


def judge(rgb: Rgb, boxes: Boxes, stack: Stack) -> Boxes:
    """Boxes given by hand, with whether their picture is familiar."""
    if isinstance(stack.detector, FamiliarityJudge):
        return replace(boxes, familiar=stack.detector.is_familiar(rgb, boxes.phrase))
    return boxes


def _ground(
    rgb: Rgb, boxes: Float32[np.ndarray, "_ 4"], obj: PersonalObject, attender: Attender
) -> Row:
    """The method's first step on the photo, and how its choice overlaps the true boxes."""
    started, cpu_started = perf_counter(), process_time()
    instruction = f"bring my {obj.category}"
    _, attended = attender.start({CAMERA: rgb}, instruction, objects=[obj.name])
    seconds, cpu_seconds = perf_counter() - started, process_time() - cpu_started
    (grounding,) = attended.groundings[CAMERA]
    overlap = box_iou(grounding.candidates.xyxy, boxes).max(axis=1, initial=0.0)
    row: Row = {
        "candidates": len(overlap),
        "proposed_iou": float(overlap.max(initial=0.0)),
        "tinted": grounding.winner is not None,
        "verified": _points(grounding),
        "familiar": grounding.candidates.familiar,
        "iou": 0.0,
        "ms": round(1000 * seconds, 1),
        "cpu_ms": round(1000 * cpu_seconds, 1),
        **_elected(grounding, overlap),
    }
    if grounding.winner is not None:
        row["iou"] = float(overlap[grounding.winner])
    return row


def _points(grounding: Grounding) -> int | None:
    """The verified points of the elected box; None where none were compared."""
    if grounding.chosen is None or grounding.candidates.verified is None:
        return None
    return int(grounding.candidates.verified[grounding.chosen])


def _elected(grounding: Grounding, overlap: Float[np.ndarray, " n"]) -> Row:
    """The box that the vote elected, tinted or not; None without candidates."""
    winner = grounding.chosen
    if winner is None:
        names = ("x0", "y0", "x1", "y1", "cosine", "likeness", "chosen_iou", "margin")
        return dict.fromkeys(names)
    x0, y0, x1, y1 = grounding.candidates.xyxy[winner].tolist()
    return {
        "x0": x0,
        "y0": y0,
        "x1": x1,
        "y1": y1,
        "cosine": float(grounding.similarity[winner].mean()),
        "likeness": float(grounding.likeness[winner]),
        "chosen_iou": float(overlap[winner]),
        "margin": grounding.ballot.margin,
    }


def _vote(
    among: str,
    own: Bool[np.ndarray, " n"],
    eligible: Bool[np.ndarray, " n"],
    candidates: Candidates,
    obj: PersonalObject,
    attender: Attender,
    rgb: Rgb,
) -> Row:
    """How the vote does among true boxes: with all references, and with each of them alone.

    The values are None where the object has no rival among them.
    """
    names = (f"{among}_boxes", f"{among}_one", f"{among}_every")
    rows = np.flatnonzero(eligible)
    if own[rows].all():
        return dict.fromkeys(names)
    among_them = _take(candidates, rows)
    right_alone = []
    for k in range(len(obj.crops)):
        elected = _elect(rgb, obj.take(slice(k, k + 1)), among_them, attender)
        right_alone.append(bool(own[rows[elected]]))
    elected = _elect(rgb, obj, among_them, attender)
    return {
        names[0]: len(rows),
        names[1]: float(np.mean(right_alone)),
        names[2]: bool(own[rows[elected]]),
    }


def _elect(rgb: Rgb, obj: PersonalObject, among: Candidates, attender: Attender) -> int:
    """The candidate that the method elects, points compared as in any such photo."""
    verifier = attender.stack.verifier
    if verifier is not None and not among.boxes.familiar:
        proved = prove(rgb, obj, Proposals(among.boxes, among.embeddings), verifier)
        among = replace(among, boxes=proved.boxes)
    winner = attender.ground(CAMERA, obj, among).ballot.winner
    assert winner is not None, "there are candidates"
    return winner


def _take(candidates: Candidates, rows: Int64[np.ndarray, " m"]) -> Candidates:
    """These candidates, in this order."""
    return Candidates(
        boxes=candidates.boxes.take(rows),
        embeddings=candidates.embeddings[rows],
        masks=candidates.masks[rows],
        ids=tuple(range(len(rows))),
    )
