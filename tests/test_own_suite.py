"""A suite of one's own from a Python file: the documented one runs; what is wrong in a file is one line."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.command import process, refused, vap
from vap_core.base.errors import BadSuite, UnknownName
from vap_core.evaluation.feasibility import feasible
from vap_core.evaluation.rescore import rescore
from vap_core.evaluation.store import read, read_manifest
from vap_core.simulation import suites
from vap_core.simulation.suites import own

ROOT = Path(__file__).resolve().parents[1]
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "docs/extend.md").read_text(), re.DOTALL)
(DOCUMENTED,) = (block for block in BLOCKS if "SUITE = Suite(" in block)


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The documented suite as a file; what is opened in a test is forgotten after it."""
    monkeypatch.setattr(own, "OPENED", {})
    suites._seeded.cache_clear()
    suites.benchmark.cache_clear()
    path = tmp_path / "desk.py"
    path.write_text(DOCUMENTED)
    return path


def test_the_documented_suite_is_a_suite_like_any_other(file: Path) -> None:
    suite = suites.open_file(file)
    assert suites.suite(suite.name) is suite
    (task,) = suite.tasks
    rows = suites.rows(suite.name, task.name)
    assert len(rows) == 6
    assert suites.rows(suite.name, task.name, 2) == (rows[0], rows[5])
    moved = suites.rows(suite.name, task.name, seed=1)[0]
    assert moved.start.offsets, "a seed moves the start, as in the benchmarks"
    assert len(suites.digest(suite.name)) == 64
    assert feasible(rows[:1]) == (True,)


def test_a_file_is_executed_once(file: Path) -> None:
    assert suites.open_file(file) is suites.open_file(file)


def test_other_commands_find_it_by_the_environment(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UnknownName, match="your own by its file or VAP_SUITES"):
        suites.suite("my-desk")
    monkeypatch.setenv("VAP_SUITES", str(file))
    assert suites.suite("my-desk").robot == "wx250s"


def test_a_run_of_a_suite_that_is_not_open_names_the_remedy(file: Path) -> None:
    with pytest.raises(UnknownName, match="your own by its file or VAP_SUITES"):
        suites.digest("my-desk")


@pytest.mark.slow
def test_the_commands_told_at_the_end_find_the_suite_and_are_quoted(tmp_path: Path) -> None:
    (tmp_path / "my desk").mkdir()
    file = tmp_path / "my desk" / "desk.py"
    file.write_text(DOCUMENTED)
    words = ("eval", "--suite", file, "--policy", "expert", "--episodes", 1, "--record", "none")
    out = tmp_path / "my desk" / "run"
    done = process(*words, "--workers", 1, "--out", out, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (command,) = re.findall("tables, paired tests, a page: (.*)", done.stdout)
    setting, *rest = shlex.split(command)
    assert (setting, rest) == (
        f"VAP_SUITES={file}",
        ["python", "-m", "vap_core", "report", str(out)],
    )
    told = subprocess.run(
        command.replace(" python ", f" {shlex.quote(sys.executable)} "),
        shell=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert told.returncode == 0, told.stderr


@pytest.mark.parametrize("name", ["simpler-bridge", "my-absent"])
def test_the_environment_takes_no_name_that_is_another_suites(
    file: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """A list of one's own was run under the benchmark's name."""
    file.write_text(DOCUMENTED.replace('"my-desk"', f'"{name}"'))
    monkeypatch.setenv("VAP_SUITES", str(file))
    with pytest.raises(BadSuite, match=f"another suite '{name}'|the name '{name}' will not do"):
        suites.digest("simpler-bridge")


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (("import numpy as np", "import nothing"), r"desk\.py, line \d+: ModuleNotFoundError"),
        (("import numpy as np", "def"), r"desk\.py, line \d+: SyntaxError"),
        (("SUITE = Suite(", "DESK = Suite("), r"desk\.py.*NameError|must define SUITE"),
        (("def rows", "def episodes"), "must define SUITE"),
        (('"wx250s"', '"wx25"'), r"no robot 'wx25'|robot.*'wx25'"),
        (('("front",)', '("back",)'), "camera 'back'"),
        (("hz=5.0", "hz=10.0"), "wx250s is controlled at hz=5, and not 10"),
        (('"my-desk"', '"tabletop"'), "another suite 'tabletop'"),
        (('"my-desk"', '"my-absent"'), "the name 'my-absent' will not do"),
        (('"my-desk"', '"../desk"'), "the name '../desk' will not do"),
        (("bottle-lookalike-1", "bottle-lookalike-99"), "bottle-lookalike-99"),
        (("PICK, episode,", "PICK, 0,"), "is there twice"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line_that_names_the_file(
    file: Path, edit: tuple[str, str], words: str
) -> None:
    assert edit[0] in DOCUMENTED
    file.write_text(DOCUMENTED.replace(*edit))
    with pytest.raises(BadSuite, match=words) as refusal:
        suites.open_file(file)
    assert "desk.py" in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.slow
def test_the_command_runs_and_judges_it_again(file: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    done = vap(
        *("eval", "--suite", file, "--policy", "expert", "--episodes", 2),
        *("--workers", 1, "--out", out),
    )
    assert done.returncode == 0, done.stderr
    assert read(out)[["suite", "outcome"]].values.tolist() == [["my-desk", "success"]] * 2
    assert read_manifest(out)["configuration"]["lists"] == {"my-desk": suites.digest("my-desk")}
    assert "suite_files" not in read_manifest(out)["configuration"]
    rescore(out)
    assert vap("report", out).returncode == 0


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    said = refused("eval", "--suite", tmp_path / "none.py", "--out", tmp_path / "run")
    assert "none.py is no Python file" in said
