"""Shares, means and average precisions with their 95 % intervals.

Views of one episode show the same objects, so means and average precisions are bootstrapped by
episode (percentiles, seeded). `share` carries Wilson's interval over views, objects or tracks, as
if each were independent of the others: too narrow where they are of few episodes or objects.
`clustered_share` and `share_by` take those for the units.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from vap_core.base.types import value
from vap_core.evaluation.metrics import rate

if TYPE_CHECKING:
    import pandas as pd

EPISODE = ["suite", "task", "episode"]
"""The columns that name an episode."""
RESAMPLES = 1000
Weights = Float64[np.ndarray, " e"]
"""How often each episode counts."""


@value
class Estimate:
    """A value over n cases with its 95 % interval.

    With n = 0 all three are nan; the interval of a single episode's mean is nan.
    """

    value: float
    low: float
    high: float
    n: int

    def text(self, scale: float = 100.0, digits: int = 1) -> str:
        """Value, interval and n: "97.2 [94.0, 98.7] 180"."""
        if not self.n:
            return "-"
        middle = _format_number(scale * self.value, digits)
        low = _format_number(scale * self.low, digits)
        high = _format_number(scale * self.high, digits)
        return f"{middle} [{low}, {high}] {self.n}"

    def sentence(self) -> str:
        """A share within a sentence: "97 % [94, 99] of 180"."""
        return self.text(digits=0).replace(" [", " % [").replace("] ", "] of ")


NONE = Estimate(value=float("nan"), low=float("nan"), high=float("nan"), n=0)


def share(hits: Iterable[Any]) -> Estimate:
    """The share of the known hits that hold, with Wilson's interval; None and nan are unknown."""
    n_known = 0
    n_right = 0
    for hit in hits:
        if hit is not None and hit == hit:
            n_known += 1
            n_right += bool(hit)
    found = rate(n_right, n_known)
    return Estimate(value=found.value, low=found.low, high=found.high, n=found.n)


def clustered_share(hits: Float64[np.ndarray, " n"], clusters: Iterable[object]) -> Estimate:
    """The mean of hits (0 to 1) and its 95 % interval when whole clusters are independent.

    Wilson's interval for n / d cases, where the design effect d is the mean's cluster-robust
    variance over the variance that n independent cases would have. n / d is at least the number of
    clusters, which it also is where all hits are alike, and at most n.
    """
    from statsmodels.stats.proportion import proportion_confint

    n = len(hits)
    if not n:
        return NONE
    share = float(hits.mean())
    _, number = np.unique([str(name) for name in clusters], return_inverse=True)
    count = int(number.max()) + 1
    independent = share * (1 - share) / n
    worth = float(count)
    if count > 1 and independent > 0:
        sums = np.bincount(number, hits - share)
        clustered = float((sums**2).sum()) / n**2 * count / (count - 1)
        if clustered > 0:
            worth = float(np.clip(n * independent / clustered, count, n))
        else:
            worth = float(n)
    low, high = proportion_confint(share * worth, worth, alpha=0.05, method="wilson")
    return Estimate(value=share, low=float(low), high=float(high), n=n)


def share_by(table: "pd.DataFrame", column: str, units: Sequence[str]) -> Estimate:
    """The share of a column's known values that hold; rows alike in the columns `units` are one.

    The interval is `clustered_share`'s: rows that repeat others of their unit do not narrow it.
    """
    known = table.dropna(subset=[column])
    names = known[[*units]].itertuples(index=False, name=None)
    return clustered_share(known[column].to_numpy(float), names)


def mean(table: "pd.DataFrame", column: str) -> Estimate:
    """The mean of a column over its known values, bootstrapped by episode."""
    known = table.dropna(subset=[column])
    if not len(known):
        return NONE
    values = known.assign(_value=known[column].astype(float))
    per_episode = values.groupby(EPISODE)._value.agg(["sum", "count"])
    total = per_episode["sum"].to_numpy()
    count = per_episode["count"].to_numpy().astype(np.float64)

    def weighted_means(times: Float64[np.ndarray, "r e"]) -> Float64[np.ndarray, " r"]:
        return times @ total / (times @ count)

    low, high = _percentiles(len(per_episode), weighted_means)
    middle = float(total.sum() / count.sum())
    return Estimate(value=middle, low=low, high=high, n=len(known))


