"""The method's evidence, drawn into a recording: votes with their boxes, masks, and the words of an episode."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import rerun as rr

from vap_core.record.blueprint import QUIET, TARGET, TRUTH, evidence_line
from vap_core.record.file import put
from vap_core.values import Association, Grounding, Mask, Opening, Rgb

CLASSES = [
    rr.AnnotationInfo(id=0, label="", color=(0, 0, 0, 0)),
    rr.AnnotationInfo(id=1, label="track", color=(*TARGET, 140)),
    rr.AnnotationInfo(id=2, label="track, edge", color=(*TARGET, 255)),
    rr.AnnotationInfo(id=3, label="truth", color=(*TRUTH, 1)),
    rr.AnnotationInfo(id=4, label="truth, edge", color=(*TRUTH, 255)),
]
"""A mask is every pixel above 0; its edge has its own class so that track and truth stay apart where they agree."""


def jpeg(rgb: Rgb, quality: int) -> np.ndarray:
    """JPEG bytes of an RGB picture."""
    return cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]


def picture(jpeg_bytes: np.ndarray) -> rr.EncodedImage:
    return rr.EncodedImage(contents=jpeg_bytes.tobytes(), media_type="image/jpeg")


def classes(mask: Mask, inside: int, rim: int) -> np.ndarray:
    """Class image of a mask: `inside`, and `inside + 1` on its outermost `rim` pixels."""
    raw = np.ascontiguousarray(mask).view(np.uint8)
    eroded = cv2.erode(raw, np.ones((2 * rim + 1, 2 * rim + 1), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return raw * np.uint8(inside + 1) - eroded


def send_jpegs(rec: rr.RecordingStream, entity: str, index: Sequence[rr.TimeColumn], blobs: Sequence[np.ndarray]) -> None:
    """One compressed picture per step."""
    rec.send_columns(entity, index, rr.EncodedImage.columns(blob=blobs, media_type=["image/jpeg"] * len(blobs)))


def send_classes(
    rec: rr.RecordingStream, entity: str, index: Sequence[rr.TimeColumn], images: Sequence[np.ndarray], above: float | None = None
) -> None:
    """Class images of one size, one per step; `above` orders them over one another."""
    n, (height, width) = len(images), images[0].shape
    kind = rr.components.ImageFormat(width, height, color_model="L", channel_datatype="U8")
    columns = rr.SegmentationImage.columns(
        buffer=[image.reshape(-1) for image in images], format=[kind] * n, opacity=[1.0] * n, draw_order=None if above is None else [above] * n
    )
    rec.send_columns(entity, index, columns)


def suffix(j: int) -> str:
    return f"_{j}" if j else ""


type Rect = tuple[float, float, float, float]


def apart(a: Rect, b: Rect) -> bool:
    """Whether two rectangles `x0 y0 x1 y1` share no area."""
    return a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]


def label_spots(xyxy: np.ndarray, labels: Sequence[str], shape: tuple[int, ...]) -> dict[int, tuple[float, float]]:
    """Where to hang each label (its top centre, pixels) so that none covers another; labels without room are left out.

    The last label is the winner's: it takes the freer of the picture's top and bottom edges. Text keeps its size on the
    screen, so its size in pixels is reckoned for a view about 170 points high, the smallest of the layouts.
    """
    height, width = shape
    unit = max(height, width) / 170
    sizes = [((6.6 * len(label) + 12) * unit, 21 * unit) for label in labels]
    edge = 0.0 if xyxy[:, 1].min() > height - xyxy[:, 3].max() else height - sizes[-1][1]
    taken: list[Rect] = [(0.0, edge, float(width), edge + sizes[-1][1]), tuple(xyxy[-1].tolist())]
    spots = {len(labels) - 1: (width / 2, edge)}
    for i, ((x0, y0, x1, y1), (wide, high)) in enumerate(zip(xyxy[:-1].tolist(), sizes[:-1], strict=True)):
        mid, level = (x0 + x1) / 2, (y0 + y1 - high) / 2
        for x, y in ((mid, y1), (mid, y0 - high), (x0 - wide / 2, level), (x1 + wide / 2, level)):
            x = min(max(x, wide / 2), width - wide / 2)
            rect = (x - wide / 2, y, x + wide / 2, y + high)
            if y >= 0 and y + high <= height and all(apart(rect, other) for other in taken):
                taken.append(rect)
                spots[i] = (x, y)
                break
    return spots


def log_vote(rec: rr.RecordingStream, grounding: Grounding, j: int, opening_image: np.ndarray | None, at: Sequence[rr.TimeColumn]) -> None:
    """Everything the vote of target j saw in one view: labelled boxes over the opening picture, bars, and the numbers."""
    cam, tail, boxes = grounding.camera, suffix(j), grounding.candidates
    n, k = grounding.similarity.shape
    winner = -1 if grounding.winner is None else grounding.winner
    cosine = grounding.similarity.mean(axis=1) if n else np.zeros(0, np.float32)
    entity = f"/observation.images.{cam}/candidates{tail}"
    last = grounding.elected if grounding.winner is None else winner  # drawn on top, and labelled in full
    order = [i for i in range(n) if i != last] + ([last] if last is not None else [])
    colours = [TARGET if i == winner else QUIET for i in order]
    labels = [f"#{i} {boxes.score[i]:.2f} · votes {grounding.votes[i]}/{k} · cos {cosine[i]:.2f}" for i in order]
    if opening_image is not None:
        put(rec, entity, picture(opening_image), at=at)
    if n:
        drawn = rr.Boxes2D(
            array=boxes.xyxy[order].reshape(-1, 4),
            array_format=rr.Box2DFormat.XYXY,
            labels=labels,
            colors=colours,
            radii=rr.components.Radius.ui_points([2.5 if i == winner else 1.2 for i in order]),
            show_labels=False,
        )
        put(rec, entity, drawn, at=at)
        shown = [labels[-1] if i == last else f"#{i} v{grounding.votes[i]}" for i in order]
        spots = label_spots(boxes.xyxy[order], shown, grounding.masks.shape[1:])
        points = rr.Points2D(list(spots.values()), radii=0, labels=[shown[i] for i in spots], colors=[colours[i] for i in spots], show_labels=True)
        put(rec, f"{entity}/labels", points, at=at)
        put(rec, f"/vap/votes/{cam}{tail}", rr.AnyValues(counts=grounding.votes), at=at)
    others = [i for i in order if i != winner]
    for name, chosen, colour in (("others", others, QUIET), ("winner", order[len(others) :], TARGET)):
        if chosen:
            bars = rr.BarChart(grounding.votes[chosen].astype(np.float64), abscissa=np.asarray(chosen, np.float64), color=colour)
            put(rec, f"/vap/votes/{cam}{tail}/{name}", bars, at=at)
    per_candidate: dict[str, Any] = {
        "score": boxes.score, "xyxy": boxes.xyxy.reshape(-1), "votes": grounding.votes, "tied": grounding.tied,
        "mean_cosine": cosine, "similarity": grounding.similarity.reshape(-1),
    }  # fmt: skip
    numbers = rr.AnyValues(
        phrase=boxes.phrase, object=grounding.object, winner=np.int64(winner), references=np.int64(k), margin=grounding.margin,
        elected=np.int64(-1 if grounding.elected is None else grounding.elected),
        cosine_margin=grounding.cosine_margin, **(per_candidate if n else {}),
    )  # fmt: skip
    put(rec, f"/vap/candidates/{cam}{tail}", numbers, at=at)


def log_association(rec: rr.RecordingStream, association: Association, j: int, at: Sequence[rr.TimeColumn]) -> None:
    """What the views agreed on for target j, and by what scores; `chosen` is -1 where the target is in none of the candidates."""
    parts: dict[str, Any] = {f"support_{cam}": scores for cam, scores in association.support.items()}
    numbers = rr.AnyValues(
        cameras=list(association.chosen), chosen=np.array([-1 if i is None else i for i in association.chosen.values()], np.int64),
        total=association.total, margin=association.margin, terms=list(association.terms), scores=np.array(list(association.terms.values())),
        **parts,
    )  # fmt: skip
    put(rec, f"/vap/association{suffix(j)}", numbers, at=at)


def words(opening: Opening, ending: str = "", reason: str = "") -> rr.TextDocument:
    """The instruction and its rewrite, the verdict of every view, how it ended, and why."""
    row, rewritten = opening.row, opening.rewritten
    verdicts = [f"| {cam} | {evidence_line(g)} |" for cam, per_view in opening.groundings.items() for g in per_view]
    table = ["| view | vote at t = 0 |", "| --- | --- |", *verdicts] if verdicts else ["*no grounding: this method does not prompt*"]
    read = f'**policy read** "{rewritten}"' if rewritten != opening.instruction else "**policy read** the same words"
    head = [f'**said** "{opening.instruction}"', read, *([f"**ended** {ending}"] if ending else []), *([f"**why** {reason}"] if reason else [])]
    origin = f"{row.suite} · {row.task} · episode {row.episode} · seed {row.seed} · {opening.method} · {opening.policy}"
    return rr.TextDocument("\n\n".join(["  \n".join([*head, origin]), "\n".join(table)]), media_type=rr.MediaType.MARKDOWN)


def contact_sheet(crops: Sequence[np.ndarray], side: int = 128) -> Rgb:
    """The reference views (RGB, of any sizes) side by side, each fitted into a square of `side` pixels."""
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
