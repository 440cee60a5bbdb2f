"""Which episodes become recordings: it is decided when they end, so that what is not kept costs next to nothing."""

import hashlib
from collections.abc import Callable
from pathlib import Path

from vap_core.record.recorder import Recorder
from vap_core.values import EpisodeRow, Frame, Opening, Outcome

ONE_IN = 10
"""Of the successes that "failures" keeps for comparison."""
MOST_MB = 256.0
"""Pictures of one episode that wait in memory; a longer one streams to disk from there on."""
TOGETHER = 500
"""Steps that are written at once, since nothing of them is lost by a kill that was not lost anyway: long columns are smaller and quicker."""


def sampled(row: EpisodeRow, method: str) -> bool:
    """Whether a success is among the one in ten that is kept: decided by its name alone, the same in every run."""
    return int(hashlib.sha256(f"{row.key}.{row.seed}.{method}".encode()).hexdigest(), 16) % ONE_IN == 0


def wanted(outcome: Outcome, row: EpisodeRow, method: str) -> bool:
    """What "failures" keeps."""
    return outcome.status != "success" or sampled(row, method)


class Waiting:
    """A sink that records an episode only if `keep` says so once its outcome is known; until then its frames wait in memory."""

    def __init__(self, path: Path, opening: Opening, keep: Callable[[Outcome], bool], *, video: bool = False) -> None:
        self.path, self._opening, self._keep, self._video = path, opening, keep, video
        self._frames: list[Frame] = []
        self._held_mb = 0.0
        self._recorder: Recorder | None = None

    def frame(self, frame: Frame) -> None:
        if self._recorder is not None:
            self._recorder.frame(frame)
            return
        self._frames.append(frame)
        self._held_mb += _megabytes(frame)
        if self._held_mb > MOST_MB:
            self._begin()

    def close(self, outcome: Outcome) -> None:
        """Write the recording, or forget it. Raises: BadOutput, when it cannot be written."""
        if self._keep(outcome):
            self._begin().close(outcome)
        elif self._recorder is not None:
            self._recorder.discard()
        self._frames = []

    def _begin(self) -> Recorder:
        if self._recorder is None:
            self._recorder = Recorder(self.path, self._opening, flush_every=TOGETHER, video=self._video)
            for frame in self._frames:
                self._recorder.frame(frame)
            self._frames = []
        return self._recorder


def _megabytes(frame: Frame) -> float:
    pictures = [*frame.images.values(), *(shown for cam, shown in frame.prompted.items() if shown is not frame.images.get(cam))]
    masks = [mask for of_view in frame.truth.masks.values() for mask in of_view.values()]
    return (sum(part.nbytes for part in pictures) + sum(mask.nbytes for mask in masks)) / 1e6
