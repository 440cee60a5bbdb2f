"""Two parts of the method apart from the rest: masks from true boxes, and photos of one object."""

from collections.abc import Mapping
from itertools import combinations
from typing import Any

import numpy as np

from vap_core.base.errors import BadPhotoSet
from vap_core.base.photos import load_mask, load_photo
from vap_core.base.types import Boxes, PersonalObject
from vap_core.evaluation.photos.folder import Scene
from vap_core.evaluation.photos.measure import clip_boxes, judge
from vap_core.memory import reference_rows
from vap_core.perception.boxes import mask_iou
from vap_core.perception.protocols import Stack
from vap_core.vote import similarity, vote

CHOSEN = 3
"""References that elect a left-out photo."""
TRIALS = 500
"""Elections of one object, drawn with seed 0."""
Row = dict[str, Any]


def mask_rows(scene: Scene, stack: Stack) -> list[Row]:
    """The IoU of the stack's mask from the true box with the true mask, a row per given mask.

    Raises: BadPhoto, BadPhotoSet: a mask cannot be read, or is not as large as its scene; or as
        `clip_boxes`.
    """
    if not scene.masks:
        return []
    rgb = load_photo(scene.path, long_side=None)
    names = sorted(scene.masks)
    true_boxes = clip_boxes(scene, rgb).boxes
    xyxy = np.concatenate([true_boxes[name] for name in names])
    boxes = Boxes(xyxy, np.ones(len(xyxy), np.float32), "true boxes")
    found = stack.segmenter(rgb, judge(rgb, boxes, stack))
    rows: list[Row] = []
    for name, mask in zip(names, found, strict=True):
        truth = load_mask(scene.masks[name])
        if truth.shape != mask.shape:
            raise BadPhotoSet(
                f"measure photos: the mask {scene.masks[name]} has "
                f"{truth.shape[1]}x{truth.shape[0]} pixels, its scene "
                f"{mask.shape[1]}x{mask.shape[0]}; save it as large as the upright photo."
            )
        rows.append({"scene": scene.name, "object": name, "mask_iou": mask_iou(mask, truth)})
    return rows


def single_rows(memory: Mapping[str, PersonalObject], stack: Stack) -> list[Row]:
    """Whether three references elect a left-out photo of their object among photos of two others.

    All are cut as they were registered. Rivals are of the object's kind where two of it are known.
    A row per election; none of an object with fewer than four references, or without two rivals.
    """
    encoder = stack.unfamiliar_encoder or stack.encoder
    rows_of = {name: reference_rows(obj, encoder) for name, obj in memory.items()}
    rows: list[Row] = []
    for name, own in rows_of.items():
        kind = memory[name].category
        others = [other for other in memory if other != name]
        alike = [other for other in others if memory[other].category == kind]
        if len(alike) >= 2:
            others = alike
        if len(own) <= CHOSEN or len(others) < 2:
            continue
        rng = np.random.default_rng(0)
        chosen = list(combinations(range(len(own)), CHOSEN))
        pairs = list(combinations(others, 2))
        for _ in range(TRIALS):
            references = list(chosen[int(rng.integers(len(chosen)))])
            left_out = np.setdiff1d(np.arange(len(own)), references)
            candidates = [own[int(rng.choice(left_out))]]
            for rival in pairs[int(rng.integers(len(pairs)))]:
                candidates.append(rows_of[rival][int(rng.integers(len(rows_of[rival])))])
            cosine = similarity(np.stack(candidates), own[references])
            rows.append({"object": name, "right": vote(cosine).winner == 0})
    return rows
