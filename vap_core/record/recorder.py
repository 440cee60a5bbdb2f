"""Episode -> .rrd: one Rerun recording per rollout, streamed to disk while it happens.

Entities (lerobot's feature keys; timelines `frame_index` and `timestamp`):
`/observation.images.<cam>` with `/prompted`, `/candidates`, `/mask/{target,gt}` beneath; `/observation.state`, `/action`,
`/next.reward`, `/next.success`; `/vap/{votes,candidates,vote_margin,track_score}/<cam>`, `/vap/{instruction,events}`,
`/vap/status/{outcome,grasp}`; `/world/{table,robot/link*,objects/*}`. Evidence of a further target j ends in `_j`;
`/candidates` carries the picture the vote was held on, `/vap/votes/<cam>` its `counts`, with `/winner` and `/others` as bars;
`/vap/association` is what the views agreed on, when they were asked together.
`/observation.images.<cam>/identity` colours each prompt by the object it covers; `/vap/{similarity,crops}/<cam>` are what the vote compared;
`/vap/hand/*` is where the hand was; `/vap/attention/<cam>` and `/observation.images.<cam>/attention` are where the policy
looked. Recording properties: `rollout` and `outcome`, which says why an episode failed (module failures).
Pictures are JPEG or AV1, at the steps that have them; everything that changes travels in columns.
"""

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from vap_core.errors import BadOutput
from vap_core.failures import diagnose, follow, told
from vap_core.record import why
from vap_core.record.blueprint import SERIES, episode_blueprint, evidence_line, grounding_blueprint, packed, series_style, state_style
from vap_core.record.evidence import CLASSES, classes, contact_sheet, jpeg, log_association, log_vote, picture, send_classes, suffix, words
from vap_core.record.file import finish_stream, open_stream, put, put_property, temporary
from vap_core.record.pictures import Pictures, Reels, Stills, time_index
from vap_core.record.scene import log_cameras, log_links, log_objects, log_table, send_poses, send_truth
from vap_core.values import Episode, Event, Frame, Grounding, Mask, Opening, Outcome, PersonalObject, Rgb
from vap_core.version import code_version

STATE_NAMES = ("x", "y", "z", "rx", "ry", "rz", "gripper")
OUTCOMES = {"success": (40, 140, 85), "failure": (190, 120, 30), "error": (190, 60, 60)}
GRASPS = {
    "free": (70, 78, 92),
    "touches target": (130, 100, 50),
    "holds target": (210, 125, 30),
    "touches other": (80, 95, 150),
    "holds other": (85, 120, 220),
}
LEVEL_COLOURS = {"INFO": (150, 200, 255), "WARN": (255, 190, 60), "ERROR": (255, 95, 95)}


def grasp_state(frame: Frame, target: str) -> str:
    """What the gripper has to do with the objects at one step."""
    held, touched = frame.truth.held, frame.truth.touched
    for verb, names in (("holds", held), ("touches", touched)):
        if names:
            return f"{verb} target" if target in names else f"{verb} other"
    return "free"


