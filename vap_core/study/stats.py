"""Rates, means and comparisons with 95 % intervals (P 5.1, SPEC section 6).

A pair is one episode (PAIR_KEY) under two methods; an error counts as no success. The independent
unit is the starting layout: one of a list returns under other seeds and, in simpler-fractal, under
every variant. Views of one episode show the same objects: `share` takes them for independent,
`clustered_share` and `share_by` do not, means and average precisions are bootstrapped by episode.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from vap_core.base.files import signed_interval
from vap_core.base.types import value
from vap_core.simulation import suites
from vap_core.simulation.suites import ABSENT
from vap_core.simulation.types import EpisodeRow

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


def layout_names(episodes: "pd.DataFrame") -> "pd.Series":
    """The name of every episode's starting layout, which begins with its suite and task.

    Needs the columns suite, task, episode and seed.

    Raises: BadSuite for a benchmark whose list is damaged.
    """
    import pandas as pd

    lines: list[tuple[str, str, int, str]] = []
    for suite in dict.fromkeys(episodes["suite"]):
        if suites.has_list(suite):
            lines += _listed_layouts(suite)
    keys = ["suite", "task", "episode"]
    listed = pd.DataFrame(lines, columns=[*keys, "layout"])
    layout = episodes[keys].merge(listed, on=keys, how="left")["layout"].set_axis(episodes.index)
    # A warm-up suite has no list: its layouts are drawn from the seed.
    episode = episodes["episode"].astype(str)
    seed = episodes["seed"].astype(str)
    drawn = "episode " + episode + " seed " + seed
    return episodes["suite"] + " " + episodes["task"] + " " + layout.where(layout.notna(), drawn)


def layout_name(row: EpisodeRow) -> str:
    """Where the target, its look-alikes and its goal start; other objects do not count."""
    parts = []
    for place in row.placements:
        lookalike = "-lookalike-" in place.model or place.model.startswith(f"{row.target}-")
        if lookalike or place.model in (row.target, row.goal):
            parts.append(f"{place.model} {place.x:g} {place.y:g} {place.yaw:g}")
    return "; ".join(parts)


@cache
def _listed_layouts(suite: str) -> tuple[tuple[str, str, int, str], ...]:
    """Suite, task, episode and layout of every row of a benchmark's list."""
    rows = suites.benchmark(suite)
    return tuple((row.suite, row.task, row.episode, layout_name(row)) for row in rows)


PAIR_KEY = ["suite", "task", "split", "variant", "episode", "seed", "policy"]
"""The columns that both halves of a pair share."""
ALL_TASKS = "all tasks"
RESAMPLES = 4999
SEED = 5
PerCluster = Float64[np.ndarray, " c"]


@value
class Comparison:
    """Success of `other` against `one` on the same episodes of one task (or ALL_TASKS) and track.

    `difference` is SR of `other` minus SR of `one`; `low` and `high` are its 95 % cluster
    bootstrap. `p_mcnemar` is exact and takes every pair for independent. `p` takes only layouts for
    independent (the same number where no layout returns). `p_holm` is `p` corrected for the
    suite's comparisons with one policy of its kind (single tasks, or all tasks together).
    """

    suite: str
    task: str
    split: str
    policy: str
    one: str
    other: str
    pairs: int
    layouts: int
    both: int
    only_one: int
    only_other: int
    neither: int
    difference: float
    low: float
    high: float
    p_mcnemar: float
    p: float
    p_holm: float


