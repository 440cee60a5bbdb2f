"""Which episodes become recordings: decided when they end, so that the others cost little."""

import hashlib
from collections.abc import Callable
from pathlib import Path

from vap_core.recording.recorder import Recorder
from vap_core.rollout.failure import Explain
from vap_core.rollout.types import EpisodeHeader, Frame
from vap_core.simulation.types import EpisodeRow, Outcome

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