class Recorder:
    """Streams one episode to disk; what was flushed outlives the process (`recover`).

    `frame` buffers; every `flush_every` frames the buffered columns go to the file. `close` writes the ending and renames
    the file. `video` keeps pictures as AV1, much smaller for more time.
    Left through an exception, the context manager keeps the unfinished file under its temporary name.

    Raises: BadOutput, when `path` exists or its folder cannot be written.
    """

    def __init__(self, path: Path, opening: Opening, *, flush_every: int = 10, jpeg_quality: int = 90, video: bool = False) -> None:
        row = opening.row
        self.path = Path(path)
        self._opening, self._flush_every, self._quality = opening, flush_every, jpeg_quality
        self._steps: list[int] = []
        self._times: list[float] = []
        self._frames: list[Frame] = []
        self._pictures: Pictures = Reels(opening.hz) if video else Stills(jpeg_quality)
        self._course: list[Frame] = []
        self._grasp: str | None = None
        self._looked = False
        self._rec: rr.RecordingStream | None = open_stream(self.path, f"{row.key}.s{row.seed}.{opening.method}.{opening.policy}")
        self._rec.send_recording_name(f"{row.key} · {opening.method}")
        put_property(self._rec, "rollout",
            rr.AnyValues(
                suite=row.suite, task=row.task, episode=row.episode, method=opening.method, policy=opening.policy, seed=row.seed, git=code_version(),
                hz=opening.hz, instruction=opening.instruction, rewritten=opening.rewritten,
            ),
        )  # fmt: skip
        put(self._rec, "/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.AnnotationContext([*CLASSES, *why.identity_classes(opening)]))
        put(self._rec, "/vap/instruction", words(opening))
        log_table(self._rec, row)
        log_objects(self._rec, opening)

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, kind: type[BaseException] | None, err: BaseException | None, trace: TracebackType | None) -> None:
        if self._rec is not None:
            self._flush()
            self._rec.flush()
            self._rec.disconnect()
            self._rec = None

    def frame(self, frame: Frame) -> None:
        """Take one control step."""
        if not self._steps:
            self._first(frame, {cam: jpeg(raw, self._quality) for cam, raw in frame.images.items()})
        self._pictures.take(frame)
        self._steps.append(frame.frame_index)
        self._times.append(frame.timestamp_s)
        self._frames.append(frame)
        self._course.append(frame.light())
        if len(self._frames) >= self._flush_every:
            self._flush()

    def close(self, outcome: Outcome) -> None:
        """Flush, write outcome, diagnosis and footer, and give the recording its name.

        Raises: BadOutput, when a file of that name appeared meanwhile.
        """
        rec = self._stream()
        self._flush()
        self._pictures.send(rec, last=True)
        episode = Episode(self._opening, tuple(self._course), outcome, {})
        course = follow(episode) if told(episode) else None
        diagnosis = diagnose(episode, course=course)
        verdict = self._verdict(outcome)
        if self._steps:
            n = len(self._steps)
            done = np.zeros(n)
            done[-1] = float(outcome.success)
            index = self._index(self._steps, self._times)
            rec.send_columns("/next.reward", index, rr.Scalars.columns(scalars=done))
            rec.send_columns("/next.success", index, rr.Scalars.columns(scalars=done))
            # The whole lane wears the ending: a state that starts on the last step would have no width.
            rec.send_columns("/vap/status/outcome", self._index(self._steps[:1], self._times[:1]), rr.StateChange.columns(state=[outcome.status]))
            level = {"success": "INFO", "failure": "WARN", "error": "ERROR"}[outcome.status]
            decided = [] if diagnosis is None else [why.event(diagnosis)]
            self._send_events([*decided, Event(self._steps[-1], level, f"episode ends: {verdict}")])  # type: ignore[arg-type]
            if course is not None:
                why.send_hand(rec, course, index)
            if diagnosis is not None:
                episode_blueprint(self._opening, diagnosis, looked=self._looked).send(rec)
        put(rec, "/vap/instruction", words(self._opening, verdict, "" if diagnosis is None else why.verdict(diagnosis)))
        put_property(rec, "outcome",
            rr.AnyValues(
                status=outcome.status, success=outcome.success, cmr=outcome.cmr, length=outcome.steps,
                success_once=outcome.success_once, held_steps=outcome.held_steps, wrong_object=outcome.wrong_object,
                first_object_correct=outcome.first_object_correct, detail=outcome.detail, **why.property_of(diagnosis),
            ),
        )  # fmt: skip
        self._rec = None
        finish_stream(rec, self.path)

    def discard(self) -> None:
        """End without a recording; what was flushed is deleted."""
        self._stream().disconnect()
        self._rec = None
        temporary(self.path).unlink(missing_ok=True)

    @staticmethod
    def _verdict(outcome: Outcome) -> str:
        parts = [outcome.status, f"{outcome.steps} steps", "moved a wrong object" if outcome.wrong_object else "", outcome.detail]
        return ", ".join(part for part in parts if part)

    def _stream(self) -> rr.RecordingStream:
        if self._rec is None:
            raise BadOutput(f"record: {self.path} is closed; open another Recorder for another episode.")
        return self._rec

    @staticmethod
    def _index(steps: Sequence[int], times: Sequence[float]) -> list[rr.TimeColumn]:
        return time_index(list(zip(steps, times, strict=True)))

    def _first(self, frame: Frame, pictures: dict[str, np.ndarray]) -> None:
        """What only the first step can tell: shapes, links, and the pictures the vote was held on."""
        rec, opening = self._stream(), self._opening
        names = (*STATE_NAMES, *(f"joint{i}" for i in range(1, len(frame.state))))[: len(frame.state)]
        put(rec, "/action", series_style(self._opening.action_names))
        put(rec, "/observation.state", series_style(names))
        for entity, width in (("vote_margin", 2.5), ("track_score", 2.0)):
            for i, (cam, per_view) in enumerate(opening.groundings.items()):
                for j in range(len(per_view)):
                    style = rr.SeriesLines(names=f"{cam}{suffix(j)}", colors=SERIES[i % len(SERIES)], widths=width)
                    put(rec, f"/vap/{entity}/{cam}{suffix(j)}", style)
        log_cameras(rec, frame, SERIES)
        put(rec, "/vap/status/outcome", state_style(OUTCOMES))
        put(rec, "/vap/status/grasp", state_style(GRASPS))
        log_links(rec, frame.truth)
        at = self._index([frame.frame_index], [frame.timestamp_s])
        for cam in pictures:
            per_view = opening.groundings.get(cam, ())
            for j, grounding in enumerate(per_view):
                log_vote(rec, grounding, j, None if j else pictures[cam], at)
                if j == 0:
                    why.log_compared(rec, grounding, frame.images[cam], opening.references.get(grounding.object, ()), at)
            if not per_view:
                put(rec, f"/observation.images.{cam}/candidates", picture(pictures[cam]), at=at)
        for j, association in enumerate(opening.associations):
            if association is not None:
                log_association(rec, association, j, at)
        self._looked = bool(frame.attention)
        episode_blueprint(opening, looked=self._looked).send(rec)

    def _flush(self) -> None:
        """Send the buffered steps as columns and push them to the file."""
        rec, frames = self._stream(), self._frames
        if not frames:
            return
        index = self._index(self._steps[-len(frames) :], self._times[-len(frames) :])
        self._pictures.send(rec)
        seen = [frame for frame in frames if frame.images]
        if seen:
            at = self._index([frame.frame_index for frame in seen], [frame.timestamp_s for frame in seen])
            self._send_masks(at, seen)
            if any(frame.shown for frame in seen):
                why.send_identities(rec, self._opening, at, seen)
        if looked := [frame for frame in frames if frame.attention]:
            why.send_attention(rec, looked, self._quality)
        self._send_cameras(index)
        rec.send_columns("/observation.state", index, rr.Scalars.columns(scalars=np.stack([f.state for f in frames])))
        acted = [(f.frame_index, f.timestamp_s, f.action) for f in frames if f.action is not None]
        if acted:
            at_steps, at_times, actions = zip(*acted, strict=True)
            rec.send_columns("/action", self._index(at_steps, at_times), rr.Scalars.columns(scalars=np.stack(actions)))
        for cam, per_view in self._opening.groundings.items():
            for j, grounding in enumerate(per_view):
                followed = [f for f in frames if f.tracks.get(cam, ())[j : j + 1]]
                at = self._index([f.frame_index for f in followed], [f.timestamp_s for f in followed])
                scores = np.array([f.tracks[cam][j].score for f in followed])
                rec.send_columns(f"/vap/vote_margin/{cam}{suffix(j)}", index, rr.Scalars.columns(scalars=np.full(len(frames), grounding.margin)))
                if followed:
                    rec.send_columns(f"/vap/track_score/{cam}{suffix(j)}", at, rr.Scalars.columns(scalars=scores))
        send_truth(rec, index, [f.truth for f in frames])
        self._send_grasp()
        self._send_events([event for f in frames for event in f.events])
        rec.flush()
        self._frames = []

    def _send_cameras(self, index: list[rr.TimeColumn]) -> None:
        for i, camera in enumerate(self._frames[0].cameras):
            poses = np.stack([f.cameras[i].pose_world for f in self._frames])
            send_poses(self._stream(), f"/observation.images.{camera.name}", index, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat())

    def _send_masks(self, index: list[rr.TimeColumn], frames: Sequence[Frame]) -> None:
        """The track and the truth of every target; a lost track is an empty mask."""
        for camera in frames[0].cameras:
            cam, shape = camera.name, (camera.height, camera.width)
            targets = self._opening.groundings.get(cam, ())
            for j in range(max(1, len(targets))):
                model = self._opening.row.target if j == 0 else targets[j].object
                if j < len(targets):
                    tracks = [f.tracks.get(cam, ())[j : j + 1] for f in frames]
                    self._send_classes(index, f"{cam}/mask/target{suffix(j)}", [t[0].mask if t else None for t in tracks], shape, 1)
                if any(model in f.truth.masks.get(cam, {}) for f in frames):
                    seen = [f.truth.masks.get(cam, {}).get(model) for f in frames]
                    self._send_classes(index, f"{cam}/mask/gt{suffix(j)}", seen, shape, 3)

    def _send_classes(self, index: list[rr.TimeColumn], tail: str, masks: Sequence[Mask | None], shape: tuple[int, int], inside: int) -> None:
        blank = np.zeros(shape, np.uint8)
        images = [blank if mask is None else classes(mask, inside, 2 if inside == 1 else 1) for mask in masks]
        send_classes(self._stream(), f"/observation.images.{tail}", index, images, float(inside))

    def _send_grasp(self) -> None:
        """Only changes: a state lasts until the next."""
        changes = []
        for i, frame in enumerate(self._frames, start=len(self._steps) - len(self._frames)):
            state = grasp_state(frame, self._opening.row.target)
            if state != self._grasp:
                changes.append((i, state))
                self._grasp = state
        if changes:
            index = self._index([self._steps[i] for i, _ in changes], [self._times[i] for i, _ in changes])
            self._stream().send_columns("/vap/status/grasp", index, rr.StateChange.columns(state=[state for _, state in changes]))

    def _send_events(self, events: Sequence[Event]) -> None:
        if events:
            at = dict(zip(self._steps, self._times, strict=True))
            index = self._index([e.frame_index for e in events], [at.get(e.frame_index, self._times[-1]) for e in events])
            colours = np.array([packed(LEVEL_COLOURS[e.level]) for e in events], np.uint32)
            columns = rr.TextLog.columns(text=[e.text for e in events], level=[e.level for e in events], color=colours)
            self._stream().send_columns("/vap/events", index, columns)