def precision(detections: "pd.DataFrame", wanted: "pd.DataFrame") -> Estimate:
    """AP50: the mean over tasks, each with its own phrase, of their average precision.

    `wanted` has one row per object to find, and n counts them; bootstrapped by episode.
    """
    if not len(wanted):
        return NONE
    numbers = _number_episodes(wanted, detections)
    tasks = []
    for (suite, task), objects in wanted.groupby(["suite", "task"], sort=False):
        found = detections[(detections.suite == suite) & (detections.task == task)]
        tasks.append(_TaskDetections(found, objects, numbers))

    def mean_precisions(resamples: Float64[np.ndarray, "r e"]) -> Float64[np.ndarray, " r"]:
        return np.array([_mean_precision(tasks, times) for times in resamples])

    low, high = _percentiles(len(numbers), mean_precisions)
    once = np.ones(len(numbers))
    middle = _mean_precision(tasks, once)
    return Estimate(value=middle, low=low, high=high, n=len(wanted))


def average_precision(
    score: Float64[np.ndarray, " n"],
    hit: Bool[np.ndarray, " n"],
    wanted: float,
    times: Float64[np.ndarray, " n"] | None = None,
) -> float:
    """Area under the interpolated precision-recall curve of detections.

    `wanted` objects should have been found; nan when there are none. `times` counts every detection
    so often (None: once).
    """
    if wanted <= 0:
        return float("nan")
    if times is None:
        times = np.ones(len(score))
    order = np.argsort(-score, kind="stable")
    weight = times[order]
    right = weight * hit[order]
    precisions = np.cumsum(right) / np.maximum(np.cumsum(weight), 1e-9)
    interpolated = np.maximum.accumulate(precisions[::-1])[::-1]
    return float((interpolated * right).sum() / wanted)


class _TaskDetections:
    """The detections of one task, and the episodes of its detections and of its objects.

    `found` has a row per detection, `objects` one per object to find; `numbers` are the episodes'.
    """

    def __init__(
        self,
        found: "pd.DataFrame",
        objects: "pd.DataFrame",
        numbers: dict[tuple[Any, ...], int],
    ) -> None:
        self.score = found.score.to_numpy(np.float64)
        self.hit = found.hit.to_numpy(bool)
        self.episode_of_detection = _episode_numbers(found, numbers)
        self.episode_of_object = _episode_numbers(objects, numbers)

    def average_precision(self, times: Weights) -> float:
        """Their average precision when each episode counts as often as `times` says."""
        wanted = float(times[self.episode_of_object].sum())
        return average_precision(
            score=self.score,
            hit=self.hit,
            wanted=wanted,
            times=times[self.episode_of_detection],
        )


def _mean_precision(tasks: Iterable[_TaskDetections], times: Weights) -> float:
    """The mean of the tasks' average precisions, without the tasks that a resample lacks."""
    known = []
    for task in tasks:
        area = task.average_precision(times)
        if not np.isnan(area):
            known.append(area)
    if not known:
        return float("nan")
    return float(np.mean(known))


def _number_episodes(*tables: "pd.DataFrame") -> dict[tuple[Any, ...], int]:
    """A number for each episode of the tables, in the order of their first rows."""
    numbers: dict[tuple[Any, ...], int] = {}
    for table in tables:
        for episode in _episodes(table.drop_duplicates(EPISODE)):
            numbers.setdefault(episode, len(numbers))
    return numbers


def _episode_numbers(
    table: "pd.DataFrame", numbers: dict[tuple[Any, ...], int]
) -> Int64[np.ndarray, " n"]:
    """The number of each row's episode."""
    return np.array([numbers[episode] for episode in _episodes(table)], np.int64)


def _episodes(table: "pd.DataFrame") -> Iterable[tuple[Any, ...]]:
    """The suite, task and episode of each row."""
    return table[EPISODE].itertuples(index=False, name=None)


def _percentiles(n: int, statistic: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float]:
    """The 2.5th and 97.5th percentile of a statistic of how often each of n episodes is drawn."""
    if n < 2:
        return float("nan"), float("nan")
    rng = np.random.default_rng(0)
    counts = rng.multinomial(n, np.full(n, 1 / n), RESAMPLES)
    drawn = statistic(counts.astype(np.float64))
    low, high = np.nanpercentile(drawn, [2.5, 97.5])
    return float(low), float(high)


def _format_number(number: float, digits: int) -> str:
    if np.isnan(number):
        return "?"
    return f"{number:.{digits}f}"
