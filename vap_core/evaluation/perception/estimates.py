"""Shares, means and average precisions with their 95 % intervals.

Views of one episode show the same objects, so means and average precisions are bootstrapped by episode (percentiles, seeded); shares
carry Wilson's interval over views, objects or tracks.
"""

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float64

from vap_core.base.types import value
from vap_core.evaluation.metrics import rate

if TYPE_CHECKING:
    import pandas as pd

EPISODE = ["suite", "task", "episode"]
RESAMPLES = 1000


@value
class Estimate:
    """A figure over n cases with its 95 % interval; with n = 0 it is nan, and the interval of a single episode's mean is nan."""

    value: float
    low: float
    high: float
    n: int

    def told(self, scale: float = 100.0, digits: int = 1) -> str:
        """ "97.2 [94.0, 98.7] 180": value, interval, n."""
        if not self.n:
            return "-"
        middle, low, high = (
            "?" if np.isnan(x) else f"{scale * x:.{digits}f}"
            for x in (self.value, self.low, self.high)
        )
        return f"{middle} [{low}, {high}] {self.n}"


NONE = Estimate(float("nan"), float("nan"), float("nan"), 0)


def share(hits: Iterable[Any]) -> Estimate:
    """Of those that are known, how many hold, with Wilson's interval."""
    known = [bool(hit) for hit in hits if hit is not None and hit == hit]
    found = rate(sum(known), len(known))
    return Estimate(found.value, found.low, found.high, found.n)


def mean(table: "pd.DataFrame", column: str) -> Estimate:
    """The mean of a column over its known values, bootstrapped by episode."""
    known = table.dropna(subset=[column])
    if not len(known):
        return NONE
    per_episode = (
        known.assign(_value=known[column].astype(float))
        .groupby(EPISODE)
        ._value.agg(["sum", "count"])
    )
    total, count = per_episode["sum"].to_numpy(), per_episode["count"].to_numpy().astype(np.float64)
    low, high = _percentiles(len(per_episode), lambda times: times @ total / (times @ count))
    return Estimate(float(total.sum() / count.sum()), low, high, len(known))


def precision(detections: "pd.DataFrame", wanted: "pd.DataFrame") -> Estimate:
    """AP50: the mean over tasks, each with its own phrase, of their average precision; n counts wanted objects (a line each in `wanted`)."""
    if not len(wanted):
        return NONE
    episodes = {
        key: i
        for i, key in enumerate(
            wanted[EPISODE].drop_duplicates().itertuples(index=False, name=None)
        )
    }
    extra = [
        key
        for key in detections[EPISODE].drop_duplicates().itertuples(index=False, name=None)
        if key not in episodes
    ]
    episodes |= {key: len(episodes) + i for i, key in enumerate(extra)}
    parts = []
    for task, objects in wanted.groupby(["suite", "task"], sort=False):
        found = detections[(detections.suite == task[0]) & (detections.task == task[1])]
        owner, owned = (
            np.array(
                [episodes[key] for key in part[EPISODE].itertuples(index=False, name=None)],
                np.int64,
            )
            for part in (found, objects)
        )
        parts.append((found.score.to_numpy(np.float64), found.hit.to_numpy(bool), owner, owned))

    def once(times: Float64[np.ndarray, " e"]) -> float:
        every = [
            average_precision(score, hit, float(times[owned].sum()), times[owner])
            for score, hit, owner, owned in parts
        ]
        drawn = [one for one in every if one == one]  # a resample may lack a task
        return float(np.mean(drawn)) if drawn else float("nan")

    low, high = _percentiles(len(episodes), lambda times: np.array([once(one) for one in times]))
    return Estimate(once(np.ones(len(episodes))), low, high, len(wanted))


def average_precision(
    score: Float64[np.ndarray, " n"],
    hit: Bool[np.ndarray, " n"],
    wanted: float,
    times: Float64[np.ndarray, " n"] | None = None,
) -> float:
    """Area under the interpolated precision-recall curve of detections, of which `wanted` should have been found; nan when none.

    `times` counts every detection so often.
    """
    if wanted <= 0:
        return float("nan")
    order = np.argsort(-score, kind="stable")
    weight = (np.ones(len(score)) if times is None else times)[order]
    right = weight * hit[order]
    precision = np.cumsum(right) / np.maximum(np.cumsum(weight), 1e-9)
    return float((np.maximum.accumulate(precision[::-1])[::-1] * right).sum() / wanted)


def _percentiles(n: int, statistic: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float]:
    """The 2.5th and 97.5th percentile of a statistic of how often each of n episodes is drawn."""
    if n < 2:
        return float("nan"), float("nan")
    times = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), RESAMPLES).astype(np.float64)
    drawn = statistic(times)
    low, high = np.nanpercentile(drawn, [2.5, 97.5])
    return float(low), float(high)
