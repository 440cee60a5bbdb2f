"""What a Ray cluster costs over local processes: the same run both ways on this machine, in turn, start-up included."""

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

SUITE, REPEATS = "simpler-bridge", 4


@contextmanager
def local_cluster(cpus: int) -> Iterator[str]:
    """The address of a Ray cluster of one node on this machine, on loopback. Raises: BadCluster."""
    os.environ.setdefault(
        "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0"
    )  # else Ray listens at this machine's outward address
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
    """Measure and say it; about five minutes on two cores, `quick` a smoke test."""
    from tqdm import tqdm

    study = Study(
        tuple((SUITE, task.name) for task in suite(SUITE).tasks),
        ("generic", "vap"),
        episodes=5,
        follow="call",
    )
    if quick:
        study = replace(
            study, tasks=study.tasks[:1], policy="random", methods=("generic",), episodes=1
        )
    seconds: dict[str, list[float]] = {"processes": [], "ray": []}
    with tempfile.TemporaryDirectory() as scratch, local_cluster(workers) as address:
        executors: dict[str, engine.Executor] = {
            "processes": results,
            "ray": cluster.ray_executor(address),
        }
        for turn in tqdm(range(2 if quick else REPEATS), unit="repeat", disable=None):
            for name in ("processes", "ray") if turn % 2 else ("ray", "processes"):
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
    middle, low, high = (100 * (times - 1) for times in ratio(seconds["ray"], seconds["processes"]))
    lines = [
        ["", "seconds, every repeat"],
        *([name, " ".join(f"{s:.1f}" for s in held)] for name, held in seconds.items()),
    ]
    head = f"{SUITE}: {len(table)} episodes a run, {workers} workers, {len(seconds['ray'])} repeats, start-up included"
    return f"{head}\n\n{align(lines)}\n\nRay over processes: {middle:+.1f} % [{low:+.1f}, {high:+.1f}] of the time"