def record_grounding(path: Path, image: Rgb, grounding: Grounding, obj: PersonalObject, text: str, rewritten: str, prompted: Rgb) -> None:
    """A one-picture recording for `vap_core ground`: the vote, its references and similarities, the mask, the prompt.

    Raises: BadOutput, when `path` exists or its folder cannot be written.
    """
    cam, path = grounding.camera, Path(path)
    root = f"/observation.images.{cam}"
    rec = open_stream(path, f"ground.{grounding.object}.{cam}.{path.stem}")
    rec.send_recording_name(f"ground · {grounding.object}")
    put(rec, "/", rr.AnnotationContext(CLASSES))
    at = [rr.TimeColumn("frame_index", sequence=[0]), rr.TimeColumn("timestamp", duration=[0.0])]
    seen = jpeg(image, 95)
    put(rec, root, picture(seen), at=at)
    put(rec, f"{root}/prompted", picture(jpeg(prompted, 95)), at=at)
    log_vote(rec, grounding, 0, seen, at)
    if grounding.mask is not None:
        put(rec, f"{root}/mask/target", rr.SegmentationImage(classes(grounding.mask, 1, 2), opacity=1.0), at=at)
    put(rec, "/vap/references", picture(jpeg(contact_sheet(obj.crops), 95)), at=at)
    if len(grounding.candidates):
        put(rec, f"/vap/similarity/{cam}", rr.Tensor(grounding.similarity, dim_names=("candidate", "reference")), at=at)
    lines = [f'**said** "{text}"', f'**policy reads** "{rewritten}"', evidence_line(grounding)]
    lines.append(f"{obj.name} · {obj.category} · {len(obj.crops)} references · {obj.encoder}")
    put(rec, "/vap/instruction", rr.TextDocument("\n\n".join(lines), media_type=rr.MediaType.MARKDOWN), at=at)
    grounding_blueprint(cam, grounding).send(rec)
    finish_stream(rec, path)