def compare(
    episodes: "pd.DataFrame", methods: Sequence[str] = (), *, by_task: bool = True
) -> list[Comparison]:
    """Every pair of methods on the episodes that both ran.

    Per task and track, unless `by_task` is false, and over all tasks of a track where there are
    several. `methods` gives their order (default: of appearance); the later is compared against the
    earlier. Episodes are one row each (`Episode.summary`); the column `layout` is added where it is
    absent.

    Raises: BadSuite, as `layouts.layout_names`.
    """
    order = list(methods or dict.fromkeys(episodes["method"]))
    won = holds(episodes, "success").astype(int)
    table = episodes[[*PAIR_KEY, "method"]].assign(layout=_layouts_of(episodes), won=won)
    comparisons = []
    for (suite, split, policy), track in table.groupby(["suite", "split", "policy"], sort=False):
        parts = _by_task(track)
        for task, part in parts if by_task else parts[-1:]:
            wide = part.pivot(index=[*PAIR_KEY, "layout"], columns="method", values="won")
            present = [name for name in order if name in wide]
            for one, other in combinations(present, 2):
                pairs = wide[[one, other]].dropna()
                if pairs.empty:
                    continue
                names = {
                    "suite": str(suite),
                    "task": task,
                    "split": str(split),
                    "policy": str(policy),
                    "one": one,
                    "other": other,
                }
                comparisons.append(_compare_pairs(pairs, names))
    return _holm_corrected(comparisons)


def points_text(found: Comparison, digits: int = 0) -> str:
    """A difference of success in points, with its interval: "+3 [-1, +7]"."""
    return signed_interval(100 * found.difference, 100 * found.low, 100 * found.high, digits)


def mcnemar(only_one: int, only_other: int) -> float:
    """The exact two-sided p of McNemar's test from the discordant pairs; 1 where there are none."""
    from statsmodels.stats.contingency_tables import mcnemar as test

    if only_one + only_other == 0:
        return 1.0
    return min(1.0, float(test([[0, only_one], [only_other, 0]], exact=True).pvalue))


def holm(p: Sequence[float]) -> list[float]:
    """Holm's step-down correction of a family of p values.

    statsmodels' own (`multipletests`) collects garbage at every call, which takes a tenth of a
    second in a process that has torch: more than half of the time of the ablations' tables.
    """
    values = np.array(p, float)
    order = np.argsort(values)
    stepped = values[order] * np.arange(len(values), 0, -1)
    corrected = np.empty(len(values))
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(stepped))
    return [float(value) for value in corrected]


def ratio(slow: Sequence[float], fast: Sequence[float]) -> tuple[float, float, float]:
    """Geometric mean of the ratios within each repeat, and its 95 % interval.

    The interval is Student's, of the logarithms.
    """
    from scipy import stats

    logs = np.log(np.array(slow) / np.array(fast))
    half = stats.t.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / np.sqrt(len(logs))
    return (
        float(np.exp(logs.mean())),
        float(np.exp(logs.mean() - half)),
        float(np.exp(logs.mean() + half)),
    )


def rate_over_layouts(episodes: "pd.DataFrame", measure: str = "success") -> Rate:
    """How often a measure holds; its interval is over layouts where one returns, else Wilson's.

    That of success is a report's `sr_layout_low` and `sr_layout_high`. An error counts as an
    episode in which it does not hold. The column `layout` is added where it is absent.
    """
    clusters = layout_clusters(episodes, measure)
    found = rate(int(clusters["won"].sum()), len(episodes))
    low, high = layout_interval(clusters["won"].to_numpy(), clusters["n"].to_numpy())
    return found if np.isnan(low) else replace(found, low=low, high=high)


def layout_clusters(
    episodes: "pd.DataFrame", measure: str = "success", by: Sequence[str] = ()
) -> "pd.DataFrame":
    """One row per layout of each group `by`: its episodes `n`, and the `won`, in which a measure
    holds. The column `layout` is added where it is absent.
    """
    table = episodes[list(by)].assign(layout=_layouts_of(episodes), n=1.0)
    table["won"] = holds(episodes, measure).astype(float)
    return table.groupby([*by, "layout"], sort=True)[["won", "n"]].sum()


