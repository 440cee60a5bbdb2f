"""Recordings for `vap_core ground`: of one picture, and of a clip."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from vap_core.base.types import (
    Attended,
    Event,
    Grounding,
    PersonalObject,
    Rgb,
    Track,
    Views,
    value,
)
from vap_core.recording.colours import image_root
from vap_core.recording.entities.curves import send_events
from vap_core.recording.entities.pictures import CLASSES, encode_jpeg, jpeg_image, track_image
from vap_core.recording.entities.votes import log_vote
from vap_core.recording.layout import (
    Part,
    events_view,
    full_window,
    grounding_blueprint,
    instruction_view,
    mask_view,
    policy_view,
    track_score_view,
    vote_picture_view,
    vote_view,
)
from vap_core.recording.stream import (
    StoredBlueprint,
    finish_stream,
    log_row,
    open_stream,
    time_columns,
)
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


class Streamed:
    """A recording that is streamed to disk.

    Left through an exception, the unfinished file keeps its temporary name.

    Raises: BadOutput, when `path` exists or its folder cannot be written.
    """

    def __init__(self, path: Path, recording_id: str, name: str) -> None:
        self.path = Path(path)
        self._rec = open_stream(self.path, recording_id)
        self._rec.send_recording_name(name)
        log_row(self._rec, "/", rr.AnnotationContext(CLASSES))

    def __enter__[R: Streamed](self: R) -> R:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            finish_stream(self._rec, self.path)
        else:
            self._rec.disconnect()


class ClipRecorder(Streamed):
    """Streams the frames of a clip; `ground` adds the vote that started the track."""

    def __init__(self, path: Path, camera: str, name: str, hz: float = 1.0) -> None:
        recording_id = f"ground.{name}.{camera}.{Path(path).stem}"
        super().__init__(path, recording_id, f"ground · {name}")
        self._hz = hz
        self._camera = camera

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
        log_vote(self._rec, grounding, 0, image, obj.crops, at)
        document = grounding_document(grounding, obj, instruction, rewritten)
        log_row(self._rec, "/vap/instruction", document, at=at)
        grounding_blueprint(grounding, self._hz).send(self._rec)


def log_clip_step(rec: rr.RecordingStream, camera: str, step: ClipStep) -> None:
    """One frame of a camera, its prompted picture, its mask and the track's score."""
    at = time_columns([(step.frame_index, step.timestamp_s)])
    root = image_root(camera)
    jpeg = encode_jpeg(step.image, JPEG_QUALITY)
    log_row(rec, root, jpeg_image(jpeg), at=at)
    prompted = encode_jpeg(step.prompted, JPEG_QUALITY) if step.prompted is not step.image else jpeg
    log_row(rec, f"{root}/prompted", jpeg_image(prompted), at=at)
    shown = step.track.mask if step.track.mask is not None else np.zeros(step.image.shape[:2], bool)
    mask = rr.SegmentationImage(track_image(shown), opacity=1.0)
    log_row(rec, f"{root}/mask/target", mask, at=at)
    log_row(rec, f"/vap/track_score/{camera}", rr.Scalars([step.track.score]), at=at)


class DatasetRecorder(Streamed):
    """Streams the frames of an episode; `ground` adds the votes that began the tracks.

    `served`: of an episode behind the proxy, which has actions and events.
    """

    def __init__(
        self, path: Path, cameras: Sequence[str], name: str, hz: float, *, served: bool = False
    ) -> None:
        super().__init__(path, f"dataset.{name}.{path.stem}", f"{path.stem} · {name}")
        further = [events_view(), rrb.TimeSeriesView(origin="/action", name="action")]
        dataset_blueprint(cameras, hz, further if served else ()).send(self._rec)

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

    def add_numbers(
        self,
        frame_index: int,
        at_s: float,
        numbers: Mapping[str, np.ndarray],
        told: Sequence[Event],
    ) -> None:
        """Rows of numbers of a frame by entity, as /action, and its events."""
        for entity, row in numbers.items():
            log_row(self._rec, entity, rr.Scalars(row), at=time_columns([(frame_index, at_s)]))
        send_events(self._rec, told, {frame_index: at_s})

    def ground(self, views: Views, attended: Attended, obj: PersonalObject, told: str) -> None:
        """The votes of the first frame, and the references that voted."""
        at = time_columns([(0, 0.0)])
        for i, (camera, rgb) in enumerate(views.items()):
            grounding = attended.groundings[camera][0]
            log_vote(self._rec, grounding, 0, rgb, obj.crops, at)
            if i == 0:
                document = grounding_document(grounding, obj, told, attended.text)
                log_row(self._rec, "/vap/instruction", document, at=at)


def dataset_blueprint(
    cameras: Sequence[str], fps: float, further: Sequence[Part] = ()
) -> StoredBlueprint:
    """A recorded episode: per camera what a policy would see, the track and the vote; and further
    views below."""
    rows: list[Part] = []
    votes: list[Part] = []
    stack = rrb.Vertical if len(cameras) > 1 else rrb.Horizontal
    for camera in cameras:
        rows.append(stack(policy_view(camera), mask_view(camera), vote_view(camera)))
        votes.append(vote_picture_view(camera))
    below = rrb.Horizontal(
        instruction_view(),
        track_score_view(),
        rrb.Tabs(*votes, active_tab=0),
        *further,
    )
    return full_window(rrb.Vertical(rrb.Horizontal(*rows), below, row_shares=[2, 1]), fps)
