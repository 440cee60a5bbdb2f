"""Jobs on a Ray cluster. Its machines need this package and no shared disk: the memory travels with the job, what a job writes comes back.

engine.run(study, folder, spread=cluster.spread("10.0.0.5:6379"))
"""

import logging
import os
import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from vap_core.errors import BadCluster, BadOutput, WorkerDied
from vap_core.files import write_atomic
from vap_core.store import differences, digest, note

if TYPE_CHECKING:
    from vap_core.engine import Job, Rows, Spread

Files = dict[str, bytes]
"""Contents by path below a run's folder."""
MEMORY = "memory"


def spread(address: str) -> "Spread":
    """`processes.results` over the cluster at `address` (host:port). Raises: BadCluster."""
    if address.startswith(("127.", "localhost")):  # else Ray asks at this machine's outward address, where a cluster on loopback is deaf
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    try:
        import ray  # noqa: F401
    except ImportError as error:
        raise BadCluster("cluster: ray is not installed; run: pip install 'ray>=2.50'") from error

    def results(work: "Callable[[Job], Rows]", jobs: "Sequence[Job]", workers: int, mend: str) -> "Iterator[tuple[Job, Rows]]":
        return _results(address, work, jobs, workers)

    return results


def _results(address: str, work: "Callable[[Job], Rows]", jobs: "Sequence[Job]", workers: int) -> "Iterator[tuple[Job, Rows]]":
    """At most `workers` jobs at once; 0: as many as the cluster has CPUs."""
    import ray

    if not jobs:
        return
    home = jobs[0].folder
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, runtime_env={"env_vars": {"OMP_NUM_THREADS": "1"}})
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise BadCluster(
            f"cluster: no Ray cluster answers at {address!r} ({str(error).strip().splitlines()[0]:.120}); "
            "start one with `ray start --head --node-ip-address 127.0.0.1 --port 6379`."
        ) from error
    try:
        there = ray.remote(num_cpus=1, max_retries=0)(_away)
        bank, left = ray.put(_pack(home / MEMORY)), list(reversed(jobs))
        about, most = note(home), workers or int(ray.cluster_resources().get("CPU", 1))
        running: dict[ray.ObjectRef, Job] = {}
        while left or running:
            while left and len(running) < most:
                job = left.pop()
                running[there.remote(work, job, bank, about)] = job
            (done,), _ = ray.wait(list(running), num_returns=1)
            rows, files = ray.get(done)
            _keep(home, files)
            yield running.pop(done), rows
    except (
        ray.exceptions.WorkerCrashedError,
        ray.exceptions.NodeDiedError,
        ray.exceptions.OutOfMemoryError,
        ray.exceptions.ObjectLostError,
    ) as error:
        raise WorkerDied("a worker of the cluster died, perhaps for lack of memory; run the same command again, with fewer --workers.") from error
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error
    finally:
        ray.shutdown()


def _keep(home: Path, files: Files) -> None:
    try:
        for name, data in files.items():
            (home / name).parent.mkdir(parents=True, exist_ok=True)
            write_atomic(home / name, data)
    except OSError as error:
        raise BadOutput(f"cluster: {home} cannot be written ({error.strerror}); make room and run the same command again.") from error


def _away(work: "Callable[[Job], Rows]", job: "Job", bank: Files, run: dict[str, Any]) -> "tuple[Rows, Files]":
    """Run one job on another machine, in a folder of its own. Raises: BadCluster when that machine has other weights, lists or code."""
    mine = job.study.configuration()
    if digest(mine) != run["digest"]:
        raise BadCluster(f"cluster: {platform.node()} is not like this machine ({differences(run, mine)}); install the same version on all.")
    with TemporaryDirectory() as scratch:
        here = Path(scratch)
        for name, data in bank.items():
            (here / MEMORY / name).parent.mkdir(parents=True, exist_ok=True)
            (here / MEMORY / name).write_bytes(data)
        rows = work(replace(job, folder=here))
        return rows, {name: data for name, data in _pack(here).items() if not name.startswith(f"{MEMORY}/")}


def _pack(folder: Path) -> Files:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
