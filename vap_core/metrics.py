"""SR, CMR and wrong-object rate with 95 % intervals, over a fixed denominator (P 5.1, SPEC section 6)."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64, Int64

from vap_core.values import value

if TYPE_CHECKING:
    import pandas as pd

MEASURES = ("success", "cmr", "wrong_object", "first_object_correct")
TRACK = ("suite", "task", "split", "method", "policy")
"""What one line of a results table shares."""
Counts = Int64[np.ndarray, " g"]
Bounds = Float64[np.ndarray, " g"]


@value
class Rate:
    """k successes of n with its 95 % interval, Wilson's unless said otherwise; n may be 0, then everything but n is nan."""

    k: int
    n: int
    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{100 * self.value:.0f} % [{100 * self.low:.0f}, {100 * self.high:.0f}]" if self.n else "-"


def intervals(k: Counts, n: Counts, *, conservative: bool = False) -> tuple[Bounds, Bounds]:
    """95 % intervals of k out of n, nan where n is 0: Wilson's score intervals, or Clopper and Pearson's, which never cover less."""
    from statsmodels.stats.proportion import proportion_confint

    low, high = np.full(len(n), np.nan), np.full(len(n), np.nan)
    some = n > 0
    if some.any():
        low[some], high[some] = proportion_confint(k[some], n[some], alpha=0.05, method="beta" if conservative else "wilson")
    return low, high


def rate(k: int, n: int, *, conservative: bool = False) -> Rate:
    """k out of n with its interval (see `intervals`)."""
    if n == 0:
        return Rate(0, 0, float("nan"), float("nan"), float("nan"))
    low, high = intervals(np.array([k]), np.array([n]), conservative=conservative)
    return Rate(k, n, k / n, float(low[0]), float(high[0]))


@value
class Score:
    """One line of a results table. Errors stay in the denominator and count as neither success nor movement."""

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
        rates = {name: getattr(self, name) for name in ("sr", "cmr", "wrong_object", "first_object_correct")}
        return {
            "suite": self.suite, "task": self.task, "split": self.split, "method": self.method, "policy": self.policy,
            "n": self.n, "errors": self.errors,
            **{name: r.value if r.n else None for name, r in rates.items()},
            "intervals": {name: [r.low, r.high] if r.n else None for name, r in rates.items()},
        }  # fmt: skip


def score(episodes: "Iterable[Mapping[str, Any]] | pd.DataFrame") -> list[Score]:
    """Group flat episode rows (`Episode.summary`) by suite, task, split, method and policy, in order of appearance."""
    return [
        Score(
            suite=str(line["suite"]),
            task=str(line["task"]),
            split=str(line["split"]),
            method=str(line["method"]),
            policy=str(line["policy"]),
            n=int(line["n"]),
            errors=int(line["errors"]),
            sr=rate(int(line["success"]), int(line["success_n"])),
            cmr=rate(int(line["cmr"]), int(line["cmr_n"])),
            wrong_object=rate(int(line["wrong_object"]), int(line["wrong_object_n"])),
            first_object_correct=rate(int(line["first_object_correct"]), int(line["first_object_correct_n"])),
            steps=int(line["steps"]),
        )
        for line in count(episodes, TRACK).to_dict("records")
    ]


def count(episodes: "Iterable[Mapping[str, Any]] | pd.DataFrame", by: Iterable[str]) -> "pd.DataFrame":
    """One line per group in order of appearance: `n`, `errors`, `steps`, and of every measure m how often it holds, `m`, of `m_n` episodes.

    A measure that is undefined in an episode (a selection has no CMR) leaves it out of `m_n`; an error counts as never holding.
    """
    import pandas as pd

    table = episodes if isinstance(episodes, pd.DataFrame) else pd.DataFrame(list(episodes))
    names = list(by)
    if table.empty:
        return pd.DataFrame(columns=[*names, "n", "errors", "steps", *(column for m in MEASURES for column in (m, f"{m}_n"))])
    error = table["outcome"].eq("error")
    flat = table[names].assign(n=1, errors=error.astype(int), steps=table["steps"].astype(int))
    for measure in MEASURES:
        flat[measure] = (table[measure].eq(True) & ~error).astype(int)
        flat[f"{measure}_n"] = table[measure].notna().astype(int)
    return flat.groupby(names, sort=False, dropna=False).sum().reset_index()


def step_times(episodes: "Iterable[Mapping[str, Any]] | pd.DataFrame") -> dict[str, float]:
    """Mean wall milliseconds of one control step by part, summed seconds over summed steps."""
    import pandas as pd

    table = episodes if isinstance(episodes, pd.DataFrame) else pd.DataFrame(list(episodes))
    parts = [str(name) for name in table.columns if str(name).startswith("seconds_")]
    steps = max(int(table["steps"].sum()), 1) if len(table) else 1
    return {part.removeprefix("seconds_"): 1e3 * float(table[part].astype(float).sum()) / steps for part in parts if table[part].notna().any()}
