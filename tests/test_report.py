"""The report of synthetic runs: to the letter for a tiny one, in seconds for a large one.

It tells what is missing, and of damage one line.
"""

import csv
import json
import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest

from tests.command import vap
from vap_core.base.errors import BadOutput
from vap_core.base.files import DATA
from vap_core.simulation import suites
from vap_core.study.report import conclude, report
from vap_core.study.results import errors, load_runs, outcomes, publish, results
from vap_core.study.stats import ALL_TASKS, compare, rate, rate_over_layouts
from vap_core.study.store import append, open_run
from vap_core.study.table import printed
from vap_core.study.trials import Study

BRIDGE = (("simpler-bridge", "pick-shaver"), ("simpler-bridge", "put-camera"))
GOLDEN = Path(__file__).parent / "golden_report.md"
FELL_OFF = "Traceback (most recent call last):\n  ...\nRuntimeError: the arm | fell off\n"


def run(
    folder: Path,
    tasks: tuple[tuple[str, str], ...] = BRIDGE,
    episodes: int | None = 6,
    seed: int = 0,
    keep: float = 1.0,
    label: str = "scripted",
    **changes: Any,
) -> Path:
    """A run whose outcomes follow from the episode alone.

    vap wins all but every third, generic every third; vap's last one is an error.
    """
    names = dict.fromkeys(suite for suite, _ in tasks)
    study = {
        "tasks": [list(task) for task in tasks],
        "methods": ["generic", "vap"],
        "episodes": episodes,
        "seed": seed,
        "policy": "scripted",
        "lists": {name: suites.lists.digest(name) for name in names if name in suites.BENCHMARKS},
        "version": "0.1.0",
        **changes,
    }
    rows = []
    for suite, task in tasks:
        listed = suites.rows(suite, task, episodes, seed)
        for i, row in enumerate(listed):
            for method in study["methods"]:
                won, error = (
                    (i % 3 > 0) if method == "vap" else (i % 3 == 1),
                    method == "vap" and i == len(listed) - 1,
                )
                rows.append(
                    {
                        "suite": suite,
                        "task": task,
                        "split": row.split,
                        "variant": row.variant,
                        "episode": row.episode,
                        "seed": seed,
                        "method": method,
                        "policy": label,
                        "outcome": "error" if error else "success" if won else "failure",
                        "success": won and not error,
                        "success_once": won,
                        "held_steps": 0,
                        "cmr": None if row.rule == "selected" else i % 3 > 0,
                        "wrong_object": method == "generic" and i == 0,
                        "first_object_correct": won,
                        "steps": 10,
                        "margin": None,
                        "attempt": 2 if i == 2 else 1,
                        "detail": FELL_OFF if error else "",
                    }
                )
    open_run(folder, study)
    append(folder, rows[: round(keep * len(rows))])
    return folder


def plain(text: str, *folders: Path) -> str:
    """Without what differs from machine to machine: folders and digests."""
    for i, folder in enumerate(folders):
        text = text.replace(str(folder), f"RUN{i}")
    return re.sub(r"digest \w{16}", "digest D", text)


def test_a_tiny_run_is_reported_to_the_letter(tmp_path: Path) -> None:
    folder, out = run(tmp_path / "run"), tmp_path / "out"
    shown = report([folder], out).splitlines()
    assert shown[0] == (
        "simpler-bridge: vap succeeds in 50.0 % of 12, generic in 33.3 % of 12; "
        "vap - generic: +16.7 [+0.0, +50.0] points, p 0.500 (scripted)"
    )
    assert len(shown) <= 18
    assert plain((out / "report.md").read_text(), folder) == GOLDEN.read_text()
    assert sorted(path.name for path in out.iterdir()) == [
        "comparisons.csv",
        "forest.png",
        "outcomes.csv",
        "paired.png",
        "provenance.csv",
        "report.html",
        "report.md",
        "results.csv",
    ]
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    report([folder], out)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before, (
        "the same run, the same files"
    )


def test_a_checkpoint_goes_by_its_label_not_by_its_path(tmp_path: Path) -> None:
    lines = results(
        load_runs([run(tmp_path / "run", policy="some/where/last", label="pi0:last@0123abcd")])
    )
    assert set(lines.policy) == {"pi0:last@0123abcd"}
    assert lines[lines.task != ALL_TASKS].n.tolist() == [6] * 4


