"""SR, CMR and wrong-object rate with 95 % intervals, over a fixed denominator (P 5.1, SPEC section 6)."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from vap_core.values import value


@value
class Rate:
    """k successes of n with its 95 % Wilson interval; n may be 0, then everything but n is nan."""

    k: int
    n: int
    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{100 * self.value:.0f} % [{100 * self.low:.0f}, {100 * self.high:.0f}]" if self.n else "-"

    def apart_from(self, other: "Rate") -> bool:
        """Whether the two intervals do not overlap."""
        return self.low > other.high or other.low > self.high


def rate(k: int, n: int) -> Rate:
    """The Wilson score interval of k out of n, by statsmodels."""
    from statsmodels.stats.proportion import proportion_confint

    if n == 0:
        return Rate(0, 0, float("nan"), float("nan"), float("nan"))
    low, high = proportion_confint(k, n, alpha=0.05, method="wilson")
    return Rate(k, n, k / n, float(low), float(high))


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


def score(episodes: Iterable[Mapping[str, Any]]) -> list[Score]:
    """Group flat episode rows (`Episode.summary`) by suite, task, split, method and policy, in order of appearance."""
    groups: dict[tuple[str, str, str, str, str], list[Mapping[str, Any]]] = {}
    for row in episodes:
        groups.setdefault((row["suite"], row["task"], row["split"], row["method"], row["policy"]), []).append(row)
    return [_score(key, rows) for key, rows in groups.items()]


def _score(key: tuple[str, str, str, str, str], rows: list[Mapping[str, Any]]) -> Score:
    def share(column: str) -> Rate:
        defined = [row for row in rows if isinstance(row[column], bool | np.bool_)]  # a selection has no CMR
        return rate(sum(bool(row[column]) and row["outcome"] != "error" for row in defined), len(defined))

    return Score(
        *key,
        n=len(rows),
        errors=sum(row["outcome"] == "error" for row in rows),
        sr=share("success"),
        cmr=share("cmr"),
        wrong_object=share("wrong_object"),
        first_object_correct=share("first_object_correct"),
        steps=sum(int(row["steps"]) for row in rows),
    )


def step_times(episodes: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Mean wall milliseconds of one control step by part, summed seconds over summed steps."""
    rows = list(episodes)
    steps = max(sum(int(r["steps"]) for r in rows), 1)
    parts = dict.fromkeys(key for r in rows for key in r if key.startswith("seconds_"))
    return {part.removeprefix("seconds_"): 1e3 * sum(float(r.get(part) or 0.0) for r in rows) / steps for part in parts}
