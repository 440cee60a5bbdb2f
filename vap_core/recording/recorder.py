"""Episode -> .rrd: one Rerun recording per rollout, streamed to disk while it happens.

Timelines are `frame_index` and `timestamp`. Entities have the names of LeRobot's features:

- `/observation.images.<camera>`: the raw picture. Below it `/prompted` is what the policy saw,
  `/candidates` the boxes over the picture that the vote was held on, `/mask/{target,gt}` track and
  truth, `/identity` the objects' outlines and names, `/attention/<query>` overlays.
- `/observation.state`, `/action`, `/next.reward`, `/next.success`.
- `/vap/{votes,candidates}/<camera>`: the vote in numbers, `/vap/vote_picture/<camera>` its picture.
- `/vap/association`: what the views agreed on, where they were associated.
- `/vap/{vote_margin,track_score,attention}/<camera>`, `/vap/hand/*`: curves and tensors.
- `/vap/{verdict,instruction,events}`, text; of an instruction in several steps also
  `/vap/status/subgoal`.
- `/world/{table,robot/link*,objects/*}`: simulator truth.

Evidence of a further target j ends in `_j`. Recording properties are in module `properties`.
Pictures are JPEG or AV1, at the steps that have them; everything that changes travels in columns.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rerun as rr

from vap_core.base.errors import BadOutput
from vap_core.base.files import code_version
from vap_core.base.types import Event, Grounding, Mask
from vap_core.recording.colours import image_root
from vap_core.recording.entities.curves import (
    log_method_styles,
    log_robot_styles,
    send_events,
    send_gripper,
    send_method,
    send_reward,
    send_robot,
    send_subgoals,
)
from vap_core.recording.entities.pictures import (
    CLASSES,
    JPEG_QUALITY,
    Pictures,
    StillPictures,
    VideoPictures,
    encode_jpeg,
    jpeg_image,
    send_attention,
    send_masks,
    send_outlines,
)
from vap_core.recording.entities.scene import (
    log_cameras,
    log_links,
    log_objects,
    log_roles,
    log_table,
    send_camera_poses,
    send_truth,
)
from vap_core.recording.entities.votes import (
    log_association,
    log_vote,
    mean_cosines,
)
from vap_core.recording.layout import Axes, episode_blueprint
from vap_core.recording.stream import (
    finish_stream,
    flush_stream,
    frame_times,
    log_properties,
    log_row,
    open_stream,
    temporary_path,
)
from vap_core.recording.texts import describe_outcome, instruction_document, verdict_document
from vap_core.rollout.types import (
    Diagnosis,
    Episode,
    EpisodeHeader,
    Explain,
    Explanation,
    Frame,
    SubGoalSpan,
    covered_object,
)
from vap_core.simulation.types import EpisodeRow, Outcome

OUTCOME_LEVELS: dict[str, Literal["INFO", "WARN", "ERROR"]] = {
    "success": "INFO",
    "failure": "WARN",
    "error": "ERROR",
}
"""The level of the event that ends an episode."""


class Recorder:
    """Streams one episode to disk; what was flushed outlives the process (`recover`).

    `frame` buffers; every `flush_every` frames the buffered columns go to the file. `close` writes
    the outcome and renames the file. `video` keeps pictures as AV1, much smaller for more time.
    Left through an exception, the context manager keeps the unfinished file under its temporary
    name.

    Raises: BadOutput, when `path` exists or its folder cannot be written.
    """

    def __init__(
        self,
        path: Path,
        header: EpisodeHeader,
        *,
        flush_every: int = 10,
        video: bool = False,
        explain: Explain | None = None,
    ) -> None:
        row = header.row
        self.path = Path(path)
        self._header = header
        self._goal = header
        """What is known of the present sub-goal; of the episode, where it has one goal."""
        self._spans: list[SubGoalSpan] = []
        self._subgoal: int | None = None
        self._flush_every = flush_every
        self._explain = explain
        self._pictures: Pictures = VideoPictures(header.hz) if video else StillPictures()
        self._frames: list[Frame] = []
        """All frames, without images."""
        self._unsent: list[Frame] = []
        self._queries: tuple[str, ...] = ()
        self._has_layout = False
        recording_id = f"{row.key}.s{row.seed}.{header.method}.{header.policy}"
        self._rec: rr.RecordingStream | None = open_stream(self.path, recording_id)
        self._log_header(self._rec)

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *_: object) -> None:
        if self._rec is not None:
            try:
                self._flush()
                flush_stream(self._rec, self.path)
            finally:
                self._rec.disconnect()
                self._rec = None

    def frame(self, frame: Frame) -> None:
        """Record one control step."""
        if not self._frames:
            self._log_first_frame(frame)
        elif self._spans and self._spans[-1].first == frame.frame_index:
            self._log_roles(frame)
            self._log_choice(frame, again=True)
        self._pictures.add(frame)
        self._frames.append(frame.without_images())
        self._unsent.append(frame)
        if len(self._unsent) >= self._flush_every:
            if not self._has_layout:
                # An episode that is killed opens with this one; `close` sends another.
                episode_blueprint(self._header, queries=self._queries).send(self._open_stream())
                self._has_layout = True
            self._flush()

    def begin_subgoal(self, header: EpisodeHeader) -> None:
        """From the next frame on record another sub-goal: its target, and how it was grounded."""
        self._flush()
        if not self._spans:
            self._spans.append(SubGoalSpan(self._header_of_first(), 0))
        first = self._frames[-1].frame_index + 1
        self._spans.append(SubGoalSpan(header, first))
        self._goal = header

    def close(self, outcome: Outcome) -> None:
        """Flush, write outcome, diagnosis and footer, and give the recording its name.

        Raises: BadOutput, when it cannot be written whole, or a file of that name appeared
            meanwhile.
        """
        rec = self._open_stream()
        self._flush()
        self._pictures.send(rec, last=True)
        explanation = self._explain_episode(outcome)
        if self._frames:
            self._send_ending(outcome, explanation)
        diagnosis = explanation.diagnosis
        document = instruction_document(self._header, describe_outcome(outcome))
        log_row(rec, "/vap/instruction", document)
        decided = self._deciding_header(outcome)
        log_row(rec, "/vap/verdict", verdict_document(decided, outcome, diagnosis))
        log_properties(rec, "outcome", outcome_properties(outcome, diagnosis))
        self._rec = None
        finish_stream(rec, self.path)

    def discard(self) -> None:
        """End without a recording; what was flushed is deleted."""
        self._open_stream().disconnect()
        self._rec = None
        temporary_path(self.path).unlink(missing_ok=True)

    def _open_stream(self) -> rr.RecordingStream:
        if self._rec is None:
            raise BadOutput(
                f"record: {self.path} is closed; open another Recorder for another episode."
            )
        return self._rec

    def _log_header(self, rec: rr.RecordingStream) -> None:
        """What is known before the first step."""
        header = self._header
        rec.send_recording_name(f"{header.row.key} · {header.method}")
        log_properties(rec, "rollout", rollout_properties(header))
        log_row(rec, "/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.AnnotationContext(CLASSES))
        log_row(rec, "/vap/instruction", instruction_document(header))
        log_table(rec, header.row)
        log_objects(rec, header)

    def _log_roles(self, frame: Frame) -> None:
        """Which object is the target from this step on; static, where that never changes."""
        at = frame_times([frame]) if self._header.row.subgoals else ()
        log_roles(self._open_stream(), self._goal, at)

    def _log_first_frame(self, frame: Frame) -> None:
        """What only the first step shows: shapes, links, and the pictures of the vote."""
        rec = self._open_stream()
        log_robot_styles(rec, self._header, frame)
        log_method_styles(rec, self._header)
        log_cameras(rec, frame)
        log_links(rec, frame.truth)
        self._log_roles(frame)
        self._log_choice(frame)
        for of_queries in frame.attention.values():
            self._queries = tuple(of_queries)

    def _log_choice(self, frame: Frame, again: bool = False) -> None:
        """The votes of every view, and what the views agreed on, for the present sub-goal."""
        for camera in frame.images:
            self._log_votes(frame, camera, again)
        for j, association in enumerate(self._goal.associations):
            if association is not None:
                log_association(self._open_stream(), association, j, frame_times([frame]))

    def _log_votes(self, frame: Frame, camera: str, again: bool) -> None:
        """The votes of one view, over the first one's picture."""
        rec = self._open_stream()
        at = frame_times([frame])
        rgb = frame.images[camera]
        groundings = self._goal.groundings.get(camera, ())
        if not groundings:
            jpeg = jpeg_image(encode_jpeg(rgb, JPEG_QUALITY))
            log_row(rec, f"{image_root(camera)}/candidates", jpeg, at=at)
        for j, grounding in enumerate(groundings):
            yours = None
            if j == 0 and frame.truth.masks.get(camera):
                yours = _right_candidate(grounding, frame.truth.masks[camera], self._goal)
            references = self._header.references.get(grounding.object, ())
            log_vote(rec, grounding, j, rgb, references, at, yours, again)

    def _flush(self) -> None:
        """Send the buffered frames as columns and write them to the file."""
        rec = self._open_stream()
        frames = self._unsent
        if not frames:
            return
        index = frame_times(frames)
        self._pictures.send(rec)
        self._send_views(frames)
        send_camera_poses(rec, index, frames)
        send_robot(rec, index, frames)
        send_method(rec, self._goal, index, frames)
        send_truth(rec, index, frames)
        self._subgoal = send_subgoals(rec, frames, self._header.row, self._subgoal)
        self._send_events([event for frame in frames for event in frame.events])
        flush_stream(rec, self.path)
        self._unsent = []

    def _send_views(self, frames: list[Frame]) -> None:
        """Masks, outlines and attention of the frames that have them."""
        rec = self._open_stream()
        pictured = [frame for frame in frames if frame.images]
        if pictured:
            index = frame_times(pictured)
            send_masks(rec, self._goal, index, pictured)
            if any(frame.truth.masks for frame in pictured):
                send_outlines(rec, self._goal, index, pictured)
        attended = [frame for frame in frames if frame.attention]
        if attended:
            send_attention(rec, attended, JPEG_QUALITY)

    def _send_events(self, events: list[Event]) -> None:
        seconds = {frame.frame_index: frame.timestamp_s for frame in self._frames}
        send_events(self._open_stream(), events, seconds)

    def _explain_episode(self, outcome: Outcome) -> Explanation:
        if self._explain is None:
            return Explanation(None, None)
        spans = tuple(self._spans)
        if not spans and outcome.subgoals:
            spans = (SubGoalSpan(self._header_of_first(), 0),)
        frames = tuple(self._frames)
        return self._explain(Episode(self._header, frames, outcome, {}, subgoals=spans))

    def _deciding_header(self, outcome: Outcome) -> EpisodeHeader:
        """That of the first sub-goal that failed; of the episode, where none did."""
        for span, ended in zip(self._spans, outcome.subgoals, strict=False):
            if not ended.success:
                return span.header
        return self._header

    def _header_of_first(self) -> EpisodeHeader:
        """What is known of the first sub-goal."""
        row = self._header.row.at(0)
        return replace(self._header, row=row, instruction=row.instruction)

    def _send_ending(self, outcome: Outcome, explanation: Explanation) -> None:
        """How the episode ended, at its last step, and why."""
        rec = self._open_stream()
        index = frame_times(self._frames)
        send_reward(rec, index, len(self._frames), outcome.success)
        self._send_events(self._ending_events(outcome, explanation.diagnosis))
        gripper_cm = None
        if explanation.trace is not None:
            gripper_cm = send_gripper(
                rec,
                self._header,
                trace=explanation.trace,
                frames=self._frames,
                diagnosis=explanation.diagnosis,
            )
        blueprint = episode_blueprint(
            self._header,
            explanation.diagnosis,
            queries=self._queries,
            axes=Axes(gripper_cm, len(self._frames)),
        )
        blueprint.send(rec)

    def _ending_events(self, outcome: Outcome, diagnosis: Diagnosis | None) -> list[Event]:
        """The deciding moment of a failure, and the end."""
        events = []
        if diagnosis is not None:
            events.append(
                Event(diagnosis.frame_index, "ERROR", f"{diagnosis.case}: {diagnosis.sub_case}")
            )
        text = f"episode ends: {describe_outcome(outcome)}"
        last = self._frames[-1].frame_index
        events.append(Event(last, OUTCOME_LEVELS[outcome.status], text))
        return events