def test_the_golden_numbers_by_hand(tmp_path: Path) -> None:
    report([run(tmp_path / "run")], tmp_path)
    with (tmp_path / "results.csv").open() as file:
        lines = {(line["task"], line["method"]): line for line in csv.DictReader(file)}
    shaver, both = lines["pick-shaver", "vap"], lines[ALL_TASKS, "vap"]
    assert [shaver[name] for name in ("n", "asked", "listed", "errors", "sr_k", "cmr_k")] == [
        "6",
        "6",
        "24",
        "1",
        "3",
        "3",
    ]
    assert [both[name] for name in ("n", "listed", "errors", "sr_k")] == ["12", "48", "2", "6"]
    assert float(shaver["sr_fraction"]) == 0.5
    assert (
        float(shaver["paper_sr_fraction"]),
        float(shaver["paper_cmr_fraction"]),
    ) == pytest.approx((0.713, 0.829))
    (pair,) = (
        pd.read_csv(tmp_path / "comparisons.csv").query("task == 'pick-shaver'").to_dict("records")
    )
    assert [
        pair[name]
        for name in ("one", "other", "pairs", "both", "only_one", "only_other", "neither")
    ] == ["generic", "vap", 6, 2, 0, 1, 3]
    (end,) = pd.read_csv(tmp_path / "outcomes.csv").query("method == 'vap'").to_dict("records")
    assert [
        end[name]
        for name in ("asked", "run", "success", "failure", "error", "retried", "most_attempts")
    ] == [12, 12, 6, 4, 2, 2, 2]


def test_all_tasks_are_the_same_for_every_method(tmp_path: Path) -> None:
    """A method that was run on one task of two stands beside the others as half a list."""
    one = run(tmp_path / "one", methods=["oracle-mask"], tasks=BRIDGE[:1])
    lines = results(load_runs([run(tmp_path / "both"), one]))
    together = lines[lines.task == ALL_TASKS].set_index("method")
    assert together.n.to_dict() == {"generic": 12, "vap": 12, "oracle-mask": 6}
    assert set(together.listed) == {48}
    ended = outcomes(load_runs([tmp_path / "both", one])).set_index("method")
    assert ended.listed.to_dict() == dict.fromkeys(together.index, 48)
    assert ended.asked.to_dict() == together.n.to_dict()


def test_a_suite_without_a_list_has_what_each_method_was_asked_for(tmp_path: Path) -> None:
    tasks = tuple(("widowx-pick", task.name) for task in suites.suite("widowx-pick").tasks[:2])
    some = run(tmp_path / "some", tasks=tasks, episodes=2, methods=["vap"])
    lines = results(load_runs([run(tmp_path / "more", tasks=tasks, methods=["generic"]), some]))
    together = lines[lines.task == ALL_TASKS].set_index("method")
    assert together.listed.to_dict() == together.n.to_dict() == {"generic": 12, "vap": 4}


def test_a_bar_in_a_cell_stays_in_its_cell() -> None:
    assert printed([["a"], ["x|y"]], "markdown").splitlines() == [
        "| a    |",
        "|------|",
        r"| x\|y |",
    ]


def test_a_published_table_is_reported_like_its_runs(tmp_path: Path) -> None:
    folders = [
        run(tmp_path / "one", seeds=1),
        run(tmp_path / "two", tasks=(("tabletop", "put-plant"),), seeds=1),
    ]
    publish(folders, tmp_path / "kept.parquet")
    one, two = load_runs(folders), load_runs([tmp_path / "kept.parquet"])
    columns = [name for name in one.table if name != "detail"]
    pd.testing.assert_frame_equal(one.table[columns], two.table[columns], check_dtype=False)
    pd.testing.assert_frame_equal(results(one), results(two))
    (tmp_path / "kept.parquet").write_bytes((tmp_path / "kept.parquet").read_bytes()[:100])
    with pytest.raises(BadOutput, match="no table of finished runs"):
        load_runs([tmp_path / "kept.parquet"])


def test_what_reads_the_simulator_is_marked(tmp_path: Path) -> None:
    folder = run(tmp_path / "run")
    runs = load_runs([folder])
    assert not results(runs)["bound"].any()
    runs.table["bound"] = runs.table["method"].eq("vap")
    marked = results(runs).groupby("method")["bound"].agg(["all", "any"])
    assert marked.loc["vap"].all()
    assert not marked.loc["generic"].any()


