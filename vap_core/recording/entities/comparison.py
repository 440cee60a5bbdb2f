"""What the vote compared: the crops of references and candidates, and their cosines."""

from collections.abc import Sequence

import cv2
import numpy as np
import rerun as rr

from vap_core.base.types import Grounding, Rgb
from vap_core.recording.colours import OTHER, TARGET
from vap_core.recording.entities.images import contact_sheet, encode_jpeg, jpeg_image
from vap_core.recording.stream import log_row

CROP_PX, CAPTION_PX = 120, 20
"""Side of a crop in the sheet, and height of the caption above it."""
JPEG_QUALITY = 90


def log_similarity(
    rec: rr.RecordingStream, grounding: Grounding, at: Sequence[rr.TimeColumn]
) -> None:
    """The cosine of every candidate with every reference."""
    if len(grounding.candidates):
        tensor = rr.Tensor(grounding.similarity, dim_names=("candidate", "reference"))
        log_row(rec, f"/vap/similarity/{grounding.camera}", tensor, at=at)


def log_crops(
    rec: rr.RecordingStream,
    grounding: Grounding,
    rgb: Rgb,
    references: Sequence[Rgb],
    at: Sequence[rr.TimeColumn],
) -> None:
    """References and candidates, one above the other."""
    if references:
        jpeg = encode_jpeg(crop_sheet(grounding, rgb, references), JPEG_QUALITY)
        log_row(rec, f"/vap/crops/{grounding.camera}", jpeg_image(jpeg), at=at)


def crop_sheet(grounding: Grounding, rgb: Rgb, references: Sequence[Rgb]) -> Rgb:
    """References in the top row, candidates in the rows below, best first.

    Each candidate's caption has its votes and mean cosine; the winner is framed in orange.
    """
    k = len(references)
    captions = [f"reference {i}" for i in range(k)]
    rows = [_captioned_row(captions, references, k)]
    cosines = np.zeros(0)
    if len(grounding.candidates):
        cosines = grounding.similarity.mean(axis=1)
    votes = grounding.ballot.votes
    order = np.lexsort((-cosines.astype(np.float64), -votes)).tolist()
    for first in range(0, len(order), k):
        candidates = order[first : first + k]
        captions = [f"#{i} v{votes[i]} {cosines[i]:.2f}" for i in candidates]
        crops = [_crop(rgb, grounding.candidates.xyxy[i]) for i in candidates]
        row = _captioned_row(captions, crops, k)
        if grounding.winner in candidates:
            _frame_crop(row, candidates.index(grounding.winner))
        rows.append(row)
    return np.concatenate(rows, axis=0)


def _captioned_row(captions: Sequence[str], crops: Sequence[Rgb], k: int) -> Rgb:
    """Up to `k` crops side by side, each under its caption."""
    sheet = contact_sheet(crops, CROP_PX)
    row = np.full((CAPTION_PX + CROP_PX, k * CROP_PX, 3), 24, np.uint8)
    row[CAPTION_PX:, : sheet.shape[1]] = sheet
    for i, text in enumerate(captions):
        cv2.putText(
            row,
            text,
            org=(i * CROP_PX + 4, CAPTION_PX - 5),
            fontFace=cv2.FONT_HERSHEY_SIMPLEX,
            fontScale=0.45,
            color=OTHER,
            thickness=1,
            lineType=cv2.LINE_AA,
        )
    return row


def _frame_crop(row: Rgb, i: int) -> None:
    """Draw the winner's frame around the i-th crop of a row."""
    left = i * CROP_PX
    near = (left + 1, CAPTION_PX + 1)
    far = (left + CROP_PX - 2, CAPTION_PX + CROP_PX - 2)
    cv2.rectangle(row, near, far, TARGET, thickness=3)


def _crop(rgb: Rgb, xyxy: np.ndarray) -> Rgb:
    """The box's pixels, at least one."""
    height, width = rgb.shape[:2]
    x0, y0, x1, y1 = np.clip(np.round(xyxy), 0, [width, height, width, height]).astype(int)
    return rgb[y0 : max(y1, y0 + 1), x0 : max(x1, x0 + 1)]
