"""A recording of one episode of a dataset: every camera, tracked and prompted."""

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import rerun as rr

from vap_core.base.types import Attended, PersonalObject, Views
from vap_core.recording.blueprint import dataset_blueprint
from vap_core.recording.entities.comparison import log_similarity
from vap_core.recording.entities.images import contact_sheet, encode_jpeg, jpeg_image
from vap_core.recording.entities.masks import CLASSES
from vap_core.recording.entities.votes import log_vote
from vap_core.recording.grounding import JPEG_QUALITY, ClipStep, log_clip_step
from vap_core.recording.stream import finish_stream, log_row, open_stream, time_columns
from vap_core.recording.texts import grounding_document


class DatasetRecorder:
    """Streams the frames of an episode to disk; `ground` adds the votes that began the tracks.

    Left through an exception, the unfinished file keeps its temporary name.

    Raises: BadOutput, when `path` exists or its folder cannot be written.
    """

    def __init__(self, path: Path, cameras: Sequence[str], name: str, hz: float) -> None:
        self.path = path
        self._rec = open_stream(path, f"dataset.{name}.{path.stem}")
        self._rec.send_recording_name(f"{path.stem} · {name}")
        log_row(self._rec, "/", rr.AnnotationContext(CLASSES))
        dataset_blueprint(cameras, hz).send(self._rec)

    def __enter__(self) -> "DatasetRecorder":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            finish_stream(self._rec, self.path)
        else:
            self._rec.disconnect()

    def add(self, frame_index: int, at_s: float, views: Views, attended: Attended) -> None:
        """One frame of every camera, with the first target's track."""
        for camera, rgb in views.items():
            step = ClipStep(
                frame_index=frame_index,
                timestamp_s=at_s,
                image=rgb,
                prompted=attended.images[camera],
                track=attended.tracks[camera][0],
            )
            log_clip_step(self._rec, camera, step)

    def ground(self, views: Views, attended: Attended, obj: PersonalObject, told: str) -> None:
        """The votes of the first frame, and the references that voted."""
        at = time_columns([(0, 0.0)])
        sheet = encode_jpeg(contact_sheet(obj.crops), JPEG_QUALITY)
        log_row(self._rec, "/vap/references", jpeg_image(sheet), at=at)
        for i, (camera, rgb) in enumerate(views.items()):
            grounding = attended.groundings[camera][0]
            log_vote(self._rec, grounding, 0, encode_jpeg(rgb, JPEG_QUALITY), at)
            log_similarity(self._rec, grounding, at)
            if i == 0:
                document = grounding_document(grounding, obj, told, attended.text)
                log_row(self._rec, "/vap/instruction", document, at=at)