def test_a_policy_that_reads_the_simulator_is_marked_in_runs_that_do_not_say_so() -> None:
    bounds = results(load_runs([DATA / "results" / "bounds.parquet"]))
    assert set(bounds["policy"]) == {"expert", "random"}
    assert bounds["bound"].all()


def test_the_tables_of_a_page_say_of_which_list_they_are(tmp_path: Path) -> None:
    tasks = (*BRIDGE, ("tabletop", "select-cup"))
    report([run(tmp_path / "run", tasks)], tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text()
    assert re.findall(r"<h3>(.+?)</h3>", page) == ["simpler-bridge", "tabletop"]


def test_an_unfinished_run_is_reported_as_it_is(tmp_path: Path) -> None:
    folder = run(tmp_path / "run", keep=0.75)
    assert "unfinished: " in report([folder], tmp_path / "out")
    text = (tmp_path / "out" / "report.md").read_text()
    assert "18 of the 24 episodes that 1 run asked for." in text
    assert (
        f"**Unfinished**: {folder} is unfinished: 18 of 24 episodes; run the same command again to "
        "finish it." in text
    )
    page = (tmp_path / "out" / "report.html").read_text()
    assert "<strong>Unfinished</strong>: " in page
    lines = results(load_runs([folder])).set_index(["task", "method"])
    assert lines.loc["put-camera", "n"].tolist() == [3, 3]
    early = run(tmp_path / "early", keep=0.5)  # one task is not there at all
    lines = results(load_runs([early])).set_index(["task", "method"])
    assert lines.loc["put-camera", "n"].tolist() == [0, 0]
    report([early], tmp_path / "out")
    assert "0 of 24" in (tmp_path / "out" / "report.md").read_text()


def test_runs_that_saw_otherwise_are_told_apart(tmp_path: Path) -> None:
    """VAP with one stack and another's generic are paired; the report says what that compares."""
    seen = {"stack": "embedded", "follow": "call"}
    one = run(tmp_path / "one", **seen)
    alike = run(tmp_path / "alike", seed=1, **seen)
    other = run(tmp_path / "other", seed=2, **seen | {"stack": "foundation"})
    text = tmp_path / "out" / "report.md"
    report([one, alike], text.parent)
    assert "Not alike" not in text.read_text()
    report([one, other], text.parent)
    assert (
        "**Not alike**: the runs of simpler-bridge differ in stack (embedded, foundation); a "
        "comparison over several of them compares that, too." in text.read_text()
    )
    elsewhere = run(tmp_path / "elsewhere", label="mine", stack="foundation")
    assert load_runs([one, elsewhere]).unlike == []


def test_seeds_of_a_benchmark_are_one_report_with_layouts_for_units(tmp_path: Path) -> None:
    runs = load_runs([run(tmp_path / str(seed), seed=seed) for seed in range(3)])
    lines = results(runs).set_index(["task", "method"])
    shaver = lines.loc[("pick-shaver", "vap")]
    assert (shaver.n, shaver.listed, shaver.seeds, shaver.layouts) == (18, 72, 3, 6)
    assert shaver.sr_layout_low < shaver.sr_low, "Wilson's 18 independent episodes claim too much"
    (c,) = (c for c in compare(runs.table, runs.methods).itertuples() if c.task == "pick-shaver")
    assert (c.pairs, c.layouts) == (18, 6)
    once = results(load_runs([tmp_path / "0"])).set_index(["task", "method"]).loc["pick-shaver"]
    assert once["sr_layout_low"].isna().all(), "no layout returns: Wilson alone"
    rows = runs.table[(runs.table.task == "pick-shaver") & (runs.table.method == "vap")]
    found = rate_over_layouts(rows.drop(columns="layout"))
    assert (found.value, found.low, found.high) == tuple(
        shaver[["sr", "sr_layout_low", "sr_layout_high"]]
    )
    alone = rows[rows.seed == 0]
    assert rate_over_layouts(alone).low == rate(int(alone.success.sum()), 6).low


def test_the_end_of_a_run_is_at_most_twenty_lines_and_opens_with_the_finding(
    tmp_path: Path,
) -> None:
    study = Study(BRIDGE, ("generic", "vap"), episodes=6, policy="scripted")
    folder = run(tmp_path / "run")
    said = conclude(study, load_runs([folder]).table, folder).splitlines()
    assert said[0].startswith("simpler-bridge: vap succeeds in 50.0 % of 12, generic in 33.3 %")
    assert len(said) <= 20
    assert any(line.startswith("errors: 2 x RuntimeError") for line in said)
    assert any(line.startswith("| all tasks") or "all tasks" in line for line in said)


def test_layouts_that_all_succeed_leave_room_for_one_that_fails(tmp_path: Path) -> None:
    sources = [run(tmp_path / str(seed), BRIDGE[:1], seed=seed) for seed in range(2)]
    runs = load_runs(sources)
    won = replace(runs, table=runs.table.assign(success=True, outcome="success"))
    line = results(won).iloc[0]
    assert (line.sr, line.layouts, line.sr_layout_high) == (1.0, 6, 1.0)
    exact = binomtest(6, 6).proportion_ci(method="exact")
    assert line.sr_layout_low == pytest.approx(exact.low, abs=1e-12)


def test_one_run_of_several_seeds_is_several_runs_of_one(tmp_path: Path) -> None:
    apart = [run(tmp_path / str(seed), seed=seed) for seed in range(2)]
    held = json.loads((apart[0] / "run.json").read_text())["configuration"]
    both = open_run(tmp_path / "both", {**held, "seeds": 2})
    append(
        both,
        [
            row
            for folder in apart
            for row in pd.read_parquet(next((folder / "parts").iterdir())).to_dict("records")
        ],
    )
    pd.testing.assert_frame_equal(results(load_runs([both])), results(load_runs(apart)))
    report([both], tmp_path / "out")
    assert "seed 0..1" in (tmp_path / "out" / "report.md").read_text()


def test_the_order_of_runs_and_rows_changes_no_number(tmp_path: Path) -> None:
    one, two = run(tmp_path / "one"), run(tmp_path / "two", seed=1)
    keys = ["task", "method"]
    there, back = (
        results(load_runs(folders)).sort_values(keys, ignore_index=True)
        for folders in ([one, two], [two, one])
    )
    pd.testing.assert_frame_equal(there, back)


def test_errors_are_counted_by_their_last_line(tmp_path: Path) -> None:
    runs = load_runs([run(tmp_path / "run")])
    assert errors(runs) == ["2 x RuntimeError: the arm | fell off"]
    table = runs.table.assign(outcome="error", detail=[f"E{i}" for i in range(len(runs.table))])
    assert (
        errors(type(runs)(table, runs.wanted, runs.manifests, ()), limit=2)[-1]
        == f"and {len(table) - 2} of {len(table) - 2} other kinds"
    )


def test_a_run_without_attempts_or_comparisons(tmp_path: Path) -> None:
    folder = run(tmp_path / "run")
    part = next((folder / "parts").iterdir())
    table = pd.read_parquet(part).assign(attempt=np.nan)
    table[table.method == "vap"].to_parquet(part)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "paired.png").write_bytes(b"of another report")
    report([folder], tmp_path / "out")
    text = (tmp_path / "out" / "report.md").read_text()
    assert "No two methods ran the same episodes under one policy." in text
    assert "not kept" in text
    assert not (tmp_path / "out" / "paired.png").exists()