def layout_interval(won: PerCluster, n: PerCluster) -> tuple[float, float]:
    """95 % interval of a rate over layouts, of which each has `won` of `n` episodes.

    nan where no layout returns: then every episode is one by itself.
    """
    if len(n) == 0 or n.max() <= 1:
        return float("nan"), float("nan")
    return bootstrap_interval(won, n, least=0.0)


def bootstrap_interval(gain: PerCluster, n: PerCluster, least: float = -1.0) -> tuple[float, float]:
    """95 % interval of sum(gain) / sum(n) when whole clusters are resampled (BCa).

    `gain` sums the gains of a cluster's `n` episodes: from `least` (-1 for a difference, 0 for a
    rate) to 1 each. Where all clusters are alike, resampling would give an interval of no width;
    then the interval allows for clusters of another kind, `least` or 1, that c draws may have
    missed: as large a share of them as Clopper and Pearson allow for 0 of c.

    Where few clusters differ it is too narrow: under no difference, with 40 to 250 clusters of one
    pair, it excludes 0 in 9 to 10 % of draws where some four differ. Where one cluster alone
    differs, nothing is allowed for, and the interval can be narrower than where none does: with 75
    layouts of 11 episodes each, no success gives [0, 4.8] %, one success [0, 0.7]; with 96 layouts
    of one pair each, no difference gives [-3.8, +3.8] points, one pair won and none lost
    [0, +5.2]. Then read the exact p (`Comparison.p`).
    """
    from scipy.stats import bootstrap

    means = gain / n
    if np.ptp(means) == 0:
        centre = float(means[0])
        unseen = 1 - 0.025 ** (1 / len(means))
        return centre - unseen * (centre - least), centre + unseen * (1 - centre)

    def mean_gain(gains: np.ndarray, counts: np.ndarray, axis: int = -1) -> Any:
        return gains.sum(axis=axis) / counts.sum(axis=axis)

    interval = bootstrap(
        (gain, n),
        mean_gain,
        n_resamples=RESAMPLES,
        paired=True,
        vectorized=True,
        method="BCa",
        rng=np.random.default_rng(SEED),
    ).confidence_interval
    return float(interval.low), float(interval.high)


def sign_flip(gain: PerCluster) -> float:
    """Exact two-sided p of no difference: a cluster's gain is as likely to have the other sign.

    Gains are whole numbers. It is McNemar's test where every gain is -1, 0 or 1. The chances of all
    sums come from one convolution per cluster: 2^c patterns cannot be enumerated, and sampled ones
    are too coarse for Holm's correction of hundreds of comparisons.
    """
    steps = np.abs(gain).astype(int)
    chance = np.ones(1)
    middle = int(steps.sum())
    for step in steps[steps > 0].tolist():
        longer = np.zeros(len(chance) + 2 * step)
        longer[: len(chance)] += 0.5 * chance
        longer[2 * step :] += 0.5 * chance
        chance = longer
    extreme = np.abs(np.arange(len(chance)) - middle) >= abs(round(float(gain.sum())))
    return min(1.0, float(chance[extreme].sum()))


def _layouts_of(episodes: "pd.DataFrame") -> "pd.Series":
    if "layout" in episodes:
        return episodes["layout"]
    return layout_names(episodes)


def _by_task(track: "pd.DataFrame") -> "list[tuple[str, pd.DataFrame]]":
    """The tasks of a track with their episodes; ALL_TASKS at the end where there are several."""
    parts = []
    for task in dict.fromkeys(track["task"]):
        parts.append((task, track[track["task"] == task]))
    if len(parts) > 1:
        parts.append((ALL_TASKS, track))
    return parts


