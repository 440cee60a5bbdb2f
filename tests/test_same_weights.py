"""A run keeps no rows of two sets of weights; its jobs are stood in for by rows of their workers' deaths."""

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from vap_core.base.errors import BadPolicy
from vap_core.evaluation import engine, store
from vap_core.evaluation.jobs import Job, Rows, row_of_dead_worker
from vap_core.evaluation.policy_names import shipped
from vap_core.evaluation.study import Study

STUDY = Study((("simpler-bridge", "pick-shaver"),), ("generic",), policy="random", episodes=2)


@pytest.fixture(autouse=True)
def short_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "register_personal", lambda *_: None)
    monkeypatch.setattr(engine, "BATCH", 1)


def executor(checksums: Sequence[str | None], before: Callable[[], None] = lambda: None):  # type: ignore[no-untyped-def]
    """One that gives job after job the row of an episode under these weights."""

    def results(
        work: Callable[[Job], Rows], jobs: Sequence[Job], workers: int, remedy: str
    ) -> Iterator[tuple[Job, Rows]]:
        before()
        for job, checksum in zip(jobs, checksums, strict=True):
            yield job, [{**row_of_dead_worker(job, "died"), "policy_sha256": checksum}]

    return results


def run(study: Study, out: Path, *args: object) -> list[str | None]:
    table = engine.run(study, out, retries=0, executor=executor(*args), progress=False)  # type: ignore[arg-type]
    return [None if pd.isna(name) else name for name in table.policy_sha256]


def test_rows_of_other_weights_end_the_run_and_are_not_kept(tmp_path: Path) -> None:
    message = (
        r"^engine: the weights of random \(aaaa at first, bbbb now\) changed while the run in .* "
        r"choose another folder with --out\.$"
    )
    with pytest.raises(BadPolicy, match=message):
        run(STUDY, tmp_path / "run", ["aaaa", "bbbb"])
    assert store.read(tmp_path / "run").policy_sha256.tolist() == ["aaaa"]
    assert run(STUDY, tmp_path / "run", ["bbbb"]) == ["aaaa", "bbbb"], "the manifest agrees"


def test_a_worker_that_died_says_nothing_of_the_weights(tmp_path: Path) -> None:
    assert run(STUDY, tmp_path / "run", [None, "aaaa"]) == [None, "aaaa"]
    assert run(STUDY, tmp_path / "other", ["aaaa", None]) == ["aaaa", None]


def test_a_checkpoint_that_is_replaced_before_a_worker_loads_it_ends_the_run(
    tmp_path: Path,
) -> None:
    checkpoint = tmp_path / "trained"
    shutil.copytree(shipped("simpler-bridge"), checkpoint)
    config = checkpoint / "config.json"
    study = replace(STUDY, policy=str(checkpoint))

    def touch() -> None:
        os.utime(config, (0, 0))

    def write() -> None:
        config.write_text(config.read_text() + " ")

    assert run(study, tmp_path / "touched", ["aaaa", "aaaa"], touch) == ["aaaa", "aaaa"]
    with pytest.raises(BadPolicy, match="the weights of .*trained changed while the run"):
        run(study, tmp_path / "written", ["aaaa", "aaaa"], write)
    assert store.read(tmp_path / "written").empty
