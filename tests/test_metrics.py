"""Rates against SciPy, and tables with a fixed denominator."""

import math

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from vap_core.study.report import to_json
from vap_core.study.stats import rate, score, step_times


@given(st.integers(1, 400).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_interval_is_scipys_wilson(kn: tuple[int, int]) -> None:
    k, n = kn
    ours, theirs = rate(k, n), binomtest(k, n).proportion_ci(method="wilson")
    assert (ours.low, ours.high) == (
        pytest.approx(theirs.low, abs=1e-9),
        pytest.approx(theirs.high, abs=1e-9),
    )


def test_sixteen_of_twenty() -> None:
    assert str(rate(16, 20)) == "80 % [58, 92]"


def test_only_all_of_them_are_printed_as_a_hundred_percent() -> None:
    assert str(rate(1683, 1685)) == "99.9 % [99.6, >99.9]"
    assert str(rate(2, 1685)) == "0.1 % [<0.1, 0.4]"
    assert str(rate(40, 40)) == "100 % [91, 100]"
    assert str(rate(0, 40)) == "0 % [0, 9]"


def test_nothing_is_not_a_number() -> None:
    assert math.isnan(rate(0, 0).value)


def episode(**changes: object) -> dict[str, object]:
    base = {
        "suite": "s", "task": "t", "split": "", "method": "vap", "policy": "scripted", "outcome": "success", "success": True, "cmr": True,
        "wrong_object": False, "first_object_correct": True, "steps": 10, "seconds_render": 0.1,
    }  # fmt: skip
    return {**base, **changes}


def test_an_error_stays_in_the_denominator_and_wins_nothing() -> None:
    (line,) = score([episode(), episode(outcome="error", success=False, cmr=True)]).itertuples()
    assert (line.n, line.errors, line.sr_k, line.cmr_k) == (2, 1, 1, 1)


def test_groups_by_method() -> None:
    lines = score(
        [episode(), episode(method="generic", success=False, outcome="failure"), episode()]
    )
    assert [(s.method, s.n, s.sr_k) for s in lines.itertuples()] == [
        ("vap", 2, 2),
        ("generic", 1, 0),
    ]


def test_json_has_the_promised_fields() -> None:
    line = to_json(score([episode()]).to_dict("records")[0])
    assert {"suite", "task", "method", "n", "sr", "cmr", "wrong_object", "intervals"} <= line.keys()


def test_step_times_are_weighted_by_steps() -> None:
    assert step_times([episode(), episode(steps=30, seconds_render=0.7)]) == {
        "render": pytest.approx(20.0)
    }


def test_a_table_is_scored_as_its_rows_are() -> None:
    rows = [
        episode(task="a", cmr=None),
        episode(method="generic", outcome="error", success=False),
        episode(task="a", outcome="failure", success=False, cmr=None, steps=30),
        episode(wrong_object=True),
    ]
    one_by_one, at_once = score(rows), score(pd.DataFrame(rows))
    pd.testing.assert_frame_equal(one_by_one, at_once)
    assert [(s.task, s.method, s.n, s.errors, s.sr_k, s.cmr_n, s.wrong_object_k, s.steps) for s in at_once.itertuples()] == [
        ("a", "vap", 2, 0, 1, 0, 0, 40), ("t", "generic", 1, 1, 0, 1, 0, 10), ("t", "vap", 1, 0, 1, 1, 1, 10),
    ]  # fmt: skip
    assert step_times(pd.DataFrame(rows)) == step_times(rows)


def test_no_episodes_are_no_scores() -> None:
    assert score([]).empty
    assert step_times([]) == {}