def _right_candidate(grounding: Grounding, masks: Mapping[str, Mask], header: EpisodeHeader) -> int:
    """The candidate that is the target by its mask, the winner where it is one; -1 for none."""
    order = np.argsort(-mean_cosines(grounding), kind="stable").tolist()
    if grounding.winner is not None:
        order.insert(0, grounding.winner)
    target = header.row.target
    found = (i for i in order if covered_object(grounding.masks[i], masks) == target)
    return next(found, -1)


def rollout_properties(header: EpisodeHeader) -> rr.AnyValues:
    """What is known before the first action."""
    row = header.row
    return rr.AnyValues(
        suite=row.suite,
        task=row.task,
        episode=row.episode,
        method=header.method,
        policy=header.policy,
        seed=row.seed,
        git=code_version(),
        hz=header.hz,
        instruction=header.instruction,
        rewritten=header.rewritten,
    )


def outcome_properties(outcome: Outcome, diagnosis: Diagnosis | None) -> rr.AnyValues:
    """How the episode ended; the case of a failure, empty for any other episode."""
    return rr.AnyValues(
        outcome=outcome.status,
        success=outcome.success,
        cmr=outcome.cmr,
        steps=outcome.steps,
        success_once=outcome.success_once,
        held_steps=outcome.held_steps,
        wrong_object=outcome.wrong_object,
        first_object_correct=outcome.first_object_correct,
        detail=outcome.detail,
        **_case_properties(diagnosis),
    )


