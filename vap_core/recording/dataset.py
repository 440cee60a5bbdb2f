"""A recording of one episode of a dataset: every camera, tracked and prompted."""

from collections.abc import Sequence
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from vap_core.base.types import Attended, PersonalObject, Views
from vap_core.recording.blueprint import full_window
from vap_core.recording.entities.comparison import log_vote_picture
from vap_core.recording.entities.images import encode_jpeg
from vap_core.recording.entities.masks import CLASSES
from vap_core.recording.entities.votes import log_vote
from vap_core.recording.grounding import JPEG_QUALITY, ClipStep, log_clip_step
from vap_core.recording.stream import (
    StoredBlueprint,
    finish_stream,
    log_row,
    open_stream,
    time_columns,
)
from vap_core.recording.texts import grounding_document
from vap_core.recording.views import (
    Part,
    instruction_view,
    mask_view,
    policy_view,
    track_score_view,
    vote_picture_view,
    vote_view,
)


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

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
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
        for i, (camera, rgb) in enumerate(views.items()):
            grounding = attended.groundings[camera][0]
            log_vote(self._rec, grounding, 0, encode_jpeg(rgb, JPEG_QUALITY), at)
            log_vote_picture(
                self._rec, grounding, 0, rgb=rgb, references=obj.crops, right=None, at=at
            )
            if i == 0:
                document = grounding_document(grounding, obj, told, attended.text)
                log_row(self._rec, "/vap/instruction", document, at=at)


def dataset_blueprint(cameras: Sequence[str], fps: float) -> StoredBlueprint:
    """A recorded episode: per camera what a policy would see, the track and the vote."""
    rows: list[Part] = []
    votes: list[Part] = []
    for camera in cameras:
        rows.append(rrb.Vertical(policy_view(camera), mask_view(camera), vote_view(camera)))
        votes.append(vote_picture_view(camera))
    below = rrb.Horizontal(
        instruction_view(),
        track_score_view(),
        rrb.Tabs(*votes, active_tab=0),
        column_shares=[1.2, 1.2, 1.2],
    )
    return full_window(rrb.Vertical(rrb.Horizontal(*rows), below, row_shares=[2, 1]), fps)