def damage(folder: Path, how: str) -> str:
    """Break a run, and return what must be said about it."""
    note, part = folder / "run.json", next((folder / "parts").iterdir())
    held, table = json.loads(note.read_text()), pd.read_parquet(part)
    if how == "no note":
        note.unlink()
        return "run.json is absent or damaged"
    if how == "torn part":
        part.write_bytes(part.read_bytes()[:500])
        return f"{part.name} is damaged; delete it"
    if how == "no rows":
        part.unlink()
        return "holds no finished episode yet; run the same command again"
    if how == "other rows":
        table.assign(episode=table.episode + 100).to_parquet(part)
        return (
            "run is damaged: it was never asked for 24 of its episodes, the first "
            "simpler-bridge/pick-shaver episode 100 seed 0 of method generic"
        )
    if how == "another method":
        table.replace({"vap": "nap"}).to_parquet(part)
        return "run is damaged: it was never asked for 12 of its episodes"
    if how == "old columns":
        table.drop(columns=["variant", "cmr"]).to_parquet(part)
        return "lacks the columns variant, cmr"
    if how == "other list":
        held["configuration"]["lists"]["simpler-bridge"] = "0" * 64
    if how == "another command":
        held["configuration"] = {"stack": "embedded"}
    note.write_text(json.dumps(held))
    return {
        "other list": "the list of simpler-bridge has changed since",
        "another command": "holds no run of eval, rollout or demo",
    }[how]


