"""Runs jobs in local processes of one thread each, which end when their parent ends; or on Ray.

Local workers are forked from a server process that has imported what they need. There is one
server per parent process; it starts with the first call of `prepare` or `results`. The machines of
a Ray cluster need this package and no shared disk: a run's memory travels with the job, and the
files that a job writes are sent back.
"""

import atexit
import logging
import os
import platform
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import replace
from multiprocessing import forkserver, get_context, parent_process
from pathlib import Path, PurePosixPath
from signal import SIGTERM
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any

from vap_core.base.errors import BadCluster, WorkerDied
from vap_core.base.files import write_atomic, writing

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


Files = dict[str, bytes]
"""Contents by path below a run's folder."""
MEMORY = "memory"


def ray_executor(address: str) -> Callable[..., Iterator[tuple[Any, Any]]]:
    """`results` on the Ray cluster at `address` (host:port): at most so many workers at once; 0: as
    many as the cluster has CPUs. Jobs have a `folder`, and `settings()`.

    Raises: BadCluster.
    """
    if address.startswith(("127.", "localhost")):
        # Otherwise Ray connects to this machine's outward address, and a cluster on loopback does
        # not listen there.
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise BadCluster(
            "cluster: ray is not installed; run: pip install 'vap-core[ray]'"
        ) from error

    def on_ray(
        work: Callable[[Any], Any], jobs: Sequence[Any], workers: int, remedy: str
    ) -> Iterator[tuple[Any, Any]]:
        if not jobs:
            return
        _connect(address)
        failed = ray.exceptions
        try:
            yield from _run_all(work, jobs, workers)
        except (
            failed.WorkerCrashedError,
            failed.NodeDiedError,
            failed.OutOfMemoryError,
            failed.ObjectLostError,
        ) as error:
            raise WorkerDied(
                "a worker of the cluster died, perhaps for lack of memory; run the same command "
                "again, with fewer --workers."
            ) from error
        except failed.RayTaskError as error:
            raise error.cause from error
        finally:
            ray.shutdown()

    return on_ray


def _connect(address: str) -> None:
    import ray

    try:
        ray.init(
            address=address,
            log_to_driver=False,
            logging_level=logging.ERROR,
            runtime_env={"env_vars": {"OMP_NUM_THREADS": "1"}},
        )
    except (ConnectionError, RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise BadCluster(
            f"cluster: no Ray cluster answers at {address!r} ({reason:.120}); "
            "start one with `ray start --head --disable-usage-stats --include-dashboard false "
            "--node-ip-address 127.0.0.1 --port 6379`."
        ) from error


def _run_all(
    work: Callable[[Any], Any], jobs: Sequence[Any], workers: int
) -> Iterator[tuple[Any, Any]]:
    """Every job with its result; the files that it wrote are in the run's folder by then."""
    import ray

    from vap_core.study.store import read_manifest

    folder = jobs[0].folder
    remote_run = ray.remote(num_cpus=1, max_retries=0)(_run_remotely)
    memory = ray.put(_read_files(folder / MEMORY))
    manifest = read_manifest(folder)
    limit = workers or int(ray.cluster_resources().get("CPU", 1))
    pending = list(reversed(jobs))
    running: dict[ray.ObjectRef, Any] = {}
    while pending or running:
        while pending and len(running) < limit:
            job = pending.pop()
            running[remote_run.remote(work, job, memory, manifest)] = job
        (done,), _ = ray.wait(list(running), num_returns=1)
        result, files = ray.get(done)
        _write_files(folder, files)
        yield running.pop(done), result


def _run_remotely(
    work: Callable[[Any], Any], job: Any, memory: Files, manifest: dict[str, Any]
) -> tuple[Any, Files]:
    """Run one job on another machine, in a folder of its own.

    Raises: BadCluster when that machine has other weights, lists or code; BadSuite when the file of
        an own suite is not at the same path there; BadOutput when its disk is full.
    """
    from vap_core.study.store import differences, digest

    settings = job.settings()
    if digest(settings) != manifest["digest"]:
        raise BadCluster(
            f"cluster: {platform.node()} is not like this machine "
            f"({differences(manifest, settings)}); install the same version on all."
        )
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        _write_files(folder, {f"{MEMORY}/{name}": data for name, data in memory.items()})
        result = work(replace(job, folder=folder))
        written = _read_files(folder)
    return result, {k: data for k, data in written.items() if not k.startswith(f"{MEMORY}/")}


def _read_files(folder: Path) -> Files:
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def _write_files(folder: Path, files: Files) -> None:
    """Raises: BadOutput; BadCluster when the other machine names a file outside the folder."""
    for name in files:
        parts = PurePosixPath(name).parts
        if not parts or PurePosixPath(name).is_absolute() or ".." in parts:
            raise BadCluster(
                f"cluster: a worker sent a file named {name[:80]!r}, outside the run's folder; "
                "join clusters that you trust only."
            )
    with writing(folder, "cluster"):
        for name, data in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_atomic(folder / name, data)