def _case_properties(diagnosis: Diagnosis | None) -> dict[str, Any]:
    if diagnosis is None:
        return {
            "case": "",
            "sub_case": "",
            "deciding_frame": np.int64(-1),
            "deciding_camera": "",
            "case_confidence": 0.0,
            "case_sentence": "",
        }
    return {
        "case": diagnosis.case,
        "sub_case": diagnosis.sub_case,
        "deciding_frame": np.int64(diagnosis.frame_index),
        "deciding_camera": diagnosis.camera,
        "case_confidence": diagnosis.confidence,
        "case_sentence": diagnosis.sentence,
    }


SUCCESSES_PER_SAMPLE = 10
"""`--record failures` keeps one success in so many, for comparison."""
MAX_BUFFER_MB = 256.0
"""Pictures of one episode that wait in memory; a longer episode then streams to disk."""
FLUSH_EVERY = 500
"""Steps per flush. Long columns are smaller and quicker.

A killed process loses the buffered steps anyway.
"""


def is_sampled(row: EpisodeRow, method: str) -> bool:
    """Whether a success is among the one in ten that is kept.

    A hash of the episode's name decides, so it is the same in every run.
    """
    name = f"{row.key}.{row.seed}.{method}"
    digest = int(hashlib.sha256(name.encode()).hexdigest(), 16)
    return digest % SUCCESSES_PER_SAMPLE == 0