@pytest.mark.parametrize(
    "how",
    [
        "no note",
        "torn part",
        "no rows",
        "other rows",
        "another method",
        "old columns",
        "other list",
        "another command",
    ],
)
def test_damage_is_told_in_one_line(tmp_path: Path, how: str) -> None:
    folder = run(tmp_path / "run")
    wanted = damage(folder, how)
    with pytest.raises(BadOutput) as told:
        report([folder], tmp_path / "out")
    assert wanted in str(told.value)
    assert "\n" not in str(told.value)
    assert not (tmp_path / "out").exists()


def test_the_same_episodes_twice_are_refused_and_a_run_named_twice_counts_once(
    tmp_path: Path,
) -> None:
    one, other = run(tmp_path / "one"), run(tmp_path / "other")
    with pytest.raises(BadOutput, match="hold the same episodes; name each run once"):
        load_runs([one, other])
    assert len(load_runs([one, one]).table) == len(load_runs([one]).table)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"object": "mug"}, "has plain robots in .*one, and plain robots and the object mug in"),
        ({"robots": "menagerie"}, "put-camera has plain robots in .*one, and menagerie robots in"),
    ],
)
def test_runs_of_other_scenes_are_no_pair(
    tmp_path: Path, changes: dict[str, Any], match: str
) -> None:
    one = run(tmp_path / "one", methods=["generic"], robots="plain")
    other = run(tmp_path / "other", methods=["vap"], tasks=BRIDGE[1:], **changes)
    with pytest.raises(BadOutput, match=f"{match} .*other: .*; report them one by one.") as caught:
        load_runs([one, other])
    assert "\n" not in str(caught.value)


def test_the_paper_has_no_number_of_an_object_of_ones_own(tmp_path: Path) -> None:
    listed = run(tmp_path / "listed", tasks=BRIDGE[:1])
    assert results(load_runs([listed]))["paper_sr"].notna().all()
    own = run(tmp_path / "own", tasks=BRIDGE[1:], object="mug")
    lines = results(load_runs([own]))
    assert lines["paper_sr"].isna().all()
    assert lines["paper_method"].isna().all()
    report([listed, own], tmp_path / "out")
    text = (tmp_path / "out" / "report.md").read_text()
    rows = [line for line in text.splitlines() if line.startswith("| put-camera")]
    assert rows
    assert not any("pi0" in line for line in rows), "nor in rows of its own"


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(
        BadOutput, match="file cannot be written .*choose another folder with --out"
    ):
        report([run(tmp_path / "run")], tmp_path / "file")


def test_the_command_prints_what_it_writes(tmp_path: Path) -> None:
    folder = run(tmp_path / "run")
    done = vap("report", folder)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("simpler-bridge: vap succeeds in 50.0 %")
    assert len(done.stdout.splitlines()) <= 20
    (folder / "run.json").unlink()
    refused = vap("report", folder)
    assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (2, "", 1)
    assert refused.stderr.startswith("error: run: ")


@pytest.mark.sweep
def test_a_hundred_thousand_rows_take_seconds(tmp_path: Path) -> None:
    """Processor time, shapes checked as in every test: 23 seeds of all four lists, two methods."""
    tasks = tuple(
        (name, task.name) for name in suites.BENCHMARKS for task in suites.suite(name).tasks
    )
    first = run(tmp_path / "0", tasks, episodes=None)
    table, held = (
        pd.read_parquet(next((first / "parts").iterdir())),
        json.loads((first / "run.json").read_text())["configuration"],
    )
    folders = [first]
    for seed in range(1, 23):
        folder = open_run(tmp_path / str(seed), {**held, "seed": seed})
        (folder / "parts").mkdir()
        won = np.random.default_rng(seed).random(len(table)) < np.where(
            table.method == "vap", 0.7, 0.4
        )
        table.assign(
            seed=seed, success=won, outcome=np.where(won, "success", "failure")
        ).to_parquet(folder / "parts" / "a.parquet")
        folders.append(folder)
    start = time.process_time()
    report(folders, tmp_path / "out")
    took = time.process_time() - start
    text = (tmp_path / "out" / "report.md").read_text()
    assert text.splitlines()[2 + 1 + 5] == "100786 of the 100786 episodes that 23 runs asked for."
    assert took < 10, f"{took:.1f} s"
