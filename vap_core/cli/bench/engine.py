"""What a Ray cluster costs over local processes.

The same run is measured both ways on this machine, in turn, start-up included.
"""

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from vap_core.base.errors import BadCluster
from vap_core.base.tables import align
from vap_core.evaluation import cluster, engine
from vap_core.evaluation.processes import results
from vap_core.evaluation.statistics import ratio
from vap_core.evaluation.study import Study
from vap_core.simulation.suites import suite

SUITE = "simpler-bridge"
REPEATS = 4


@contextmanager
def local_cluster(cpus: int) -> Iterator[str]:
    """The address of a Ray cluster of one node on this machine, on loopback. Raises: BadCluster."""
    # Otherwise Ray listens at this machine's outward address.
    os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    try:
        from ray.cluster_utils import Cluster
    except ImportError as error:
        raise BadCluster(
            "bench engine: ray is not installed; run: pip install 'ray>=2.50'"
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


def run(workers: int = 2, quick: bool = False) -> str:
    """Measure and report it; about five minutes on two cores, `quick` a smoke test."""
    from tqdm import tqdm

    study = _study(quick)
    repeats = 2 if quick else REPEATS
    seconds: dict[str, list[float]] = {"processes": [], "ray": []}
    with tempfile.TemporaryDirectory() as scratch, local_cluster(workers) as address:
        executors: dict[str, engine.Executor] = {
            "processes": results,
            "ray": cluster.ray_executor(address),
        }
        for turn in tqdm(range(repeats), unit="repeat", disable=None):
            order = ("processes", "ray") if turn % 2 else ("ray", "processes")
            for name in order:
                start = time.perf_counter()
                table = engine.run(
                    study,
                    Path(scratch) / f"{name}-{turn}",
                    workers=workers,
                    record="none",
                    progress=False,
                    executor=executors[name],
                )
                seconds[name].append(time.perf_counter() - start)
    title = (
        f"{SUITE}: {len(table)} episodes a run, {workers} workers, "
        f"{len(seconds['ray'])} repeats, start-up included"
    )
    return f"{title}\n\n{_seconds_table(seconds)}\n\n{_overhead_text(seconds)}"


def _study(quick: bool) -> Study:
    """Some episodes of every task; `quick`, one episode of one."""
    tasks = tuple((SUITE, task.name) for task in suite(SUITE).tasks)
    study = Study(tasks, ("generic", "vap"), episodes=5, follow="call")
    if not quick:
        return study
    return replace(study, tasks=tasks[:1], policy="random", methods=("generic",), episodes=1)


def _seconds_table(seconds: dict[str, list[float]]) -> str:
    rows = [["", "seconds, every repeat"]]
    for name, values in seconds.items():
        rows.append([name, " ".join(f"{s:.1f}" for s in values)])
    return align(rows)


def _overhead_text(seconds: dict[str, list[float]]) -> str:
    """What Ray adds, in percent of the time of processes, with its interval."""
    middle, low, high = ratio(seconds["ray"], seconds["processes"])
    overhead = 100 * (middle - 1)
    low_overhead = 100 * (low - 1)
    high_overhead = 100 * (high - 1)
    return (
        f"Ray over processes: {overhead:+.1f} % "
        f"[{low_overhead:+.1f}, {high_overhead:+.1f}] of the time"
    )
