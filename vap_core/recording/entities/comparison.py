"""What the vote compared, as one picture: candidates, reference photos, cosines and votes."""

from collections.abc import Sequence

import rerun as rr

from vap_core.base.types import Grounding, Rgb
from vap_core.base.vote_picture import vote_picture
from vap_core.recording.entities.images import encode_jpeg, jpeg_image
from vap_core.recording.entities.paths import target_suffix
from vap_core.recording.stream import log_row

JPEG_QUALITY = 88


def vote_picture_entity(camera: str, j: int = 0) -> str:
    """The entity of the vote's picture of target j in one view."""
    return f"/vap/vote_picture/{camera}{target_suffix(j)}"


def log_vote_picture(
    rec: rr.RecordingStream,
    grounding: Grounding,
    j: int,
    rgb: Rgb,
    references: Sequence[Rgb],
    right: bool | None,
    at: Sequence[rr.TimeColumn],
) -> None:
    """The vote of target j; `right` says whether it elected the target, where that is known."""
    picture = vote_picture(grounding, rgb, references, right=right)
    jpeg = jpeg_image(encode_jpeg(picture, JPEG_QUALITY))
    log_row(rec, vote_picture_entity(grounding.camera, j), jpeg, at=at)
