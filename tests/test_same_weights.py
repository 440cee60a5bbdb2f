"""A run goes on with the weights with which it began: a job of others ends before its episodes."""

import os
import shutil
from pathlib import Path

import pytest

from vap_core.base.errors import BadPolicy
from vap_core.study.engine import missing_jobs, require_same_weights, run_job
from vap_core.study.store import open_run
from vap_core.study.trials import Study, shipped

SUITE = "simpler-bridge"
TASKS = ((SUITE, "pick-shaver"),)


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    folder = tmp_path / "trained"
    shutil.copytree(shipped(SUITE), folder)
    return folder


def begun(checkpoint: Path, folder: Path) -> Study:
    study = Study(TASKS, ("generic",), policy=str(checkpoint), episodes=1)
    open_run(folder, study.configuration())
    return study


def test_a_checkpoint_that_was_replaced_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    study = begun(checkpoint, tmp_path / "run")
    config = checkpoint / "config.json"
    first = config.read_bytes()
    require_same_weights(study, SUITE, tmp_path / "run")
    os.utime(config, (0, 0))
    require_same_weights(study, SUITE, tmp_path / "run")
    config.write_bytes(first + b" ")
    message = r"^engine: the weights in .*trained changed while the run in .* with --out\.$"
    with pytest.raises(BadPolicy, match=message):
        require_same_weights(study, SUITE, tmp_path / "run")
    require_same_weights(study, SUITE, tmp_path / "elsewhere")  # a machine of a cluster
    config.write_bytes(first)
    require_same_weights(study, SUITE, tmp_path / "run")


def test_a_policy_without_a_checkpoint_has_no_weights_to_compare(tmp_path: Path) -> None:
    study = Study(TASKS, ("generic",), policy="random", episodes=1)
    open_run(tmp_path, study.configuration())
    require_same_weights(study, SUITE, tmp_path)


def test_a_job_of_other_weights_writes_nothing(checkpoint: Path, tmp_path: Path) -> None:
    """Neither rows nor traces: a trace would be scored again as the run's."""
    folder = tmp_path / "run"
    study = begun(checkpoint, folder)
    (job,) = missing_jobs(study, folder, "none", retries=0)
    before = {path.name for path in folder.iterdir()}
    config = checkpoint / "config.json"
    config.write_bytes(config.read_bytes() + b" ")
    with pytest.raises(BadPolicy, match="changed while the run"):
        run_job(job)
    assert {path.name for path in folder.iterdir()} == before
