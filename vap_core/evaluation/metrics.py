"""SR, CMR and wrong-object rate with 95 % intervals, over a fixed denominator.

P 5.1, SPEC section 6.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64, Int64

from vap_core.base.types import value

if TYPE_CHECKING:
    import pandas as pd

MEASURES = ("success", "cmr", "wrong_object", "first_object_correct")
RATES = ("sr", "cmr", "wrong_object", "first_object_correct")
"""The rate of each of MEASURES."""
TRACK = ["suite", "split"]
"""The columns that name a track: a suite, and its split where it has several."""
SCORE_KEY = ("suite", "task", "split", "method", "policy")
"""The columns that name one line of a results table."""
Counts = Int64[np.ndarray, " g"]
Bounds = Float64[np.ndarray, " g"]


@value
class Rate:
    """k successes of n with the 95 % interval, as fractions: Wilson's unless said otherwise.

    n may be 0, then `value`, `low` and `high` are nan.
    """

    k: int
    n: int
    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if self.n == 0:
            return "-"
        low = _whole_percent(self.low)
        high = _whole_percent(self.high)
        return f"{_whole_percent(self.value)} % [{low}, {high}]"


def intervals(k: Counts, n: Counts) -> tuple[Bounds, Bounds]:
    """95 % intervals of k out of n, nan where n is 0.

    Wilson's score intervals.
    """
    from statsmodels.stats.proportion import proportion_confint

    low = np.full(len(n), np.nan)
    high = np.full(len(n), np.nan)
    some = n > 0
    if some.any():
        low[some], high[some] = proportion_confint(k[some], n[some], alpha=0.05, method="wilson")
    return low, high


def rate(k: int, n: int) -> Rate:
    """k out of n with its interval (see `intervals`)."""
    if n == 0:
        return Rate(0, 0, float("nan"), float("nan"), float("nan"))
    low, high = intervals(np.array([k]), np.array([n]))
    return Rate(k, n, k / n, float(low[0]), float(high[0]))


@value
class Score:
    """One line of a results table.

    Errors stay in the denominator and count as neither success nor movement.
    """

    suite: str
    task: str
    split: str
    method: str
    policy: str
    n: int
    errors: int
    sr: Rate
    cmr: Rate
    wrong_object: Rate
    first_object_correct: Rate
    steps: int

    def to_json(self) -> dict[str, Any]:
        values: dict[str, float | None] = {}
        bounds: dict[str, list[float] | None] = {}
        for name in RATES:
            each = getattr(self, name)
            values[name] = bounds[name] = None
            if each.n:
                values[name] = each.value
                bounds[name] = [each.low, each.high]
        return {
            "suite": self.suite,
            "task": self.task,
            "split": self.split,
            "method": self.method,
            "policy": self.policy,
            "n": self.n,
            "errors": self.errors,
            **values,
            "intervals": bounds,
        }


def score(episodes: "Iterable[Mapping[str, Any]] | pd.DataFrame") -> list[Score]:
    """Scores of flat episode rows (`Episode.summary`) by SCORE_KEY, in order of appearance."""
    scores = []
    for line in count(episodes, SCORE_KEY).to_dict("records"):
        each = Score(
            suite=str(line["suite"]),
            task=str(line["task"]),
            split=str(line["split"]),
            method=str(line["method"]),
            policy=str(line["policy"]),
            n=int(line["n"]),
            errors=int(line["errors"]),
            sr=_rate_of(line, "success"),
            cmr=_rate_of(line, "cmr"),
            wrong_object=_rate_of(line, "wrong_object"),
            first_object_correct=_rate_of(line, "first_object_correct"),
            steps=int(line["steps"]),
        )
        scores.append(each)
    return scores


def count(
    episodes: "Iterable[Mapping[str, Any]] | pd.DataFrame", by: Sequence[str]
) -> "pd.DataFrame":
    """One line per group, in order of appearance: `n`, `errors`, `steps`, and counts of MEASURES.

    Of every measure m, `m` says how often it holds of `m_n` episodes. A measure that is undefined
    in an episode (a selection has no CMR) leaves it out of `m_n`; an error counts as never holding.
    """
    import pandas as pd

    names = list(by)
    table = _as_table(episodes)
    if table.empty:
        columns = [*names, "n", "errors", "steps"]
        for measure in MEASURES:
            columns += [measure, f"{measure}_n"]
        return pd.DataFrame(columns=columns)
    flat = table[names].assign(n=1, errors=table["outcome"].eq("error").astype(int))
    flat["steps"] = table["steps"].astype(int)
    for measure in MEASURES:
        flat[measure] = holds(table, measure).astype(int)
        flat[f"{measure}_n"] = table[measure].notna().astype(int)
    return flat.groupby(names, sort=False, dropna=False).sum().reset_index()


def holds(episodes: "pd.DataFrame", measure: str) -> "pd.Series":
    """In which episodes a measure holds: it is known and true, and the episode is no error."""
    return episodes[measure].eq(True) & episodes["outcome"].ne("error")


def step_times(episodes: "Iterable[Mapping[str, Any]] | pd.DataFrame") -> dict[str, float]:
    """Mean wall milliseconds of one control step by part: summed seconds over summed steps."""
    table = _as_table(episodes)
    if table.empty:
        return {}
    steps = max(int(table["steps"].sum()), 1)
    times_ms = {}
    for column in map(str, table.columns):
        if column.startswith("seconds_") and table[column].notna().any():
            seconds = float(table[column].astype(float).sum())
            times_ms[column.removeprefix("seconds_")] = 1e3 * seconds / steps
    return times_ms


def _whole_percent(fraction: float) -> str:
    """A fraction as whole percent; only 0 is printed as 0 and only 1 as 100."""
    whole = f"{100 * fraction:.0f}"
    if whole == "100" and fraction < 1 - 1e-9:
        return f"{100 * fraction:.1f}" if fraction < 0.9995 else ">99.9"
    if whole == "0" and fraction > 1e-9:
        return f"{100 * fraction:.1f}" if fraction >= 0.0005 else "<0.1"
    return whole


def _rate_of(line: Mapping[Any, Any], measure: str) -> Rate:
    """How often a measure holds, from a line of `count`."""
    return rate(int(line[measure]), int(line[f"{measure}_n"]))


def _as_table(episodes: "Iterable[Mapping[str, Any]] | pd.DataFrame") -> "pd.DataFrame":
    import pandas as pd

    if isinstance(episodes, pd.DataFrame):
        return episodes
    return pd.DataFrame(list(episodes))
