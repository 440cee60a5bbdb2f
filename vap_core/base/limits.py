"""Limits of memory and time on work with files from outside, inside this process."""

import resource
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LARGEST_SEED = 2**32
"""Seeds are smaller: a date is one."""
PAGES = Path("/proc/self/statm")
"""Linux counts this process's pages here, the address space first."""
AGAIN_S = 1.0
"""Libraries that catch every exception are interrupted again after so much CPU time."""


class _TimeIsUp(BaseException):
    """Raised inside the work. No `except Exception` of a library's catches it."""


@contextmanager
def bounded(memory_bytes: int, cpu_s: float) -> Iterator[None]:
    """The block may take so much more memory, and so much CPU time.

    Memory is limited on Linux. Time is limited in the main thread, where signal handlers run; a
    call into C that does not return is not interrupted.

    Raises: MemoryError; TimeoutError.
    """
    try:
        with _memory_limit(memory_bytes), _timer(cpu_s):
            yield
    except _TimeIsUp:
        raise TimeoutError(f"over {cpu_s:g} s of CPU time") from None


@contextmanager
def _memory_limit(more_bytes: int) -> Iterator[None]:
    if not PAGES.exists():
        yield
        return
    taken = int(PAGES.read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = taken + more_bytes
    if soft != resource.RLIM_INFINITY:
        limit = min(limit, soft)
    resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@contextmanager
def _timer(cpu_s: float) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_: object) -> None:
        raise _TimeIsUp

    former = signal.signal(signal.SIGPROF, interrupt)
    signal.setitimer(signal.ITIMER_PROF, cpu_s, AGAIN_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, former)
