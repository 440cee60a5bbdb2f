"""Work in local processes of one thread each, which end when their parent does, however that ended."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from threading import Thread

from vap_core.errors import WorkerDied


def results[J, R](work: Callable[[J], R], jobs: Sequence[J], workers: int, mend: str) -> Iterator[tuple[J, R]]:
    """Each job with what `work` made of it, in the order in which they finish; `mend` says which option lessens the load.

    Raises: WorkerDied when a process was killed; what `work` raises.
    """
    if not jobs:
        return
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # inherited by the workers: two threads in each would fight over the cores
    with ProcessPoolExecutor(min(workers, len(jobs)), mp_context=get_context("spawn"), initializer=end_with_parent) as pool:
        done = 0
        try:
            futures = {pool.submit(work, job): job for job in jobs}
            for future in as_completed(futures):
                done += 1
                yield futures[future], future.result()
        except BrokenProcessPool as error:
            raise WorkerDied(f"a worker process died, perhaps for lack of memory; run the same command again, with fewer {mend}.") from error
        finally:
            processes = list((pool._processes or {}).values())
            pool.shutdown(wait=False, cancel_futures=True)
            if done < len(jobs):  # interrupted: nobody waits for what is half done, and what is kept is whole
                for process in processes:
                    process.kill()


def end_with_parent() -> None:
    """Let this worker process end when its parent does: an orphan would write into a resumed run."""
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    Thread(target=watch, daemon=True).start()