def is_failure_or_sampled(outcome: Outcome, row: EpisodeRow, method: str) -> bool:
    """Whether `--record failures` keeps an episode."""
    return outcome.status != "success" or is_sampled(row, method)


class DeferredRecorder:
    """Records an episode only if `keep` says so once its outcome is known.

    Until then its frames wait in memory, without true masks where these can be drawn later.
    """

    def __init__(
        self,
        path: Path,
        header: EpisodeHeader,
        keep: Callable[[Outcome], bool],
        *,
        video: bool = False,
        explain: Explain | None = None,
    ) -> None:
        self.path = path
        self._header = header
        self._keep = keep
        self._video = video
        self._explain = explain
        self._frames: list[Frame | EpisodeHeader] = []
        """Frames, and the headers of further sub-goals between them."""
        self._buffer_mb = 0.0
        self._recorder: Recorder | None = None
        self._draw: Callable[[Frame], Frame] | None = None

    def draw_by(self, draw: Callable[[Frame], Frame]) -> None:
        """Draw the masks that frames lack by `draw`, when they are recorded."""
        self._draw = draw

    def frame(self, frame: Frame) -> None:
        """Keep one control step."""
        if self._recorder is not None:
            self._recorder.frame(self._drawn(frame))
            return
        self._frames.append(frame)
        self._buffer_mb += frame_megabytes(frame)
        if self._buffer_mb > MAX_BUFFER_MB:
            self._start_recorder()

    def begin_subgoal(self, header: EpisodeHeader) -> None:
        """Keep what is known of another sub-goal."""
        if self._recorder is not None:
            self._recorder.begin_subgoal(header)
        else:
            self._frames.append(header)

    def close(self, outcome: Outcome) -> None:
        """Write the recording, or discard it. Raises: BadOutput, when it cannot be written."""
        if self._keep(outcome):
            self._start_recorder().close(outcome)
        elif self._recorder is not None:
            self._recorder.discard()
        self._frames = []

    def _drawn(self, frame: Frame) -> Frame:
        """The frame with its true masks."""
        return frame if self._draw is None else self._draw(frame)

    def _start_recorder(self) -> Recorder:
        """The recorder, with every frame so far."""
        if self._recorder is None:
            self._recorder = Recorder(
                self.path,
                self._header,
                flush_every=FLUSH_EVERY,
                video=self._video,
                explain=self._explain,
            )
            for kept in self._frames:
                if isinstance(kept, Frame):
                    self._recorder.frame(self._drawn(kept))
                else:
                    self._recorder.begin_subgoal(kept)
            self._frames = []
        return self._recorder


def frame_megabytes(frame: Frame) -> float:
    """The memory of a frame's pictures and masks; a shared array counts once."""
    n_bytes = 0
    for image in frame.images.values():
        n_bytes += image.nbytes
    for camera, prompted in frame.prompted.items():
        if prompted is not frame.images.get(camera):
            n_bytes += prompted.nbytes
    for masks in frame.truth.masks.values():
        for mask in masks.values():
            n_bytes += mask.nbytes
    return n_bytes / 1e6
