"""How failures divide into cases, and at which stages episodes are lost: tables and pictures."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from vap_core.base import pictures
from vap_core.recording import recording_file_name
from vap_core.rollout.types import CASES
from vap_core.study.charts import funnel
from vap_core.study.diagnosis import STAGES
from vap_core.study.failures import (
    breakdown,
    breakdown_table,
    funnel_table,
    sub_cases_table,
    sub_cases_text,
)
from vap_core.study.report import report_page
from vap_core.study.results import Runs
from vap_core.study.table import printed

STAGE_COLUMNS = [f"stage_{stage}" for stage in STAGES]


def row(
    method: str = "vap",
    case: str = "",
    sub_case: str = "",
    stages: int = 7,
    outcome: str = "",
    suite: str = "vlabench",
) -> dict[str, Any]:
    """One episode that passes so many stages."""
    ended = outcome or ("failure" if case else "success")
    passed = {
        f"stage_{name}": i < stages if method == "vap" or i > 3 else None
        for i, name in enumerate(STAGES)
    }
    about = {"suite": suite, "method": method, "outcome": ended, "success": ended == "success"}
    return {
        **about,
        "case": case,
        "sub_case": sub_case,
        "case_confidence": 0.5 if case else float("nan"),
        "deciding_frame": 3.0,
        **passed,
    }


TABLE = pd.DataFrame(
    [
        *[row()] * 4,
        *[row(case="case 2", sub_case="views disagree", stages=1)] * 3,
        row(case="case 3", sub_case="timeout", stages=4),
        row(outcome="error", stages=0),
        *[row("generic", "unprompted", "wrong object", stages=5)] * 2,
    ]
)


def test_the_cases_of_a_row_sum_to_its_failures() -> None:
    counts = breakdown(TABLE).set_index("method")
    assert (counts.loc["vap", ["n", "failed", "case 1", "case 2", "case 3"]].tolist()) == [
        9,
        4,
        0,
        3,
        1,
    ]
    assert (counts[list(CASES)].sum(axis=1) == counts["failed"]).all()
    for case, parts in CASES.items():
        assert (counts[[f"{case}: {part}" for part in parts]].sum(axis=1) == counts[case]).all()
    assert counts.loc["vap", "mean_confidence"] == 0.5


def test_an_error_that_an_older_version_diagnosed_counts_as_no_failure() -> None:
    broken = {**row(case="case 3", sub_case="slip", outcome="error"), "case_confidence": 1.0}
    counts = breakdown(pd.concat([TABLE, pd.DataFrame([broken])], ignore_index=True))
    assert counts.drop(columns="n").equals(breakdown(TABLE).drop(columns="n"))
    assert counts["n"].tolist() == [10, 2]


def test_as_text_every_share_has_its_interval() -> None:
    told = printed(breakdown_table(breakdown(TABLE)))
    assert "44 % [19, 73]" in told
    assert "75 % [30, 95]" in told
    assert "case 1 %" not in told, "no row has any"
    assert (
        sub_cases_text(breakdown(TABLE)).splitlines()[0]
        == "vlabench vap: 3 x case 2: views disagree, 1 x case 3: timeout"
    )


def test_the_sub_cases_as_a_table() -> None:
    table = sub_cases_table(breakdown(TABLE))
    assert table.index.names == ["case", "sub-case"]
    of_vap = table["vlabench", "vap"]
    assert (of_vap["case 2", "views disagree"], of_vap["case 3", "timeout"]) == (3, 1)
    assert of_vap.sum() == 4, "only what occurred, and all of it"
    assert (table.sum(axis=1) > 0).all()


def test_what_several_policies_did_is_not_added_up() -> None:
    two = pd.concat([TABLE.assign(policy="a"), TABLE.assign(policy="b")], ignore_index=True)
    counts = breakdown(two)
    assert counts.method.tolist() == ["vap, a", "generic, a", "vap, b", "generic, b"]
    assert counts.n.tolist() == [9, 2, 9, 2]
    assert list(dict.fromkeys(funnel_table(two).method)) == counts.method.tolist()
    alone = two[(two.policy == "a") | (two.method == "vap")]
    assert breakdown(alone).method.tolist() == ["vap, a", "generic", "vap, b"]
    lines = funnel(funnel_table(two)).legends[0].get_texts()
    assert [line.get_text() for line in lines] == counts.method.tolist()
    assert breakdown(TABLE.assign(policy="a")).equals(breakdown(TABLE))


def left(method: str, table: pd.DataFrame = TABLE) -> dict[str, int]:
    found = funnel_table(table)
    of_method = found[found.method == method]
    return dict(zip(of_method.stage, of_method.left, strict=True))


def test_the_funnel_narrows_and_ends_with_the_successes() -> None:
    assert list(left("vap").values()) == [8, 5, 5, 5, 4, 4, 4, 4]
    assert left("generic") == {"touched": 2, "lifted": 0, "success": 0, "SR": 0}
    assert set(funnel_table(TABLE).query("method == 'vap'").n) == {9}


def test_a_method_that_has_errors_alone_has_its_rate_alone() -> None:
    """`report` fell on it."""
    of_vap = TABLE[TABLE.method == "vap"]
    errors = pd.DataFrame([{**row("soft", outcome="error"), **dict.fromkeys(STAGE_COLUMNS)}] * 2)
    both = pd.concat([of_vap, errors], ignore_index=True)
    assert left("soft", both) == {"SR": 0}
    assert funnel(funnel_table(both)).axes[0].get_title() == "vlabench"
    assert funnel(funnel_table(of_vap)).axes[0].get_title() == "vlabench (n 9)"


def test_a_method_that_reads_the_simulator_is_dashed() -> None:
    table = pd.concat([TABLE.assign(bound=False), TABLE.assign(bound=True, method="wrong-mask")])
    lines = funnel(funnel_table(table)).axes[0].lines
    styles = {line.get_label(): line.get_linestyle() for line in lines}
    assert (styles["vap"], styles["wrong-mask"]) == ("-", "--")


def test_a_report_of_methods_that_highlight_nothing_has_their_failures(tmp_path: Path) -> None:
    of_generic = TABLE[TABLE.method == "generic"].dropna(axis="columns", how="all")
    about = {"task": "select-cup", "seed": 0, "policy": "p", "case_sentence": "because"}
    table = of_generic.assign(**about, episode=[0, 1])
    page = report_page(
        Runs(table, table[:0], {}, ()), [], {}, pictures.empty_figure(1.0, 1.0), [], tmp_path
    )
    assert "Where episodes are lost" in page
    assert "Failures (2)" in page


def test_a_page_leaves_out_recorded_failures_of_runs_older_than_the_diagnosis(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their case, sub-case and deciding frame are not numbers and texts, but nothing."""

    monkeypatch.setattr("vap_core.recording.read_summary", lambda _: {**new, "steps": 9})
    about = {"task": "select-cup", "seed": 0, "policy": "p", "case_sentence": "because"}
    new = {**row("generic", "unprompted", "wrong object"), **about, "episode": 0}
    old = {name: new[name] for name in ("suite", "method", "outcome", "success", *about)}
    rows = [new, {**old, "episode": 1}, {**old, "episode": 2}]
    (tmp_path / "recordings").mkdir()
    for each in rows:
        name = recording_file_name("vlabench", "select-cup", each["episode"], 0, "generic")
        (tmp_path / "recordings" / name).write_bytes(b"")
    forest = pictures.empty_figure(1.0, 1.0)
    table = pd.DataFrame(rows)
    page = report_page(Runs(table, table[:0], {}, ()), [], {}, forest, [tmp_path], tmp_path)
    assert "Failures (1)" in page
    assert page.count("<article ") == 1
    assert "episode 0 · generic" in page
    assert "2 more of runs older than the diagnosis are left out" in page
