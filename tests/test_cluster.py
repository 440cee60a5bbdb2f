"""A Ray cluster of two nodes on this machine gives the table, traces and recordings of local processes."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from vap_core.base.errors import BadCluster, BadSuite, WorkerDied
from vap_core.study import engine, steps, workers
from vap_core.study.engine import Job, Rows, run_job
from vap_core.study.logs import read_states as read_traces
from vap_core.study.store import open_run
from vap_core.study.trials import Study
from vap_core.study.workers import results

STUDY = Study((("simpler-bridge", "pick-shaver"),), ("generic",), policy="random", episodes=6)


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    from ray.cluster_utils import Cluster

    local = {"num_cpus": 1, "node_ip_address": "127.0.0.1", "object_store_memory": 2**28}
    nodes = Cluster(initialize_head=True, head_node_args={**local, "include_dashboard": False})
    nodes.add_node(**local)
    yield nodes.address
    nodes.shutdown()


def test_another_machine_opens_the_files_of_own_suites_first(tmp_path: Path) -> None:
    """A study that comes by pickle has checked nothing there."""
    away = tmp_path / "desk.py"
    study = replace(STUDY)
    object.__setattr__(study, "suite_files", (str(away),))
    job = Job(study, "generic", (), (), 1, tmp_path, "none")
    with pytest.raises(BadSuite, match=r"desk\.py"):
        workers._run_remotely(run_job, job, {}, {"digest": ""})


@pytest.mark.sweep
@pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore::FutureWarning"
)
def test_a_cluster_gives_what_local_processes_give(address: str, tmp_path: Path) -> None:
    there = engine.run(
        STUDY,
        tmp_path / "ray",
        record="all",
        progress=False,
        executor=workers.ray_executor(address),
    )
    here = engine.run(STUDY, tmp_path / "local", record="all", progress=False, executor=results)
    columns = [
        name for name in here.columns if name != "peak_mb" and not name.startswith("seconds_")
    ]
    pd.testing.assert_frame_equal(there[columns], here[columns])
    one, other = (dict(read_traces(tmp_path / name)) for name in ("ray", "local"))
    assert one.keys() == other.keys()
    for name in one:
        assert [truth.objects_world.keys() for truth in one[name]] == [
            truth.objects_world.keys() for truth in other[name]
        ]
    names = [
        sorted(path.name for path in (tmp_path / name / "recordings").glob("*.rrd"))
        for name in ("ray", "local")
    ]
    assert names[0] == names[1]
    assert len(names[0]) == 6
    found = [steps.query(tmp_path / name, "steps > 0") for name in ("ray", "local")]
    pd.testing.assert_frame_equal(*found)
    again = engine.run(
        STUDY, tmp_path / "ray", progress=False, executor=workers.ray_executor("127.0.0.1:1")
    )
    pd.testing.assert_frame_equal(again, there)  # nothing is missing, nobody is asked

    def dies(job: Job) -> Rows:
        import os

        os.kill(os.getpid(), 9)
        return []

    jobs = list(engine.missing_jobs(STUDY, open_run(tmp_path / "dies", STUDY.configuration())))[:1]
    with pytest.raises(WorkerDied, match="a worker of the cluster died"):
        list(workers.ray_executor(address)(dies, jobs, 1, ""))
    strange = list(
        engine.missing_jobs(
            STUDY, open_run(tmp_path / "strange", {**STUDY.configuration(), "version": "9.9"})
        )
    )[:1]
    with pytest.raises(BadCluster, match=r"is not like this machine \(version 9.9 there"):
        list(workers.ray_executor(address)(dies, strange, 1, ""))


@pytest.mark.parametrize("name", ["/tmp/x", "../x", "parts/../../x", ""])
def test_a_worker_writes_into_the_run_alone(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with pytest.raises(BadCluster, match="outside the run's folder; join clusters that you trust"):
        workers._write_files(folder, {"parts/a.parquet": b"a", name: b"x"})
    assert not list(folder.iterdir())


def test_no_cluster_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(
        BadCluster,
        match=r"no Ray cluster answers at 'nowhere' .*; start one with `ray start --head .*--include-dashboard false ",
    ):
        engine.run(
            STUDY, tmp_path / "run", progress=False, executor=workers.ray_executor("nowhere")
        )
