"""The survey's figures, its table, and the command that makes them."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyarrow.parquet import read_schema

from tests.command import vap
from vap_core.base.errors import BadOutput, UnknownName
from vap_core.simulation.suites import BENCHMARKS
from vap_core.study import survey, tracking
from vap_core.study.measurement import read
from vap_core.study.stats import (
    NONE,
    Estimate,
    average_precision,
    mean_by,
    precision,
    rate,
    share,
    share_by,
)
from vap_core.study.survey import ALL, Survey, publish, verdict

MARKS = st.lists(st.tuples(st.integers(0, 8), st.booleans()), max_size=12)


def test_average_precision_of_known_curves() -> None:
    score, hit = np.array([0.9, 0.8, 0.7]), np.array([True, False, True])
    assert average_precision(score, hit, 2.0) == pytest.approx(0.5 * 1 + 0.5 * 2 / 3)
    assert average_precision(score, hit, 4.0) == pytest.approx(0.25 * 1 + 0.25 * 2 / 3)
    assert average_precision(score[::-1], hit, 2.0) == pytest.approx(0.5 * 1 + 0.5 * 2 / 3)
    assert average_precision(np.zeros(0), np.zeros(0, bool), 3.0) == 0
    assert np.isnan(average_precision(score, hit, 0.0))


@given(MARKS, st.integers(0, 3))
def test_average_precision_agrees_with_a_slow_reference(
    marks: list[tuple[int, bool]], missed: int
) -> None:
    """The area by its definition: at every recall reached, the best precision at that recall or a higher one."""
    marks = sorted(marks, key=lambda mark: -mark[0])
    wanted = sum(hit for _, hit in marks) + missed
    curve = []
    for n in range(1, len(marks) + 1):
        right = sum(hit for _, hit in marks[:n])
        curve.append((right, right / n))
    slow = sum(
        max(p for reached, p in curve if reached >= r) for r in range(1, wanted - missed + 1)
    ) / max(wanted, 1)
    fast = average_precision(
        np.array([float(s) for s, _ in marks]),
        np.array([hit for _, hit in marks], bool),
        float(wanted),
    )
    assert (np.isnan(fast) and wanted == 0) or fast == pytest.approx(slow)


@given(MARKS, st.lists(st.integers(0, 3), min_size=12, max_size=12))
def test_a_detection_that_counts_twice_is_two_detections(
    marks: list[tuple[int, bool]], times: list[int]
) -> None:
    def arrays(chosen: list[tuple[int, bool]]) -> tuple[np.ndarray, np.ndarray]:
        return np.array([float(s) for s, _ in chosen]), np.array([hit for _, hit in chosen], bool)

    repeated = [mark for mark, n in zip(marks, times, strict=False) for _ in range(n)]
    weights = np.array(times[: len(marks)], np.float64)
    assert average_precision(*arrays(marks), 9.0, weights) == pytest.approx(
        average_precision(*arrays(repeated), 9.0)
    )


def test_share_ignores_what_is_not_known_and_has_wilsons_interval() -> None:
    found = share([True, None, False, float("nan"), True])
    assert (found.value, found.n) == (pytest.approx(2 / 3), 3)
    assert (found.low, found.high) == (rate(2, 3).low, rate(2, 3).high)
    assert share([]).text() == NONE.text() == "-"
    assert Estimate(0.5, float("nan"), float("nan"), 1).text() == "50.0 [?, ?] 1"
    assert Estimate(0.728, 0.63, 0.812, 96).share_text() == "73 % [63, 81] of 96"
    assert NONE.share_text() == "-"
    assert Estimate(0.972, 0.94, 0.987, 180).share_text() == "97 % [94, 99] of 180"
    assert Estimate(float("nan"), float("nan"), float("nan"), 0).share_text() == "-"


def frame(episodes: list[int], values: list[float | None]) -> pd.DataFrame:
    return pd.DataFrame({"suite": "s", "task": "t", "episode": episodes, "x": values})


EPISODE_COLUMNS = ["suite", "task", "episode"]


def test_rows_that_repeat_their_episode_do_not_narrow_its_share() -> None:
    """A track at six lengths of hiding is of one episode."""
    once = frame(list(range(8)), [1, 1, 1, 1, 1, 1, 0, 0])
    six_times = pd.concat([once] * 6)
    alone = share_by(once, "x", EPISODE_COLUMNS)
    repeated = share_by(six_times, "x", EPISODE_COLUMNS)
    wilson = rate(6, 8)
    assert (alone.value, alone.n, repeated.n) == (0.75, 8, 48)
    assert (alone.low, alone.high) == pytest.approx((wilson.low, wilson.high))
    assert (repeated.low, repeated.high) == pytest.approx((alone.low, alone.high))
    assert share(six_times.x).low > alone.low + 0.15, "as if each row were an episode"
    unknown = frame([0, 1, 1], [1, None, None])
    assert share_by(unknown, "x", EPISODE_COLUMNS).n == 1
    assert share_by(unknown[1:], "x", EPISODE_COLUMNS).text() == "-"


def test_mean_is_bootstrapped_by_episode_not_by_view() -> None:
    values = np.random.default_rng(3).normal(size=30)
    apart, thrice = (
        mean_by(frame([*range(30)], list(values)), "x"),
        mean_by(frame([*range(30)] * 3, [*values] * 3), "x"),
    )
    assert apart.value == pytest.approx(values.mean()) == pytest.approx(thrice.value)
    assert (apart.low, apart.high) == (pytest.approx(thrice.low), pytest.approx(thrice.high))
    error = values.std() / np.sqrt(30)
    assert apart.high - apart.low == pytest.approx(2 * 1.96 * error, rel=0.15)
    assert mean_by(frame([0, 1], [None, 2.0]), "x").n == 1
    assert mean_by(frame([0], [None]), "x") is NONE


def test_precision_is_the_mean_over_tasks() -> None:
    def lines(**columns: list) -> pd.DataFrame:
        return pd.DataFrame({"suite": "s", **columns})

    wanted = lines(task=["a", "a", "b"], episode=[0, 1, 0])
    found = lines(
        task=["a", "b", "b"], episode=[0, 0, 5], score=[0.9, 0.9, 0.8], hit=[True, True, False]
    )
    both = precision(found, wanted)
    assert (both.value, both.n) == (pytest.approx((0.5 + 1) / 2), 3)
    assert both.low <= both.value <= both.high
    assert precision(found, wanted[:0]) is NONE


def test_a_measure_names_the_suites_that_miss_its_target() -> None:
    cells = {
        "one": Estimate(0.97, 0.9, 1.0, 50),
        "two": Estimate(0.96, 0.9, 1.0, 50),
        "none": NONE,
        ALL: Estimate(0.965, 0.9, 1.0, 100),
    }
    assert verdict(0.97, cells) == "short: two"
    assert verdict(0.96, cells) == "met"
    assert verdict(0.5, {"none": NONE}) == "not measured"
    assert verdict(None, cells) == ""


def test_the_plan_is_the_same_every_time_and_every_part_has_its_own_name() -> None:
    jobs = [job for job in Survey().jobs() if job.what is not None]
    assert [job.name for job in jobs] == [
        job.name for job in Survey().jobs() if job.what is not None
    ]
    assert len({job.name for job in jobs}) == len(jobs)
    of_rows = [job for job in jobs if not isinstance(job.what, tracking.Job)]
    opened = [row.key for job in of_rows if not job.together for row in job.what]
    compared = Counter(row.suite for job in of_rows if job.together for row in job.what)
    assert compared == {
        **{"vlabench": 250, "vlabench-dev": 100, "tabletop": 160, "tabletop-dev": 96},
        **{"vlabench-absent": 60, "tabletop-absent": 96},
        **{"simpler-bridge-absent": 48, "simpler-fractal-absent": 24},
    }
    wanted = sum(n * len(BENCHMARKS[suite].tasks) for suite, n in survey.EPISODES.items())
    assert len(opened) == len(set(opened)) == wanted > 200
    assert [isinstance(job.what, tracking.Job) for job in jobs] == sorted(
        (isinstance(job.what, tracking.Job) for job in jobs), reverse=True
    )


def test_unknown_names_are_refused() -> None:
    with pytest.raises(
        UnknownName,
        match="known: libero-personal, libero-personal-dev, simpler-bridge, simpler-fractal, tabletop, vlabench",
    ):
        Survey(suites=("widowx-pick",))
    with pytest.raises(UnknownName, match="embedded"):
        Survey(stack="none")


def test_a_folder_that_is_no_finished_survey_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadOutput, match=r"lacks views\.parquet, .*; run the same"):
        publish(tmp_path, tmp_path / "kept")


@pytest.mark.sweep
def test_the_command_measures_resumes_and_publishes(tmp_path: Path) -> None:
    out = tmp_path / "run"
    small = ["--quick", "--suite", "simpler-fractal", "--workers", "1"]
    words = [
        "measure",
        "perception",
        *small,
        "--out",
        str(out),
        "--publish",
        str(tmp_path / "kept"),
    ]
    done = vap(*words)
    assert done.returncode == 0, done.stderr
    for told in (
        "detection AP50",
        ">= 97",
        "K = 7, average",
        "simpler-fractal head",
        "x encoder pass",
        "left out: simpler-fractal 0 of 4",
    ):
        assert told in done.stdout
    tables = read(out, Survey.caller, survey.TABLES)
    assert len(tables["views"]) == 4
    assert len(tables["choices"]) == 4 * 4 * 2
    assert set(tables["tracks"].hidden) == {0, 3}
    assert len(tables["references"]) == 2 * 4
    measured = {
        line["measure"]: line["cells"]["all"]
        for line in json.loads((out / "summary.json").read_text())
    }
    assert (
        sum((measured[f"right instance, {tier}"] or {"n": 0})["n"] for tier in ("standard", "hard"))
        == 4
    )
    held = json.loads(read_schema(tmp_path / "kept" / "perception_views.parquet").metadata[b"run"])
    assert set(held["configuration"]) >= {
        "weights",
        "lists",
        "version",
        "world",
        "seed",
        "episodes",
    }

    lost = next((out / "parts").glob("openings.simpler-fractal.pick*.json"))
    kept = {
        part.name: part.stat().st_mtime_ns for part in (out / "parts").iterdir() if part != lost
    }
    lost.unlink()
    asked = Survey(suites=("simpler-fractal",), quick=True)
    again = survey.run_survey(asked, out, workers=1, progress=False)
    assert {
        part.name: part.stat().st_mtime_ns for part in (out / "parts").iterdir() if part != lost
    } == kept
    assert all(tables[name].equals(again[name]) for name in survey.TABLES)
    lost.write_text("{")
    with pytest.raises(BadOutput, match="is damaged; delete it and run the same command again"):
        survey.run_survey(asked, out, workers=1, progress=False)
    with pytest.raises(BadOutput, match="holds another run"):
        survey.run_survey(replace(asked, suites=("tabletop",)), out, workers=1, progress=False)
