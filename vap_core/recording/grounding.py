"""A one-picture recording for `vap_core ground`."""

from pathlib import Path

import rerun as rr

from vap_core.base.types import Grounding, PersonalObject, Rgb
from vap_core.recording.blueprint import grounding_blueprint
from vap_core.recording.entities.comparison import log_similarity
from vap_core.recording.entities.images import contact_sheet, encode_jpeg, jpeg_image
from vap_core.recording.entities.masks import CLASSES, track_image
from vap_core.recording.entities.paths import image_root
from vap_core.recording.entities.votes import log_vote
from vap_core.recording.stream import finish_stream, log_row, open_stream, time_columns
from vap_core.recording.texts import grounding_document

JPEG_QUALITY = 95


def record_grounding(
    path: Path,
    image: Rgb,
    grounding: Grounding,
    obj: PersonalObject,
    instruction: str,
    rewritten: str,
    prompted: Rgb,
) -> None:
    """Record the vote, its references and similarities, the mask and the prompted picture.

    Raises: BadOutput, when `path` exists or its folder cannot be written.
    """
    path = Path(path)
    root = image_root(grounding.camera)
    rec = open_stream(path, f"ground.{grounding.object}.{grounding.camera}.{path.stem}")
    rec.send_recording_name(f"ground · {grounding.object}")
    log_row(rec, "/", rr.AnnotationContext(CLASSES))
    at = time_columns([(0, 0.0)])
    jpeg = encode_jpeg(image, JPEG_QUALITY)
    log_row(rec, root, jpeg_image(jpeg), at=at)
    prompted_jpeg = encode_jpeg(prompted, JPEG_QUALITY)
    log_row(rec, f"{root}/prompted", jpeg_image(prompted_jpeg), at=at)
    log_vote(rec, grounding, 0, jpeg, at)
    if grounding.mask is not None:
        mask = rr.SegmentationImage(track_image(grounding.mask), opacity=1.0)
        log_row(rec, f"{root}/mask/target", mask, at=at)
    sheet = encode_jpeg(contact_sheet(obj.crops), JPEG_QUALITY)
    log_row(rec, "/vap/references", jpeg_image(sheet), at=at)
    log_similarity(rec, grounding, at)
    document = grounding_document(grounding, obj, instruction, rewritten)
    log_row(rec, "/vap/instruction", document, at=at)
    grounding_blueprint(grounding).send(rec)
    finish_stream(rec, path)
