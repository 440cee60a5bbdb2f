"""What a Ray cluster costs over local processes.

The same run is measured both ways on this machine, in turn, with start-up and beyond it.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from vap_core.base.errors import BadCluster, BadStudy
from vap_core.base.tables import align, signed
from vap_core.cli.bench.timing import seconds_of
from vap_core.evaluation import cluster, engine
from vap_core.evaluation.jobs import Job, Rows
from vap_core.evaluation.processes import results
from vap_core.evaluation.statistics import ratio
from vap_core.evaluation.study import Study
from vap_core.simulation.suites import suite

SUITE = "simpler-bridge"
REPEATS = 4

Arrival = tuple[float, int]
"""When a job finished, in seconds, and how many episodes it had."""


@contextmanager
def local_cluster(cpus: int) -> Iterator[str]:
    """The address of a Ray cluster of one node on this machine, on loopback. Raises: BadCluster."""
    # Otherwise Ray listens at this machine's outward address.
    os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    try:
        from ray.cluster_utils import Cluster
    except ImportError as error:
        raise BadCluster(
            "bench engine: ray is not installed; run: pip install 'vap-core[ray]'"
        ) from error

    head = {
        "num_cpus": cpus,
        "node_ip_address": "127.0.0.1",
        "object_store_memory": 2**28,
        "include_dashboard": False,
    }
    nodes = Cluster(initialize_head=True, head_node_args=head)
    try:
        yield nodes.address
    finally:
        nodes.shutdown()


@dataclass(frozen=True)
class EngineRun:
    """What a run took: seconds in all, and seconds an episode beyond start-up."""

    seconds: float
    episode_s: float


def time_run(study: Study, folder: Path, workers: int, executor: engine.Executor) -> EngineRun:
    """Run a study. Raises: BadStudy when its jobs are not more than the workers."""
    arrivals: list[Arrival] = []

    def noting(
        work: Callable[[Job], Rows], jobs: Sequence[Job], workers: int, remedy: str
    ) -> Iterator[tuple[Job, Rows]]:
        for job, rows in executor(work, jobs, workers, remedy):
            arrivals.append((time.perf_counter(), len(rows)))
            yield job, rows

    def whole_run() -> None:
        engine.run(study, folder, workers=workers, record="none", progress=False, executor=noting)

    seconds = seconds_of(whole_run)
    return EngineRun(seconds, seconds_beyond_start_up(arrivals, workers))


def seconds_beyond_start_up(arrivals: Sequence[Arrival], workers: int) -> float:
    """Seconds an episode from when as many jobs as workers have finished. Raises: BadStudy."""
    if len(arrivals) <= workers:
        raise BadStudy(
            f"bench: {len(arrivals)} jobs for {workers} workers leave nothing beyond start-up; "
            "give fewer --workers."
        )
    first, _ = arrivals[workers - 1]
    last, _ = arrivals[-1]
    episodes = sum(n for _, n in arrivals[workers:])
    return (last - first) / episodes


def run(workers: int = 2, quick: bool = False) -> str:
    """Measure and report it; about five minutes on two cores, `quick` a smoke test.

    Raises: BadCluster: ray is not installed; BadStudy for so many `workers` that no job is left
        beyond start-up.
    """
    from tqdm import tqdm

    study = _study(quick)
    repeats = 2 if quick else REPEATS
    runs: dict[str, list[EngineRun]] = {"processes": [], "ray": []}
    with tempfile.TemporaryDirectory() as scratch, local_cluster(workers) as address:
        executors: dict[str, engine.Executor] = {
            "processes": results,
            "ray": cluster.ray_executor(address),
        }
        for turn in tqdm(range(repeats), unit="repeat", disable=None):
            order = ("processes", "ray") if turn % 2 else ("ray", "processes")
            for name in order:
                folder = Path(scratch) / f"{name}-{turn}"
                runs[name].append(time_run(study, folder, workers, executors[name]))
    n = sum(len(study.rows(*task)) for task in study.tasks) * len(study.methods)
    title = f"{SUITE}: {n} episodes a run, {workers} workers, {repeats} repeats"
    return f"{title}\n\n{_seconds_table(runs)}\n\n{_overhead_text(runs)}"


def _study(quick: bool) -> Study:
    """Some episodes of every task; `quick`, a few of two."""
    tasks = tuple((SUITE, task.name) for task in suite(SUITE).tasks)
    study = Study(tasks, ("generic", "vap"), episodes=5, follow="call")
    if not quick:
        return study
    # Six episodes of each of two tasks are four jobs, more than two workers.
    return replace(study, tasks=tasks[:2], policy="random", methods=("generic",), episodes=6)


def _seconds_table(runs: dict[str, list[EngineRun]]) -> str:
    rows = [["", "seconds, every repeat", "ms an episode beyond start-up"]]
    for name, repeats in runs.items():
        seconds = " ".join(f"{run.seconds:.1f}" for run in repeats)
        beyond = " ".join(f"{1e3 * run.episode_s:.0f}" for run in repeats)
        rows.append([name, seconds, beyond])
    return align(rows)


def _overhead_text(runs: dict[str, list[EngineRun]]) -> str:
    """What Ray adds, in percent of the time of processes, with its interval."""
    ray = runs["ray"]
    local = runs["processes"]
    whole = _percent([run.seconds for run in ray], [run.seconds for run in local])
    beyond = _percent([run.episode_s for run in ray], [run.episode_s for run in local])
    return f"Ray over processes: {whole} of the time with start-up, {beyond} beyond it"


def _percent(slow: Sequence[float], fast: Sequence[float]) -> str:
    middle, low, high = (100 * (each - 1) for each in ratio(slow, fast))
    return f"{signed(middle, 1)} % [{signed(low, 1)}, {signed(high, 1)}]"
