"""How good the trained heads are on generic instances they never saw; every share comes with its n and 95 % Wilson interval."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from tqdm import tqdm

from vap_core.evaluation.metrics import rate
from vap_core.evaluation.perception.estimates import average_precision
from vap_core.evaluation.perception.first_frames import FLOOR, LEAST_PX
from vap_core.perception.boxes import box_iou, crop, mask_iou
from vap_core.perception.embedded.backbone import features
from vap_core.perception.embedded.detector import (
    TAPS,
    THRESHOLD,
    DetectHead,
    LiteDetector,
    decode,
    resize_for_search,
)
from vap_core.perception.embedded.encoder import InstanceHead, LiteEncoder
from vap_core.perception.embedded.segmenter import LiteSegmenter, MaskHead
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.phrases import AMBIGUOUS, NEGATIVES, UNSEEN, UNSEEN_NEGATIVES
from vap_core.training.films.scenes import POSES, Shots, boxes_of
from vap_core.training.perception.segmenter import jitter
from vap_core.vote import similarity, vote

Figures = dict[str, Any]
Found = tuple[np.ndarray, np.ndarray]
"""Boxes (image pixels) and scores, best first."""


def evaluate(
    detect: DetectHead, segment: MaskHead, look: InstanceHead, stages: Sequence[Shots]
) -> Figures:
    """Every figure that the manifest carries."""
    return {
        "detector": detector_figures(LiteDetector(detect), stages),
        "segmenter": segmenter_figures(LiteSegmenter(segment), stages),
        "encoder": {
            "with_look_head": encoder_figures(LiteEncoder(look), stages),
            "frozen_features_alone": encoder_figures(LiteEncoder(), stages),
        },
    }


def share(hits: int, n: int) -> Figures:
    if n == 0:
        return {"value": None, "n": 0, "low": 0.0, "high": 1.0}
    found = rate(hits, n)
    return {
        "value": round(found.value, 4),
        "n": n,
        "low": round(found.low, 4),
        "high": round(found.high, 4),
    }


def detector_figures(detector: LiteDetector, stages: Sequence[Shots]) -> Figures:
    """Average precision, recall of the ten best boxes, false alarms on absent kinds; with trained, unseen and absent phrases."""
    kinds = objects.CATEGORIES + objects.CLUTTER
    snapped = {phrase: detector.embed_phrase(phrase) for phrase in _all_phrases(kinds)}
    plain = {
        phrase: LiteDetector(detector.head, snap=None).embed_phrase(phrase) for phrase in snapped
    }
    results: list[
        tuple[Mapping[str, Found], Mapping[str, Found], Mapping[str, np.ndarray], np.ndarray]
    ] = []
    for image, truth, small in tqdm(_views(stages), desc="evaluating", mininterval=10):
        results.append(
            (_detect(detector, image, snapped), _detect(detector, image, plain), truth, small)
        )

    def ap(way: Literal[0, 1], phrase: str, kind: str, mask_iou: float = 0.5) -> float | None:
        return precision_of_views(
            [(r[way][phrase], *_split(r[2], r[3], kind)) for r in results], mask_iou
        )

    def mean(values: Iterator[float | None]) -> float:
        return round(float(np.mean([value for value in values if value is not None])), 4)

    def false_alarms(phrases: Sequence[str], absent_only: bool) -> Figures:
        asked = [
            r[0][phrase][1]
            for r in results
            for phrase in phrases
            if not (absent_only and _present(r[2], phrase))
        ]
        return share(sum(bool((score >= THRESHOLD).any()) for score in asked), len(asked))

    wanted = [(r[0][kind], box) for r in results for kind in kinds for box in r[2].get(kind, ())]
    found = sum(
        len(boxes) > 0 and box_iou(box[None], boxes).max() >= 0.5 for (boxes, _), box in wanted
    )
    sure = sum(
        bool(((box_iou(box[None], boxes)[0] >= 0.5) & (score >= THRESHOLD)).any())
        for (boxes, score), box in wanted
        if len(boxes)
    )
    unseen = [(kind, phrase) for kind in kinds for phrase in UNSEEN.get(kind, ())]
    return {
        "views": len(results),
        "ap50": mean(ap(0, kind, kind) for kind in kinds),
        "ap75": mean(ap(0, kind, kind, 0.75) for kind in kinds),
        "ap50_by_category": {kind: ap(0, kind, kind) for kind in kinds},
        "recall_at_10": share(int(found), len(wanted)),
        "recall_at_threshold": share(int(sure), len(wanted)),
        "threshold": THRESHOLD,
        "false_alarm_absent_category": false_alarms(kinds, True),
        "false_alarm_unseen_negative": false_alarms(UNSEEN_NEGATIVES, False),
        "false_alarm_trained_negative": false_alarms(NEGATIVES[:10], False),
        "ap50_unseen_phrase": mean(ap(0, phrase, kind) for kind, phrase in unseen),
        "ap50_unseen_phrase_without_snapping": mean(ap(1, phrase, kind) for kind, phrase in unseen),
        "ap50_by_unseen_phrase": {phrase: ap(0, phrase, kind) for kind, phrase in unseen},
    }


def segmenter_figures(segmenter: LiteSegmenter, stages: Sequence[Shots]) -> Figures:
    """Mask IoU from the exact box and from one whose edges are off by up to 8 %."""
    rng = np.random.default_rng(0)
    exact: list[float] = []
    off: list[float] = []
    for shots in tqdm(stages, desc="evaluating masks", mininterval=10):
        for rgb, ids in zip(shots.rgb, shots.ids, strict=True):
            for i, corners in boxes_of(ids, len(shots.names), LEAST_PX):
                box = np.array(corners, np.float64)
                for where, into in ((box, exact), (jitter(rng, box), off)):
                    into.append(
                        mask_iou(
                            segmenter.mask_probability(rgb, where[None])[0] > 0.5, ids == i + 1
                        )
                    )
    return {
        f"{name}_box": {
            "mean_iou": round(float(np.mean(values)), 4),
            "iou_at_least_0.75": share(int(np.sum(np.array(values) >= 0.75)), len(values)),
        }
        for name, values in (("exact", exact), ("jittered", off))
    }


def encoder_figures(encoder: LiteEncoder, stages: Sequence[Shots]) -> Figures:
    """How often three reference photos of an object elect its box in a view from among the boxes of its look-alikes there."""
    right: list[bool] = []
    for shots in tqdm(stages, desc="evaluating looks", mininterval=10):
        portraits = [crop(rgb, np.array(box, np.float64)) for rgb, ids in zip(shots.portraits, shots.portrait_ids, strict=True)
                     for _, box in boxes_of(ids, len(shots.names))]  # fmt: skip
        crew, references = len(shots.portraits) // POSES, encoder(portraits)
        for rgb, ids in zip(shots.rgb, shots.ids, strict=True):
            seen = list(boxes_of(ids, crew, LEAST_PX))
            if len(seen) > 1:
                rows = encoder([crop(rgb, np.array(box, np.float64)) for _, box in seen])
                right += [
                    vote(similarity(rows, references[POSES * i : POSES * (i + 1)])).winner == me
                    for me, (i, _) in enumerate(seen)
                ]
    return {"right_of_look_alikes": share(sum(right), len(right))}


def precision_of_views(
    per_view: Sequence[tuple[Found, np.ndarray, np.ndarray]], mask_iou: float
) -> float | None:
    """Area under the interpolated precision-recall curve, over (found, wanted, ignored) of every view; None when nothing is wanted."""
    total = sum(len(wanted) for _, wanted, _ in per_view)
    marks: list[tuple[float, bool]] = []
    for (boxes, score), wanted, ignored in per_view:
        free = np.ones(len(wanted), bool)
        for box, value in zip(boxes, score, strict=True):
            overlap = (
                np.where(free, box_iou(box[None], wanted)[0], 0) if len(wanted) else np.zeros(1)
            )
            if overlap.max() >= mask_iou:
                free[overlap.argmax()] = False
                marks.append((float(value), True))
            elif not len(ignored) or box_iou(box[None], ignored).max() < 0.5:
                marks.append((float(value), False))
    if total == 0:
        return None
    score, hit = (
        np.array([score for score, _ in marks], np.float64),
        np.array([right for _, right in marks], bool),
    )
    return round(average_precision(score, hit, float(total)), 4)


def _all_phrases(kinds: Sequence[str]) -> list[str]:
    return list(
        dict.fromkeys(
            [
                *kinds,
                *(phrase for kind in kinds for phrase in UNSEEN.get(kind, ())),
                *NEGATIVES[:10],
                *UNSEEN_NEGATIVES,
            ]
        )
    )


def _views(
    stages: Sequence[Shots],
) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]]:
    """Picture, boxes by kind, and boxes too small to count."""
    for shots in stages:
        for rgb, ids in zip(shots.rgb, shots.ids, strict=True):
            truth: dict[str, list[tuple[int, int, int, int]]] = {}
            for i, box in boxes_of(ids, len(shots.names), LEAST_PX):
                truth.setdefault(shots.categories[i], []).append(box)
            large = {i for i, _ in boxes_of(ids, len(shots.names), LEAST_PX)}
            small = [box for i, box in boxes_of(ids, len(shots.names), 1) if i not in large]
            yield (
                rgb,
                {kind: np.array(boxes, np.float64) for kind, boxes in truth.items()},
                np.array(small, np.float64).reshape(-1, 4),
            )


def _split(
    truth: Mapping[str, np.ndarray], small: np.ndarray, kind: str
) -> tuple[np.ndarray, np.ndarray]:
    """Boxes wanted of `kind`, and boxes whose detection does not count."""
    ignored = [truth[other] for other in AMBIGUOUS.get(kind, ()) if other in truth]
    return truth.get(kind, np.zeros((0, 4))), np.concatenate([small, *ignored])


def _present(truth: Mapping[str, np.ndarray], kind: str) -> bool:
    return any(other in truth for other in (kind, *AMBIGUOUS.get(kind, ())))


@torch.inference_mode()
def _detect(
    detector: LiteDetector, image: np.ndarray, rows: Mapping[str, np.ndarray]
) -> dict[str, Found]:
    """Every phrase at once, down to `FLOOR`."""
    small, scale = resize_for_search(image)
    logits, edges = detector.head(
        features([small], TAPS), torch.from_numpy(np.concatenate(list(rows.values())))
    )
    found = {}
    for phrase, scores in zip(rows, logits[0], strict=True):
        xyxy, score = decode(scores, edges[0], FLOOR)
        found[phrase] = np.clip(xyxy / scale, 0, max(image.shape)).astype(np.float64), score
    return found
