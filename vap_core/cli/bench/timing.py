"""How every benchmark takes time: a median of repeats, and seconds by part of running code.

Nothing of the package is imported here: lerobot_process.py loads this file by its path, to time the
loop of another checkout.
"""

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from statistics import median
from typing import Any

Clock = Callable[[], float]
"""Seconds: `time.perf_counter` for elapsed time, `time.process_time` for CPU time."""
_ABSENT = object()


def seconds_of(work: Callable[[], object], clock: Clock = time.perf_counter) -> float:
    """How long some work takes, once."""
    start = clock()
    work()
    return clock() - start


def median_seconds(
    work: Callable[[], object], repeat: int, *, warm_up: int = 1, clock: Clock = time.perf_counter
) -> float:
    """The median of `repeat` times, after `warm_up` that do not count."""
    seconds = []
    for _ in range(warm_up + repeat):
        seconds.append(seconds_of(work, clock))
    return median(seconds[warm_up:])


class Parts:
    """Seconds and calls by part, of functions that are hooked for a while.

    A part's seconds are without those of the parts that it calls. A part that is hooked as `whole`
    keeps them: inside it, no other part is counted.
    """

    def __init__(self, clock: Clock = time.process_time) -> None:
        self.clock = clock
        self.seconds: dict[str, float] = {}
        self.calls: dict[str, int] = {}
        self._inside: list[float] = []
        """Seconds that inner parts have taken, for every part that is running."""
        self._whole = False

    @contextmanager
    def hooked(self, owner: Any, name: str, part: str, *, whole: bool = False) -> Iterator[None]:
        """Inside, calls of `owner.name` count for `part`; `owner` is a module, class or object."""
        before = vars(owner).get(name, _ABSENT)
        setattr(owner, name, self.timed(getattr(owner, name), part, whole=whole))
        try:
            yield
        finally:
            if before is _ABSENT:
                delattr(owner, name)
            else:
                setattr(owner, name, before)

    def timed(
        self, work: Callable[..., Any], part: str, *, whole: bool = False
    ) -> Callable[..., Any]:
        """`work`, whose calls count for `part`."""
        self.seconds.setdefault(part, 0.0)
        self.calls.setdefault(part, 0)

        @functools.wraps(work)
        def counted(*args: Any, **kwargs: Any) -> Any:
            if self._whole:
                return work(*args, **kwargs)
            self._whole = whole
            self._inside.append(0.0)
            start = self.clock()
            try:
                return work(*args, **kwargs)
            finally:
                seconds = self.clock() - start
                self.seconds[part] += seconds - self._inside.pop()
                self.calls[part] += 1
                self._whole = False
                if self._inside:
                    self._inside[-1] += seconds

        return counted

    def with_rest(self, total: float) -> dict[str, float]:
        """Seconds by part, and as "rest" what `total` seconds have beyond them."""
        return {**self.seconds, "rest": total - sum(self.seconds.values())}

    def cost_of_a_call(self) -> float:
        """Seconds that counting one call takes, measured on a function that does nothing."""
        probe = Parts(self.clock)
        empty = probe.timed(lambda: None, "")
        n = 2000

        def call() -> None:
            for _ in range(n):
                empty()

        return median_seconds(call, 5, clock=self.clock) / n
