"""The method's evidence, drawn into a recording: votes with their boxes, masks, and the words of an episode."""

from collections.abc import Sequence

import cv2
import numpy as np
import rerun as rr

from vap_core.blueprint import QUIET, TARGET, TRUTH, evidence_line
from vap_core.values import Grounding, Mask, Opening, Rgb

CLASSES = [
    rr.AnnotationInfo(id=1, label="track", color=(*TARGET, 90)),
    rr.AnnotationInfo(id=2, label="track, edge", color=(*TARGET, 255)),
    rr.AnnotationInfo(id=3, label="truth", color=(*TRUTH, 1)),
    rr.AnnotationInfo(id=4, label="truth, edge", color=(*TRUTH, 255)),
]
"""A mask is every pixel above 0; its edge has its own class so that track and truth stay apart where they agree."""


def jpeg(rgb: Rgb, quality: int) -> np.ndarray:
    """JPEG bytes of an RGB picture."""
    return cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]


def classes(mask: Mask, inside: int) -> np.ndarray:
    """Class image of a mask: `inside`, and `inside + 1` on its outermost pixels."""
    raw = np.ascontiguousarray(mask).view(np.uint8)
    eroded = cv2.erode(raw, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return raw * np.uint8(inside + 1) - eroded


def suffix(j: int) -> str:
    return f"_{j}" if j else ""


def log_vote(rec: rr.RecordingStream, grounding: Grounding, j: int, opening_image: np.ndarray | None) -> None:
    """Everything the vote of target j saw in one view: labelled boxes over the opening picture, bars, and the numbers."""
    cam, tail, boxes = grounding.camera, suffix(j), grounding.candidates
    n, k = grounding.similarity.shape
    winner = -1 if grounding.winner is None else grounding.winner
    cosine = grounding.similarity.mean(axis=1) if n else np.zeros(0, np.float32)
    entity = f"/observation.images.{cam}/candidates{tail}"
    order = [i for i in range(n) if i != winner] + ([winner] if n else [])  # the winner last: drawn on top
    labels = [
        f"#{i} {boxes.score[i]:.2f} · votes {grounding.votes[i]}/{k} · cos {cosine[i]:.2f}" if i == winner else f"#{i} v{grounding.votes[i]}"
        for i in order
    ]
    if opening_image is not None:
        rec.log(entity, rr.EncodedImage(contents=opening_image.tobytes(), media_type="image/jpeg"))
    rec.log(
        entity,
        rr.Boxes2D(
            array=boxes.xyxy[order].reshape(-1, 4),
            array_format=rr.Box2DFormat.XYXY,
            labels=labels,
            colors=[TARGET if i == winner else QUIET for i in order],
            radii=[rr.components.Radius.ui_points(2.5 if i == winner else 1.2) for i in order],
            show_labels=True,
        ),
    )
    rec.log(f"/vap/votes/{cam}{tail}", rr.BarChart(grounding.votes.astype(np.float64), color=QUIET), rr.AnyValues(counts=grounding.votes))
    if n:
        rec.log(f"/vap/votes/{cam}{tail}/winner", rr.BarChart([float(grounding.votes[winner])], abscissa=[float(winner)], color=TARGET))
    rec.log(
        f"/vap/candidates/{cam}{tail}",
        rr.AnyValues(
            phrase=boxes.phrase, object=grounding.object, winner=np.int64(winner), references=np.int64(k), margin=grounding.margin,
            cosine_margin=grounding.cosine_margin, score=boxes.score, xyxy=boxes.xyxy.reshape(-1), votes=grounding.votes, tied=grounding.tied,
            mean_cosine=cosine, similarity=grounding.similarity.reshape(-1),
        ),
    )  # fmt: skip


def words(opening: Opening, ending: str = "") -> rr.TextDocument:
    """The instruction and its rewrite, the verdict of every view, and how it ended."""
    row, rewritten = opening.row, opening.rewritten
    verdicts = [f"| {cam} | {evidence_line(g)} |" for cam, per_view in opening.groundings.items() for g in per_view]
    table = ["| view | vote at t = 0 |", "| --- | --- |", *verdicts] if verdicts else ["*no grounding: this method does not prompt*"]
    said = [f'**said** "{opening.instruction}"', f'**policy read** "{rewritten}"' if rewritten != opening.instruction else "**policy read** the same"]
    end = [f"**ended** {ending}"] if ending else []
    footer = f"{row.suite} · {row.task} · episode {row.episode} · seed {row.seed} · {opening.method} · {opening.policy}"
    return rr.TextDocument("\n\n".join([*said, *end, "\n".join(table), footer]), media_type=rr.MediaType.MARKDOWN)


def contact_sheet(crops: Sequence[Rgb], side: int = 128) -> Rgb:
    """The reference views side by side, each fitted into a square of `side` pixels."""
    cells = []
    for crop in crops:
        scale = side / max(crop.shape[:2])
        size = (max(1, round(crop.shape[1] * scale)), max(1, round(crop.shape[0] * scale)))
        cell = np.full((side, side, 3), 30, np.uint8)
        fitted = cv2.resize(crop, size, interpolation=cv2.INTER_AREA)
        top, left = (side - size[1]) // 2, (side - size[0]) // 2
        cell[top : top + size[1], left : left + size[0]] = fitted
        cells.append(cell)
    return np.concatenate(cells, axis=1)
