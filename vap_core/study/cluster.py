"""Runs jobs on a Ray cluster, as `processes.results` does in local processes.

Its machines need this package and no shared disk: the memory travels with the job, and the files
that a job writes are sent back.

    engine.run(study, folder, executor=cluster.ray_executor("10.0.0.5:6379"))
"""

import logging
import os
import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import BadCluster, WorkerDied
from vap_core.base.files import write_atomic, writing
from vap_core.study.store import differences, digest, read_manifest

if TYPE_CHECKING:
    from vap_core.study.engine import Executor, Job, Rows

Files = dict[str, bytes]
"""Contents by path below a run's folder."""
MEMORY = "memory"


def ray_executor(address: str) -> "Executor":
    """An executor on the cluster at `address` (host:port). Raises: BadCluster."""
    if address.startswith(("127.", "localhost")):
        # Otherwise Ray connects to this machine's outward address, and a cluster on loopback does
        # not listen there.
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray  # noqa: F401
    except ImportError as error:
        raise BadCluster(
            "cluster: ray is not installed; run: pip install 'vap-core[ray]'"
        ) from error

    def results(
        work: "Callable[[Job], Rows]", jobs: "Sequence[Job]", workers: int, remedy: str
    ) -> "Iterator[tuple[Job, Rows]]":
        return _results(address, work, jobs, workers)

    return results


def _results(
    address: str, work: "Callable[[Job], Rows]", jobs: "Sequence[Job]", workers: int
) -> "Iterator[tuple[Job, Rows]]":
    """At most `workers` jobs at once; 0: as many as the cluster has CPUs."""
    import ray

    if not jobs:
        return
    _connect(address)
    try:
        yield from _run_all(work, jobs, workers)
    except (
        ray.exceptions.WorkerCrashedError,
        ray.exceptions.NodeDiedError,
        ray.exceptions.OutOfMemoryError,
        ray.exceptions.ObjectLostError,
    ) as error:
        raise WorkerDied(
            "a worker of the cluster died, perhaps for lack of memory; run the same command "
            "again, with fewer --workers."
        ) from error
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error
    finally:
        ray.shutdown()


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
            "start one with `ray start --head --disable-usage-stats --node-ip-address 127.0.0.1 "
            "--port 6379`."
        ) from error


def _run_all(
    work: "Callable[[Job], Rows]", jobs: "Sequence[Job]", workers: int
) -> "Iterator[tuple[Job, Rows]]":
    """Every job with its rows; the files that it wrote are in the run's folder by then."""
    import ray

    folder = jobs[0].folder
    remote_run = ray.remote(num_cpus=1, max_retries=0)(_run_remotely)
    memory = ray.put(_read_files(folder / MEMORY))
    manifest = read_manifest(folder)
    limit = workers or int(ray.cluster_resources().get("CPU", 1))
    pending = list(reversed(jobs))
    running: dict[ray.ObjectRef, Job] = {}
    while pending or running:
        while pending and len(running) < limit:
            job = pending.pop()
            running[remote_run.remote(work, job, memory, manifest)] = job
        (done,), _ = ray.wait(list(running), num_returns=1)
        rows, files = ray.get(done)
        _write_files(folder, files)
        yield running.pop(done), rows


def _run_remotely(
    work: "Callable[[Job], Rows]", job: "Job", memory: Files, manifest: dict[str, Any]
) -> "tuple[Rows, Files]":
    """Run one job on another machine, in a folder of its own.

    Raises: BadCluster when that machine has other weights, lists or code; BadSuite when the file of
        an own suite is not at the same path there; BadOutput when its disk is full.
    """
    job.study.open_suites()
    configuration = job.study.configuration()
    if digest(configuration) != manifest["digest"]:
        raise BadCluster(
            f"cluster: {platform.node()} is not like this machine "
            f"({differences(manifest, configuration)}); install the same version on all."
        )
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for name, data in memory.items():
            path = folder / MEMORY / name
            with writing(path, "cluster"):
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)
        rows = work(replace(job, folder=folder))
        written: Files = {}
        for name, data in _read_files(folder).items():
            if not name.startswith(f"{MEMORY}/"):
                written[name] = data
    return rows, written


def _read_files(folder: Path) -> Files:
    files: Files = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            files[path.relative_to(folder).as_posix()] = path.read_bytes()
    return files


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
