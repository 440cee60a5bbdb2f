"""A policy of one's own: the documented one runs when pasted, and its episodes are diagnosed without a recording."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from vap_core.evaluation.diagnosis import diagnose, explain
from vap_core.evaluation.study import Study
from vap_core.evaluation.trials import make_trial, register_personal
from vap_core.recording import Recorder
from vap_core.rollout.loop import rollout

ROOT = Path(__file__).resolve().parents[1]


def documented(words: str) -> str:
    """The one Python block of README or docs/extend.md that has these words."""
    blocks = []
    for page in (ROOT / "README.md", ROOT / "docs" / "extend.md"):
        blocks += re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    (found,) = (block for block in blocks if words in block)
    return found


def test_the_documented_policy_runs_when_pasted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(documented("def plan("), "pasted", "exec"), names)
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 2
    for line in printed:
        assert line.startswith("failure Diagnosis(case='case 3', sub_case='timeout'")
    exec(compile(documented("found +=").replace("=20", "=1"), "pasted", "exec"), names)
    printed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in printed] == list(names["methods"])
    assert all(line.endswith("of 1") for line in printed)


@pytest.mark.parametrize("method", ["generic", "vap"])
@pytest.mark.parametrize("follow", ["call", "step"])
def test_the_diagnosis_needs_no_recording(tmp_path: Path, method: str, follow: str) -> None:
    study = Study((("widowx-pick", "pick-straw-cup"),), (method,), episodes=1, follow=follow)
    (row,) = study.rows("widowx-pick", "pick-straw-cup")
    register_personal(study, tmp_path)
    trial = make_trial(study, [row], method, tmp_path)
    rows = [replace(row, max_steps=8)]

    (alone,) = rollout(trial, rows)
    (recorded,) = rollout(
        trial, rows, lambda header: Recorder(tmp_path / "one.rrd", header, explain=explain)
    )
    found = diagnose(alone)
    expected = diagnose(recorded)
    assert found is not None
    assert expected is not None
    assert found.columns() == expected.columns()
