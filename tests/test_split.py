"""One split of a list: which episodes it takes, and that whatever counts them knows it."""

from dataclasses import replace
from pathlib import Path

import pytest

from vap_core.base.errors import BadStudy
from vap_core.simulation import suites
from vap_core.study.engine import run
from vap_core.study.report import rescore
from vap_core.study.results import load_runs, publish, read_runs, results
from vap_core.study.trials import Study

SUITE = "simpler-fractal"
TASKS = tuple((SUITE, task.name) for task in suites.suite(SUITE).tasks)
WHOLE = Study(TASKS, ("generic",), policy="random")
SPLIT = replace(WHOLE, split="visual matching")


def test_a_split_is_part_of_the_list_and_so_many_are_spread_over_it() -> None:
    for suite, task in TASKS:
        part = SPLIT.rows(suite, task)
        assert part == tuple(
            row for row in WHOLE.rows(suite, task) if row.split == "visual matching"
        )
        few = replace(SPLIT, episodes=3).rows(suite, task)
        assert (few[0], few[-1], len(few)) == (part[0], part[-1], 3)
    assert sum(len(SPLIT.rows(*task)) for task in TASKS) == 460


def test_it_makes_another_run_and_without_it_runs_are_those_of_before() -> None:
    assert "split" not in WHOLE.configuration()
    assert SPLIT.configuration()["split"] == "visual matching"


def test_a_split_that_is_not_there_is_one_line() -> None:
    with pytest.raises(BadStudy, match=r"has no split 'visual'; it has variant .* and visual"):
        replace(WHOLE, split="visual")
    with pytest.raises(BadStudy, match="simpler-bridge/pick-shaver .* its list has no splits"):
        Study((("simpler-bridge", "pick-shaver"),), ("vap",), split="visual matching")
    with pytest.raises(BadStudy, match="widowx-pick/pick-bottle .* its list has no splits"):
        Study((("widowx-pick", "pick-bottle"),), ("vap",), split="visual matching")


def test_its_run_is_whole_for_report_rescoring_and_publishing(tmp_path: Path) -> None:
    study = replace(SPLIT, tasks=TASKS[:1], episodes=2)
    run(study, tmp_path / "run", workers=1)
    (line,) = results(load_runs([tmp_path / "run"])).itertuples()
    assert (line.split, line.n, line.listed) == ("visual matching", 2, len(SPLIT.rows(*TASKS[0])))
    rescore(tmp_path / "run")
    publish([tmp_path / "run"], tmp_path / "table.parquet")
    ((_, episodes),) = read_runs(tmp_path / "table.parquet")
    assert set(episodes.split) == {"visual matching"}
