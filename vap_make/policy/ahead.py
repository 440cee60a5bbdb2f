"""Batches drawn ahead of the steps that learn from them, in processes of one thread each.

Drawing a batch takes a core longer than a GPU takes to learn from it.
"""

import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
from torch.utils.data import DataLoader, Dataset

from vap_core.base.errors import WorkerDied
from vap_make.policy.batches import Batch, Frames

MOST = 8
"""Processes that draw, at most: six keep up with an H100."""


class Ahead:
    """The batches of steps that follow each other, drawn ahead by `jobs` processes, or by MOST.

    With one job they are drawn in this process, when they are asked for. A step's batch depends on
    its number alone. `cpu_s` are the CPU seconds of other processes for the batches taken so far.
    """

    def __init__(self, frames: Frames, jobs: int) -> None:
        self.cpu_s = 0.0
        self._steps = _Steps(frames)
        self._jobs = min(jobs, MOST)
        self._drawn: Iterator[tuple[Batch, float]] | None = None
        self._handler: Any = None

    def take(self, step: int) -> Batch:
        """The batch of a step: of the first that is asked for, and then of the next, in turn.

        Raises: WorkerDied.
        """
        if self._drawn is None:
            loader = DataLoader(
                self._steps,
                batch_size=None,
                sampler=range(step, self._steps.frames.recipe.steps),
                num_workers=self._jobs if self._jobs > 1 else 0,
                # The films are in memory; a copy a process would not fit.
                multiprocessing_context="fork" if self._jobs > 1 else None,
                worker_init_fn=_begin_worker,
            )
            self._drawn = cast(Iterator[tuple[Batch, float]], iter(loader))
            self._ignore_deaths()
        try:
            batch, cpu_s = next(self._drawn)
        except RuntimeError as error:
            # An error of `draw` itself says "in DataLoader worker process".
            if "DataLoader worker (pid" not in str(error):
                raise
            self.close()
            raise WorkerDied(
                "a process that draws batches died, perhaps for lack of memory; run the same "
                "command again, with fewer jobs."
            ) from error
        if self._jobs > 1:
            self.cpu_s += cpu_s
        return batch

    def close(self) -> None:
        """End the processes."""
        self._drawn = None
        if self._handler is not None:
            signal.signal(signal.SIGCHLD, self._handler)
            self._handler = None

    def _ignore_deaths(self) -> None:
        """Let `take` alone find that a process died, within seconds.

        torch's handler of SIGCHLD raises wherever the main thread is at that moment.
        """
        if self._jobs > 1 and threading.current_thread() is threading.main_thread():
            self._handler = signal.signal(signal.SIGCHLD, signal.SIG_DFL)


@dataclass
class _Steps(Dataset[tuple[Batch, float]]):
    """The batch of a step, by its number, and the CPU seconds that it took."""

    frames: Frames

    def __getitem__(self, step: int) -> tuple[Batch, float]:
        started = time.process_time()
        recipe = self.frames.recipe
        batch = self.frames.draw(recipe.batch, np.random.default_rng([73, recipe.seed, step]))
        return batch, time.process_time() - started


def _begin_worker(number: int) -> None:
    cv2.setNumThreads(0)
