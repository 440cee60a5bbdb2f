"""Run folders and published tables of any content are read, or refused in one line."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.test_report import run
from vap_core.base.errors import BadOutput, VapError
from vap_core.study.failures import list_failures, study_of
from vap_core.study.report import report
from vap_core.study.results import check_run, publish, read_runs

JUNK: list[Any] = [None, -1, 10**30, 1.5, True, "", "nowhere", [], [1], {}, {"a": [None]}]
NOTES = ("tasks", "methods", "episodes", "seed", "seeds", "policy", "lists", "stack")
COLUMNS = (
    *("suite", "task", "method", "policy", "outcome", "split", "variant", "case", "detail"),
    *("seed", "episode", "steps", "attempt", "success", "cmr", "wrong_object", "touched"),
    *("sub_case", "deciding_frame", "case_confidence", "case_sentence"),
)
CELLS: list[Any] = [None, "text", 1.5, True, [1.0], b"\xff"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with every column that a diagnosis adds."""
    folder = run(tmp_path_factory.mktemp("schema") / "run")
    part = next((folder / "parts").iterdir())
    diagnosis = {"case": "", "sub_case": "", "deciding_frame": -1, "case_confidence": 1.0}
    pd.read_parquet(part).assign(**diagnosis, case_sentence="").to_parquet(part)
    return folder


DAMAGED_NOTES, DAMAGED_COLUMNS = 15, 12
"""Examples that are tried of each."""


def read_back(source: Path, out: Path) -> None:
    """What reads a run: none of them may end in anything but a VapError of one line."""
    for read in (lambda: report([source], out), lambda: list_failures(source)):
        said = ""
        try:
            read()
        except VapError as error:
            said = str(error)
        assert "\n" not in said
        assert len(said) <= 400
        shutil.rmtree(out, ignore_errors=True)


@settings(max_examples=DAMAGED_NOTES, deadline=None, suppress_health_check=list(HealthCheck))
@given(name=st.sampled_from(NOTES), value=st.sampled_from(JUNK))
def test_any_note_of_a_run_is_read_or_refused(
    whole: Path,
    tmp_path: Path,
    record_property: Callable[[str, object], None],
    name: str,
    value: Any,
) -> None:
    record_property("cases", DAMAGED_NOTES)
    folder = tmp_path / "torn"
    shutil.copytree(whole, folder, dirs_exist_ok=True)
    held = json.loads((whole / "run.json").read_text())
    held["configuration"][name] = value
    (folder / "run.json").write_text(json.dumps(held))
    read_back(folder, tmp_path / "out")


@settings(max_examples=DAMAGED_COLUMNS, deadline=None, suppress_health_check=list(HealthCheck))
@given(name=st.sampled_from(COLUMNS), value=st.sampled_from(CELLS))
def test_any_column_of_a_run_is_read_or_refused(
    whole: Path,
    tmp_path: Path,
    record_property: Callable[[str, object], None],
    name: str,
    value: Any,
) -> None:
    record_property("cases", DAMAGED_COLUMNS)
    folder = tmp_path / "torn"
    shutil.copytree(whole, folder, dirs_exist_ok=True)
    part = next((folder / "parts").iterdir())
    table = pd.read_parquet(next((whole / "parts").iterdir()))
    table[name] = [value] * len(table)
    table.to_parquet(part)
    read_back(folder, tmp_path / "out")


def test_a_date_is_a_seed(whole: Path) -> None:
    rows = pd.read_parquet(next((whole / "parts").iterdir()))
    manifest = json.loads((whole / "run.json").read_text())
    manifest["configuration"]["seed"] = 20261126
    check_run(whole, manifest, rows)
    manifest["configuration"]["seed"] = 2**32
    with pytest.raises(BadOutput, match="the setting seed is"):
        check_run(whole, manifest, rows)


@pytest.mark.parametrize(
    "notes",
    [b"null", b"[1]", b'{"a": 1}', b'"text"', b"[" * 100_000, b"\xff", b'[{"digest": "0"}]'],
)
def test_a_published_table_with_other_notes_is_refused(
    whole: Path, tmp_path: Path, notes: bytes
) -> None:
    good, bad = tmp_path / "good.parquet", tmp_path / "bad.parquet"
    publish([whole], good)
    table: pa.Table = pq.read_table(good)
    pq.write_table(table.replace_schema_metadata({b"runs": notes}), bad)
    with pytest.raises(VapError, match="is no table of finished runs|no configuration"):
        list_failures(bad)


def test_no_run_or_table_is_opened_that_names_code(whole: Path, tmp_path: Path) -> None:
    """A study's own suites are executed; results of others may not name them."""
    marker, code = tmp_path / "executed", tmp_path / "code.py"
    code.write_text(f"open({str(marker)!r}, 'w')\n")
    folder, good, bad = (tmp_path / name for name in ("run", "good.parquet", "bad.parquet"))
    shutil.copytree(whole, folder)
    held = json.loads((folder / "run.json").read_text())
    held["configuration"]["suite_files"] = [str(code)]
    (folder / "run.json").write_text(json.dumps(held))
    publish([whole], good)
    notes = json.dumps([held]).encode()
    pq.write_table(pq.read_table(good).replace_schema_metadata({b"runs": notes}), bad)
    for source in (folder, bad):
        with pytest.raises(VapError, match="suite_files, which name code to execute"):
            list_failures(source)
    _, episodes = read_runs(whole)[0]
    study_of(held, episodes.iloc[0].to_dict())
    assert not marker.exists()
