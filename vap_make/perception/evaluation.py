"""How good the trained heads are on generic instances they never saw.

Every share comes with its n and its 95 % Wilson interval.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from vap_core.base.types import value
from vap_core.perception.boxes import box_iou, crop, mask_iou
from vap_core.perception.embedded.encoder import LiteEncoder
from vap_core.perception.embedded.proposer import THRESHOLD, LiteDetector, decode, resize_for_search
from vap_core.perception.embedded.segmenter import LiteSegmenter
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.phrases import AMBIGUOUS, UNSEEN
from vap_core.study.perception import FLOOR, VISIBLE_PX, match
from vap_core.study.stats import average_precision, rate
from vap_core.vote import similarity, vote
from vap_make.films.scenes import POSES, Shots, boxes_of
from vap_make.perception.backbone import TorchNetwork
from vap_make.perception.graphs import (
    DetectHead,
    DetectNetwork,
    EncodeNetwork,
    InstanceHead,
    MaskHead,
    MaskNetwork,
)
from vap_make.perception.phrases import NEGATIVES, UNSEEN_NEGATIVES
from vap_make.perception.segmenter import jitter

TRAINED_NEGATIVES = NEGATIVES[:10]
"""Those of the trained phrases without an object that are measured."""

Figures = dict[str, Any]
Found = tuple[np.ndarray, np.ndarray]
"""Boxes (image pixels) and scores, best first."""


@value
class View:
    """A picture, its boxes by category, and boxes too small to count."""

    rgb: np.ndarray
    truth: Mapping[str, np.ndarray]
    small: np.ndarray


@value
class Detections:
    """What was found in a view, by phrase: with snapping to trained phrases, and without."""

    snapped: Mapping[str, Found]
    plain: Mapping[str, Found]
    view: View


def evaluate(
    detect: DetectHead, segment: MaskHead, look: InstanceHead, stages: Sequence[Shots]
) -> Figures:
    """Every figure that the manifest carries."""
    detector = LiteDetector(TorchNetwork(DetectNetwork(detect)), detect.known.numpy())
    segmenter = LiteSegmenter(TorchNetwork(MaskNetwork(segment)))
    encoder = LiteEncoder(TorchNetwork(EncodeNetwork(look)))
    frozen = LiteEncoder(TorchNetwork(EncodeNetwork(None)), has_head=False)
    return {
        "detector": detector_figures(detector, stages),
        "segmenter": segmenter_figures(segmenter, stages),
        "encoder": {
            "with_look_head": encoder_figures(encoder, stages),
            "frozen_features_alone": encoder_figures(frozen, stages),
        },
    }


def share(hits: int, n: int) -> Figures:
    """A share with its n and interval; `value` is None where n is 0."""
    if n == 0:
        return {"value": None, "n": 0, "low": 0.0, "high": 1.0}
    estimate = rate(hits, n)
    return {
        "value": round(estimate.value, 4),
        "n": n,
        "low": round(estimate.low, 4),
        "high": round(estimate.high, 4),
    }


def detector_figures(detector: LiteDetector, stages: Sequence[Shots]) -> Figures:
    """Average precision, recall and false alarms, with trained, unseen and absent phrases.

    Recall is of the ten best boxes; false alarms are on categories that are absent.
    """
    categories = objects.CATEGORIES + objects.CLUTTER
    phrases = _all_phrases(categories)
    snapped = _embed_phrases(detector, phrases)
    plain = _embed_phrases(LiteDetector(detector.network, detector.known, snap=None), phrases)
    results = []
    for view in tqdm(_views(stages), desc="evaluating", mininterval=10):
        found_snapped = _detect(detector, view.rgb, snapped)
        found_plain = _detect(detector, view.rgb, plain)
        results.append(Detections(found_snapped, found_plain, view))
    return {
        "views": len(results),
        **_category_figures(results, categories),
        **_recall_figures(results, categories),
        "threshold": THRESHOLD,
        "false_alarm_absent_category": _absent_false_alarms(results, categories),
        "false_alarm_unseen_negative": _false_alarms(results, UNSEEN_NEGATIVES),
        "false_alarm_trained_negative": _false_alarms(results, TRAINED_NEGATIVES),
        **_unseen_phrase_figures(results, categories),
    }


def segmenter_figures(segmenter: LiteSegmenter, stages: Sequence[Shots]) -> Figures:
    """Mask IoU from the exact box and from one whose edges are off by up to 8 %."""
    rng = np.random.default_rng(0)
    exact: list[float] = []
    jittered: list[float] = []
    for shots in tqdm(stages, desc="evaluating masks", mininterval=10):
        for rgb, ids in zip(shots.rgb, shots.ids, strict=True):
            for i, corners in boxes_of(ids, len(shots.names), VISIBLE_PX):
                box = np.array(corners, np.float64)
                box_off = jitter(rng, box)
                truth = ids == i + 1
                exact.append(_segment_iou(segmenter, rgb, box, truth))
                jittered.append(_segment_iou(segmenter, rgb, box_off, truth))
    return {"exact_box": _iou_figures(exact), "jittered_box": _iou_figures(jittered)}


def encoder_figures(encoder: LiteEncoder, stages: Sequence[Shots]) -> Figures:
    """How often an object's box is elected from among those of its look-alikes in a view.

    Three reference photos of the object vote.
    """
    n_right = 0
    n = 0
    for shots in tqdm(stages, desc="evaluating looks", mininterval=10):
        portraits = []
        for rgb, ids in zip(shots.portraits, shots.portrait_ids, strict=True):
            for _, box in boxes_of(ids, len(shots.names)):
                portraits.append(crop(rgb, np.array(box, np.float64)))
        crew = len(shots.portraits) // POSES
        references = encoder(portraits)
        for rgb, ids in zip(shots.rgb, shots.ids, strict=True):
            seen = list(boxes_of(ids, crew, VISIBLE_PX))
            if len(seen) < 2:
                continue
            rows = encoder([crop(rgb, np.array(box, np.float64)) for _, box in seen])
            for candidate, (i, _) in enumerate(seen):
                of_object = references[POSES * i : POSES * (i + 1)]
                winner = vote(similarity(rows, of_object)).winner
                n_right += winner == candidate
                n += 1
    return {"right_of_look_alikes": share(n_right, n)}


def precision_of_views(
    per_view: Sequence[tuple[Found, np.ndarray, np.ndarray]], mask_iou: float
) -> float | None:
    """Area under the interpolated precision-recall curve; None when nothing is wanted.

    It is over (found, wanted, ignored) of every view; a box is right from `mask_iou` on.
    """
    total = 0
    marked_scores: list[float] = []
    hits: list[bool] = []
    for (boxes, scores), wanted, ignored in per_view:
        total += len(wanted)
        for hit, score in zip(match(boxes, wanted, ignored, at=mask_iou), scores, strict=True):
            if hit is not None:
                marked_scores.append(float(score))
                hits.append(hit)
    if total == 0:
        return None
    precision = average_precision(
        np.array(marked_scores, np.float64), np.array(hits, bool), float(total)
    )
    return round(precision, 4)


def _all_phrases(categories: Sequence[str]) -> list[str]:
    """Every phrase that is searched for, once."""
    phrases = [*categories]
    for _, phrase in _unseen_phrases(categories):
        phrases.append(phrase)
    phrases += [*TRAINED_NEGATIVES, *UNSEEN_NEGATIVES]
    return list(dict.fromkeys(phrases))


def _unseen_phrases(categories: Sequence[str]) -> list[tuple[str, str]]:
    """Category and phrase of every phrase that was not trained."""
    pairs = []
    for category in categories:
        for phrase in UNSEEN.get(category, ()):
            pairs.append((category, phrase))
    return pairs


def _embed_phrases(detector: LiteDetector, phrases: Sequence[str]) -> dict[str, np.ndarray]:
    rows = {}
    for phrase in phrases:
        rows[phrase] = detector.embed_phrase(phrase)
    return rows


def _views(stages: Sequence[Shots]) -> Iterator[View]:
    for shots in stages:
        for rgb, ids in zip(shots.rgb, shots.ids, strict=True):
            by_category: dict[str, list[tuple[int, int, int, int]]] = {}
            large = set()
            for i, box in boxes_of(ids, len(shots.names), VISIBLE_PX):
                by_category.setdefault(shots.categories[i], []).append(box)
                large.add(i)
            small = []
            for i, box in boxes_of(ids, len(shots.names), 1):
                if i not in large:
                    small.append(box)
            truth = {}
            for category, boxes in by_category.items():
                truth[category] = np.array(boxes, np.float64)
            small_boxes = np.array(small, np.float64).reshape(-1, 4)
            yield View(rgb, truth, small_boxes)


def _category_figures(results: Sequence[Detections], categories: Sequence[str]) -> Figures:
    """Average precision when every category is called by its name."""
    ap50 = {}
    ap75 = []
    for category in categories:
        ap50[category] = _average_precision(results, category, category)
        ap75.append(_average_precision(results, category, category, 0.75))
    return {
        "ap50": _mean_known(list(ap50.values())),
        "ap75": _mean_known(ap75),
        "ap50_by_category": ap50,
    }


def _recall_figures(results: Sequence[Detections], categories: Sequence[str]) -> Figures:
    """The share of objects among the boxes found, and among those of a score of THRESHOLD."""
    n = 0
    n_found = 0
    n_sure = 0
    for result in results:
        for category in categories:
            boxes, scores = result.snapped[category]
            for box in result.view.truth.get(category, ()):
                n += 1
                if len(boxes):
                    right = box_iou(box[None], boxes)[0] >= 0.5
                    n_found += bool(right.any())
                    n_sure += bool((right & (scores >= THRESHOLD)).any())
    return {"recall_at_10": share(n_found, n), "recall_at_threshold": share(n_sure, n)}


def _unseen_phrase_figures(results: Sequence[Detections], categories: Sequence[str]) -> Figures:
    """Average precision with phrases that were not trained."""
    by_phrase = {}
    snapped = []
    plain = []
    for category, phrase in _unseen_phrases(categories):
        precision = _average_precision(results, phrase, category)
        by_phrase[phrase] = precision
        snapped.append(precision)
        plain.append(_average_precision(results, phrase, category, snapped=False))
    return {
        "ap50_unseen_phrase": _mean_known(snapped),
        "ap50_unseen_phrase_without_snapping": _mean_known(plain),
        "ap50_by_unseen_phrase": by_phrase,
    }


def _average_precision(
    results: Sequence[Detections],
    phrase: str,
    category: str,
    mask_iou: float = 0.5,
    snapped: bool = True,
) -> float | None:
    """Of a category that is called by a phrase; None when no view shows it."""
    per_view = []
    for result in results:
        found = result.snapped if snapped else result.plain
        wanted, ignored = _split(result.view, category)
        per_view.append((found[phrase], wanted, ignored))
    return precision_of_views(per_view, mask_iou)


def _mean_known(values: Sequence[float | None]) -> float:
    known = [figure for figure in values if figure is not None]
    return round(float(np.mean(known)), 4)


def _false_alarms(results: Sequence[Detections], phrases: Sequence[str]) -> Figures:
    """The share of views in which something is found by phrases that name nothing there."""
    alarms = 0
    for result in results:
        for phrase in phrases:
            alarms += _is_alarm(result, phrase)
    return share(alarms, len(results) * len(phrases))


def _absent_false_alarms(results: Sequence[Detections], categories: Sequence[str]) -> Figures:
    """The share of views in which a category is found that is absent from them."""
    alarms = 0
    n = 0
    for result in results:
        for category in categories:
            if not _is_present(result.view, category):
                alarms += _is_alarm(result, category)
                n += 1
    return share(alarms, n)


def _is_alarm(result: Detections, phrase: str) -> bool:
    _, scores = result.snapped[phrase]
    return bool((scores >= THRESHOLD).any())


def _split(view: View, category: str) -> tuple[np.ndarray, np.ndarray]:
    """Boxes wanted of a category, and boxes whose detection does not count."""
    ignored = [view.small]
    for similar in AMBIGUOUS.get(category, ()):
        if similar in view.truth:
            ignored.append(view.truth[similar])
    wanted = view.truth.get(category, np.zeros((0, 4)))
    return wanted, np.concatenate(ignored)


def _is_present(view: View, category: str) -> bool:
    """Whether a view shows a category, or one that may be taken for it."""
    similar = (category, *AMBIGUOUS.get(category, ()))
    return not view.truth.keys().isdisjoint(similar)


def _detect(
    detector: LiteDetector, rgb: np.ndarray, rows: Mapping[str, np.ndarray]
) -> dict[str, Found]:
    """Every phrase at once, down to FLOOR."""
    resized, scale = resize_for_search(rgb)
    logits, edges = detector.network(resized[None], np.concatenate(list(rows.values())))
    found = {}
    for phrase, phrase_logits in zip(rows, logits[0], strict=True):
        xyxy, scores = decode(phrase_logits, edges[0], FLOOR)
        boxes = np.clip(xyxy / scale, 0, max(rgb.shape)).astype(np.float64)
        found[phrase] = boxes, scores
    return found


def _segment_iou(
    segmenter: LiteSegmenter, rgb: np.ndarray, box: np.ndarray, truth: np.ndarray
) -> float:
    """IoU of the mask that is found in a box with the true one."""
    chance = segmenter.mask_probability(rgb, box[None])[0]
    return mask_iou(chance > 0.5, truth)


def _iou_figures(ious: Sequence[float]) -> Figures:
    good = np.array(ious) >= 0.75
    return {
        "mean_iou": round(float(np.mean(ious)), 4),
        "iou_at_least_0.75": share(int(np.sum(good)), len(ious)),
    }
