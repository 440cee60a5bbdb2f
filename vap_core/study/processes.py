"""Runs jobs in local processes of one thread each, which end when their parent ends.

They are forked from a server process that has imported what they need. There is one server per
parent process; it starts with the first call of `prepare` or `results`.
"""

import atexit
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing import forkserver, get_context, parent_process
from signal import SIGTERM
from threading import Thread

from vap_core.base.errors import WorkerDied

FIRST = "vap_core.study.server"
LAST = "vap_core.study.server_ready"
"""What the server imports before and after everything else."""


def prepare(modules: Sequence[str]) -> None:
    """Start the server; it imports `modules` while this process goes on.

    A server that runs already stays as it is. It ends with this process, also while it imports.
    """
    _limit_threads()
    get_context("forkserver").set_forkserver_preload([FIRST, *modules, LAST])
    forkserver.ensure_running()
    atexit.unregister(_end_server)
    atexit.register(_end_server)


def _end_server() -> None:
    """End the server: one that still imports would only notice afterwards that nobody waits."""
    server = forkserver._forkserver._forkserver_pid  # type: ignore[attr-defined]
    if server is not None:
        with suppress(ProcessLookupError):
            os.kill(server, SIGTERM)


def results[J, R](
    work: Callable[[J], R], jobs: Sequence[J], workers: int, remedy: str
) -> Iterator[tuple[J, R]]:
    """Each job with the result of `work`, in the order in which the jobs finish.

    `remedy` is the option that lowers the load, for the error message.

    Raises: WorkerDied when a process was killed or exited; what `work` raises.
    """
    if not jobs:
        return
    _limit_threads()
    with ProcessPoolExecutor(
        max_workers=min(workers, len(jobs)),
        mp_context=get_context("forkserver"),
        initializer=_begin_worker,
        initargs=(dict(os.environ),),
    ) as pool:
        done = 0
        try:
            futures = {pool.submit(work, job): job for job in jobs}
            for future in as_completed(futures):
                done += 1
                yield futures[future], _result(future)
        except BrokenProcessPool as error:
            raise WorkerDied(
                "a worker process died, perhaps for lack of memory; run the same command again, "
                f"with fewer {remedy}."
            ) from error
        finally:
            processes = list((pool._processes or {}).values())
            pool.shutdown(wait=False, cancel_futures=True)
            if done < len(jobs):
                # Interrupted: no result of a running job is used, and files are written atomically.
                for process in processes:
                    process.kill()


def results_here[J, R](
    work: Callable[[J], R], jobs: Sequence[J], workers: int, remedy: str
) -> Iterator[tuple[J, R]]:
    """`results`, but with one worker in this process: its start would take longer than it saves.

    Raises: as `results`.
    """
    if workers > 1:
        yield from results(work, jobs, workers, remedy)
        return
    for job in jobs:
        yield job, work(job)


def _limit_threads() -> None:
    """One thread in each worker, whatever the environment says.

    With two, workers compete for the cores, and the last bits of an action differ.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"


def _begin_worker(environment: dict[str, str]) -> None:
    """Take over the parent's environment, which may have changed since the server started."""
    os.environ.clear()
    os.environ.update(environment)
    end_with_parent()


def _result[R](future: Future[R]) -> R:
    """What the job returned. Its sys.exit() does not end this process."""
    try:
        return future.result()
    except SystemExit as error:
        raise WorkerDied(
            f"a worker process called sys.exit({error.code!r}) outside an episode; look for the "
            "call in the policy's code."
        ) from error


def end_with_parent() -> None:
    """End this worker process when its parent ends: an orphan would write into a resumed run."""
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    Thread(target=watch, daemon=True).start()
