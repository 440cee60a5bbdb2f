"""Recordings for `vap_core ground`: of one picture, and of a clip."""

from pathlib import Path

import numpy as np
import rerun as rr

from vap_core.base.types import Grounding, PersonalObject, Rgb, Track, value
from vap_core.recording.blueprint import grounding_blueprint
from vap_core.recording.entities.comparison import log_vote_picture
from vap_core.recording.entities.images import encode_jpeg, jpeg_image
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
    with ClipRecorder(path, grounding.camera, grounding.object) as recorder:
        recorder.add(ClipStep(0, 0.0, image, prompted, Track(grounding.mask, 1.0)))
        recorder.ground(0, 0.0, image, grounding, obj, instruction, rewritten)


@value
class ClipStep:
    """One frame of a clip: as it is, as the policy is shown it, and where the first target is."""

    frame_index: int
    timestamp_s: float
    image: Rgb
    prompted: Rgb
    track: Track


class ClipRecorder:
    """Streams the frames of a clip to disk; `ground` adds the vote that started the track.

    Left through an exception, the unfinished file keeps its temporary name.

    Raises: BadOutput, when `path` exists or its folder cannot be written.
    """

    def __init__(self, path: Path, camera: str, name: str, hz: float = 1.0) -> None:
        self.path = Path(path)
        self._hz = hz
        self._camera = camera
        self._rec = open_stream(self.path, f"ground.{name}.{camera}.{self.path.stem}")
        self._rec.send_recording_name(f"ground · {name}")
        log_row(self._rec, "/", rr.AnnotationContext(CLASSES))

    def __enter__(self) -> "ClipRecorder":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            finish_stream(self._rec, self.path)
        else:
            self._rec.disconnect()

    def add(self, step: ClipStep) -> None:
        """One frame, its prompted picture, its mask and the track's score."""
        log_clip_step(self._rec, self._camera, step)

    def ground(
        self,
        frame_index: int,
        timestamp_s: float,
        image: Rgb,
        grounding: Grounding,
        obj: PersonalObject,
        instruction: str,
        rewritten: str,
    ) -> None:
        """The vote of one frame, its references and similarities, and how it is looked at."""
        at = time_columns([(frame_index, timestamp_s)])
        log_vote(self._rec, grounding, 0, encode_jpeg(image, JPEG_QUALITY), at)
        log_vote_picture(
            self._rec, grounding, 0, rgb=image, references=obj.crops, right=None, at=at
        )
        document = grounding_document(grounding, obj, instruction, rewritten)
        log_row(self._rec, "/vap/instruction", document, at=at)
        grounding_blueprint(grounding, self._hz).send(self._rec)


def log_clip_step(rec: rr.RecordingStream, camera: str, step: ClipStep) -> None:
    """One frame of a camera, its prompted picture, its mask and the track's score."""
    at = time_columns([(step.frame_index, step.timestamp_s)])
    root = image_root(camera)
    jpeg = encode_jpeg(step.image, JPEG_QUALITY)
    log_row(rec, root, jpeg_image(jpeg), at=at)
    prompted = jpeg
    if step.prompted is not step.image:
        prompted = encode_jpeg(step.prompted, JPEG_QUALITY)
    log_row(rec, f"{root}/prompted", jpeg_image(prompted), at=at)
    shown = np.zeros(step.image.shape[:2], bool)
    if step.track.mask is not None:
        shown = step.track.mask
    mask = rr.SegmentationImage(track_image(shown), opacity=1.0)
    log_row(rec, f"{root}/mask/target", mask, at=at)
    score = rr.Scalars([step.track.score])
    log_row(rec, f"/vap/track_score/{camera}", score, at=at)
