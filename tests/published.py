"""The published episodes, for the tests that check what the pages say of them."""

import pandas as pd

from tests.pages import ROOT
from vap_core.study.results import read_runs
from vap_core.study.stats import Estimate, rate, rate_over_layouts

RESULTS = ROOT / "data" / "results"


def episodes_of(name: str) -> pd.DataFrame:
    """The episodes of a published table, none of which ended in an error."""
    played = pd.concat([episodes for _, episodes in read_runs(RESULTS / f"{name}.parquet")])
    assert set(played.outcome) <= {"success", "failure"}
    return played


def method_of(cell: str) -> str:
    """The method of a table's line, which may be bold or marked as a bound."""
    return cell.split(" (")[0].strip("*").lower()


def of_way(told: pd.DataFrame, way: str) -> str:
    won = told[told.method == way].success
    return in_percent(rate(int(won.sum()), len(won))) if len(won) else ""


def over_layouts(told: pd.DataFrame, way: str) -> str:
    """As `of_way`; where a layout returns, the interval is over layouts."""
    rows = told[told.method == way]
    return in_percent(rate_over_layouts(rows)) if len(rows) else ""


def in_percent(found: Estimate) -> str:
    """A rate as the pages print it, without the sign: only 0 is 0, and only 1 is 100."""
    return str(found).replace(" %", "")
