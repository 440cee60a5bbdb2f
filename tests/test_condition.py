"""A condition is SQL from outside: whatever it holds, the answer is rows or one line of error."""

import pandas as pd
import pytest

from vap_core.base.errors import BadStudy
from vap_core.base.files import rows_matching

TABLE = pd.DataFrame({"steps": [1, 20, 30], "suite": ["a", "b", "b"], "margin": [0.1, 0.2, None]})


@pytest.mark.parametrize(
    ("condition", "kept"),
    [
        ("steps > 10 and suite = 'b'", [20, 30]),
        ("margin is null", [30]),
        ("coalesce(margin, 1) < 0.5 and length(suite) = 1", [1, 20]),
        ("upper(suite) like 'B%' and abs(steps - 25) <= 5", [20, 30]),
        ("suite in ('a') or steps between 25 and 35", [1, 30]),
        ("case when suite = 'a' then false else cast(steps as double) < 25 end", [20]),
        (" or ".join(["steps = 1"] * 300), [1]),
        ("steps = " + "+".join(["1"] * 300), []),
        ("(" * 40 + "steps = 1" + ")" * 40, [1]),
    ],
)
def test_rows_for_which_it_holds(condition: str, kept: list[int]) -> None:
    assert rows_matching(TABLE, condition)["steps"].tolist() == kept


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        (" or ".join(["steps = 1"] * 20_000), "it has 259,996 characters .* 4,000"),
        ("cast(" * 300 + "steps" + " as int)" * 300, "300 nested brackets"),
        ("cast(" * 41 + "steps" + " as int)" * 41 + " > 0", "41 nested brackets; 4,000 and 40 are"),
        ("length(repeat(suite, 1000000000)) > 0", "'repeat'"),
        ("length(rpad(suite, 2000000000)) > 0", "'rpad'"),
        ("random() < 0.5", "'random'"),
        ("length(regexp_replace(suite, '.*', 'xx')) > 0", "'regexp_replace'"),
        ("- " * 1_900 + "steps = 1", "is none on this table"),
        ("not " * 900 + "(steps = 1)", "is none on this table"),
        ("line > 0", "is none on this table"),
        ("x" * 3_000, "is none on this table"),
    ],
)
def test_what_could_end_the_process_is_refused(condition: str, message: str) -> None:
    with pytest.raises(BadStudy, match=message) as caught:
        rows_matching(TABLE, condition)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


def test_a_column_of_any_name_can_be_asked() -> None:
    assert rows_matching(TABLE.assign(line=[7, 8, 9]), "line = 8")["steps"].tolist() == [20]


def test_of_a_table_without_rows_none_match() -> None:
    assert rows_matching(TABLE.iloc[:0], "steps > 3").empty
    with pytest.raises(BadStudy, match="is none on this table"):
        rows_matching(TABLE.iloc[:0], "nonesuch > 3")