def _compare_pairs(pairs: "pd.DataFrame", names: dict[str, str]) -> Comparison:
    """One comparison; `pairs` has a column of 0 and 1 for each of the two methods."""
    first = pairs[names["one"]].to_numpy(int)
    second = pairs[names["other"]].to_numpy(int)
    neither, only_other, only_one, both = np.bincount(2 * first + second, minlength=4).tolist()
    per_pair = pairs.assign(gain=second - first, n=1)
    clusters = per_pair.groupby("layout", sort=True)[["gain", "n"]].sum()
    gain = clusters["gain"].to_numpy(float)
    n = clusters["n"].to_numpy(float)
    low, high = bootstrap_interval(gain, n)
    p_mcnemar = p = mcnemar(only_one, only_other)
    if len(gain) < len(pairs):
        p = sign_flip(gain)
    return Comparison(
        **names,
        pairs=len(pairs),
        layouts=len(gain),
        both=both,
        only_one=only_one,
        only_other=only_other,
        neither=neither,
        difference=(only_other - only_one) / len(pairs),
        low=low,
        high=high,
        p_mcnemar=p_mcnemar,
        p=p,
        p_holm=p,
    )


def _holm_corrected(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """With `p_holm` corrected within the comparisons of a suite with one policy: of its single
    tasks, and apart from them of ALL_TASKS.

    So it does not depend on what else a table holds.
    """
    corrected = list(comparisons)
    families = defaultdict(list)
    for i, one in enumerate(comparisons):
        families[one.suite, one.policy, one.task == ALL_TASKS].append(i)
    for family in families.values():
        p_holm = holm([comparisons[i].p for i in family])
        for i, p in zip(family, p_holm, strict=True):
            corrected[i] = replace(comparisons[i], p_holm=p)
    return corrected


EPISODE = ["suite", "task", "episode"]
"""The columns that name an episode."""
DRAWS = 1000
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
        middle, low, high = self._numbers(scale, digits)
        return f"{middle} [{low}, {high}] {self.n}"

    def share_text(self) -> str:
        """A share as a sentence has it: "97 % [94, 99] of 180"."""
        if not self.n:
            return "-"
        middle, low, high = self._numbers(100.0, 0)
        return f"{middle} % [{low}, {high}] of {self.n}"

    def _numbers(self, scale: float, digits: int) -> tuple[str, ...]:
        numbers = (self.value, self.low, self.high)
        return tuple(_format_number(scale * number, digits) for number in numbers)


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
    counts = rng.multinomial(n, np.full(n, 1 / n), DRAWS)
    drawn = statistic(counts.astype(np.float64))
    low, high = np.nanpercentile(drawn, [2.5, 97.5])
    return float(low), float(high)


def _format_number(number: float, digits: int) -> str:
    if np.isnan(number):
        return "?"
    return f"{number:.{digits}f}"


POWER = 0.8
"""The chance with which a difference is to be detected."""


def power(pairs: int, effect: float, *, alpha: float = 0.05, discordant: float = 0.5) -> float:
    """The chance that McNemar's exact two-sided test detects a true difference of success rates.

    `effect` is the difference, `pairs` the number of episodes. `discordant` is the share of
    episodes where exactly one method succeeds, of which (1 + effect / discordant) / 2 favour the
    better one.
    """
    from scipy.stats import binom

    m = np.arange(pairs + 1)
    # The test rejects when one side has at most `reject` of the m discordant pairs.
    reject = binom.ppf(alpha / 2, m, 0.5)
    reject = np.where(binom.cdf(reject, m, 0.5) > alpha / 2, reject - 1, reject)
    better = 0.5 * (1 + effect / discordant)
    detected = binom.cdf(reject, m, better) + binom.sf(m - reject - 1, m, better)
    return float((binom.pmf(m, pairs, discordant) * np.where(reject < 0, 0.0, detected)).sum())


def minimum_detectable_effect(pairs: int, *, discordant: float = 0.5) -> float:
    """The least difference of two success rates that is detected with the power `POWER`.

    nan where McNemar's exact test on `pairs` episodes detects none. Assumes that on the share
    `discordant` of the episodes exactly one method succeeds: 0.5 is what two unrelated methods of
    50 % success give. Between methods that mostly succeed on the same episodes smaller differences
    are detected.
    """
    from scipy.optimize import brentq

    def excess(effect: float) -> float:
        return power(pairs, effect, discordant=discordant) - POWER

    if excess(discordant) <= 0:
        return float("nan")
    return float(brentq(excess, 0.0, discordant, xtol=1e-4))


def detectable_effect_text(rows: Sequence[EpisodeRow]) -> str:
    """One line to print before a run: what a comparison of two methods on `rows` can detect."""
    pairs = len(rows)
    units = _count_layouts(rows)
    effect = minimum_detectable_effect(units)
    where = f"{pairs} paired episodes"
    assumed = "half of the pairs discordant"
    if units < pairs:
        where += f" on {units} layouts"
    if np.isnan(effect):
        return (
            f"{where}: too few to detect any difference of methods "
            f"(80 % power, alpha 5 %, exact McNemar, {assumed})"
        )
    if units < pairs:
        assumed += ", counting each layout once"
    return (
        f"{where}: differences of {100 * effect:.0f} points or more are detected with 80 % power "
        f"(alpha 5 %, exact McNemar, {assumed})"
    )


def _count_layouts(rows: Sequence[EpisodeRow]) -> int:
    layouts = set()
    for row in rows:
        # A benchmark's layouts return under every seed; those of a warm-up suite do not.
        seed = row.seed if row.suite in suites.WARM_UPS else 0
        layouts.add((row.suite, row.task, layout_name(row), seed))
    return len(layouts)


THRESHOLDS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Least margins to act on, in shares of the votes: one vote of five apart."""


@dataclass(frozen=True)
class Abstention:
    """One method with one policy at one threshold, by suite.

    `acts` is the share of the episodes with a target in which it acts, `success` that of those in
    which it then succeeds; `acts_absent` the share of the episodes without one in which it acts,
    and `touches_absent` that in which it acts and touches an object.
    """

    suite: str
    method: str
    policy: str
    threshold: float
    acts: Rate
    success: Rate
    acts_absent: Rate
    touches_absent: Rate


def abstentions(episodes: "pd.DataFrame") -> list[Abstention]:
    """Every method that votes, by policy, in every suite that was run with and without targets."""
    found: list[Abstention] = []
    if "margin" not in episodes or "touched" not in episodes:
        return found
    groups = {}
    for key, of_key in episodes.groupby(["suite", "method", "policy"], sort=False):
        # An episode that ended before the vote has no margin: it does not act.
        if of_key["margin"].notna().any():
            groups[key] = of_key
    for (suite, method, policy), present in groups.items():
        absent = groups.get((f"{suite}{ABSENT}", method, policy))
        if absent is None:
            continue
        for threshold in THRESHOLDS:
            acting = present[present["margin"] >= threshold]
            without = absent[absent["margin"] >= threshold]
            touching = int(without["touched"].eq(True).sum())
            found.append(
                Abstention(
                    suite=str(suite),
                    method=str(method),
                    policy=str(policy),
                    threshold=threshold,
                    acts=rate(len(acting), len(present)),
                    success=rate(int(acting["success"].eq(True).sum()), len(acting)),
                    acts_absent=rate(len(without), len(absent)),
                    touches_absent=rate(touching, len(absent)),
                )
            )
    return found


def abstention_rows(found: list[Abstention]) -> list[list[str]]:
    """The table as text cells, header first."""
    rows = [
        [
            "suite",
            "method",
            "policy",
            "least margin",
            "acts [95 %]",
            "SR when it acts [95 %]",
            "acts without the target [95 %]",
            "and touches something [95 %]",
        ]
    ]
    for line in found:
        rates = (line.acts, line.success, line.acts_absent, line.touches_absent)
        named = [line.suite, line.method, line.policy]
        rows.append([*named, f"{line.threshold:g}", *map(str, rates)])
    return rows
