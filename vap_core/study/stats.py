"""Rates, means and comparisons with 95 % intervals (P 5.1, SPEC section 6).

A pair is one episode (PAIR_KEY) under two methods; an error counts as no success. The independent
unit is the starting layout: one of a list returns under other seeds and, in simpler-fractal, under
every variant. `share` takes rows for independent; `share_by`, `mean_by`, `summary` take clusters.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import cache
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float64

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
PAIR_KEY = ["suite", "task", "split", "variant", "episode", "seed", "policy"]
"""The columns that both halves of a pair share."""
EPISODE = ["suite", "task", "episode"]
"""The columns that name an episode of a list."""
ALL_TASKS = "all tasks"
RESAMPLES, DRAWS = 4999, 1000
SEED = 5
NAN = float("nan")
Values = Float64[np.ndarray, " n"]


@value
class Estimate:
    """A share or a mean over n cases with its 95 % interval; nan where it is not defined."""

    value: float
    low: float
    high: float
    n: int

    @property
    def k(self) -> int:
        """Of a share, how many of n."""
        return round(self.value * self.n) if self.n else 0

    def __str__(self) -> str:
        """A share in whole percent: "80 % [58, 92]"; only 0 is printed as 0, only 1 as 100."""
        if self.n == 0:
            return "-"
        middle, low, high = map(_whole_percent, (self.value, self.low, self.high))
        return f"{middle} % [{low}, {high}]"

    def text(self, scale: float = 100.0, digits: int = 1) -> str:
        """Value, interval and n: "97.2 [94.0, 98.7] 180"."""
        if not self.n:
            return "-"
        middle, low, high = (
            "?" if number != number else f"{scale * number:.{digits}f}"
            for number in (self.value, self.low, self.high)
        )
        return f"{middle} [{low}, {high}] {self.n}"

    def share_text(self) -> str:
        """A share as a sentence has it: "97 % [94, 99] of 180"."""
        return self.text(digits=0).replace(" [", " % [").replace("] ", "] of ")


NONE = Estimate(NAN, NAN, NAN, 0)


def _whole_percent(fraction: float) -> str:
    whole = f"{100 * fraction:.0f}"
    if whole == "100" and fraction < 1 - 1e-9:
        return f"{100 * fraction:.1f}" if fraction < 0.9995 else ">99.9"
    if whole == "0" and fraction > 1e-9:
        return f"{100 * fraction:.1f}" if fraction >= 0.0005 else "<0.1"
    return whole


def intervals(k: np.ndarray, n: np.ndarray) -> tuple[Values, Values]:
    """Wilson's 95 % intervals of k out of n, nan where n is 0."""
    from statsmodels.stats.proportion import proportion_confint

    low, high = np.full((2, len(n)), np.nan)
    some = n > 0
    if some.any():
        low[some], high[some] = proportion_confint(k[some], n[some], alpha=0.05, method="wilson")
    return low, high


def rate(k: int, n: int) -> Estimate:
    """k out of n with Wilson's interval."""
    if n == 0:
        return NONE
    (low,), (high,) = intervals(np.array([k]), np.array([n]))
    return Estimate(k / n, float(low), float(high), n)


def rates(k: Iterable[Any], n: Iterable[Any]) -> list[Estimate]:
    """`rate` of each pair of counts."""
    return [rate(int(hits), int(total)) for hits, total in zip(k, n, strict=True)]


def share(hits: Iterable[Any]) -> Estimate:
    """The share of the known hits that hold, with Wilson's interval; None and nan are unknown."""
    known = [bool(hit) for hit in hits if hit is not None and hit == hit]
    return rate(sum(known), len(known))


def clustered_share(hits: Values, clusters: Iterable[object]) -> Estimate:
    """The mean of hits (0 to 1) and its 95 % interval when whole clusters are independent.

    Wilson's interval for n / d cases, where the design effect d is the mean's cluster-robust
    variance over the variance that n independent cases would have. n / d is at least the number of
    clusters, which it also is where all hits are alike, and at most n.
    """
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
        worth = float(np.clip(n * independent / clustered, count, n)) if clustered > 0 else float(n)
    (low,), (high,) = intervals(np.array([share * worth]), np.array([worth]))
    return Estimate(share, float(low), float(high), n)


def share_by(table: "pd.DataFrame", column: str, units: Sequence[str]) -> Estimate:
    """The share of a column's known values that hold; rows alike in the columns `units` are one.

    The interval is `clustered_share`'s: rows that repeat others of their unit do not narrow it.
    """
    known = table.dropna(subset=[column])
    names = known[[*units]].itertuples(index=False, name=None)
    return clustered_share(known[column].to_numpy(float), names)


def mean_by(table: "pd.DataFrame", column: str, units: Sequence[str] = EPISODE) -> Estimate:
    """The mean of a column over its known values; the interval resamples whole units."""
    known = table.dropna(subset=[column])
    if not len(known):
        return NONE
    number = known.groupby([*units], sort=True).ngroup().to_numpy()
    values = known[column].to_numpy(float)
    total, count = np.bincount(number, values), np.bincount(number).astype(float)
    low, high = _percentiles(len(total), lambda times: times @ total / (times @ count))
    return Estimate(float(values.mean()), low, high, len(known))


def summary(
    rows: "pd.DataFrame",
    by: Sequence[str] = (),
    *,
    share: Sequence[str] = (),
    mean: Sequence[str] = (),
    cluster: Sequence[str] = (),
) -> "pd.DataFrame":
    """One line per group, in order of appearance: its rows `n`, and an `Estimate` per measure.

    A measure counts the rows in which it is known. Without `cluster` rows are independent: shares
    have Wilson's interval; with it, `share_by`'s. Means resample clusters, else episodes.
    """
    import pandas as pd

    groups = rows.groupby([*by], sort=False, observed=True) if by else [((), rows)]
    lines = []
    for key, part in groups:
        line = {**dict(zip(by, key, strict=True)), "n": len(part)}
        for name in share:
            line[name] = share_by(part, name, cluster) if cluster else _share(part[name])
        for name in mean:
            line[name] = mean_by(part, name, cluster or EPISODE)
        lines.append(line)
    return pd.DataFrame(lines, columns=[*by, "n", *share, *mean])


_share = share


def tidy(table: "pd.DataFrame", measures: Sequence[str]) -> "pd.DataFrame":
    """A table whose columns `measures` hold `Estimate`s as one line each: `measure`, n, value, low,
    high, as charts read them.
    """
    import pandas as pd

    kept = [column for column in table.columns if column not in (*measures, "n")]
    lines = []
    for line in table.to_dict("records"):
        for measure in measures:
            about = {column: line[column] for column in kept}
            numbers = {"n": line[measure].n, **asdict(line[measure])}
            lines.append({**about, "measure": measure, **numbers})
    return pd.DataFrame(lines)


def holds(episodes: "pd.DataFrame", measure: str) -> "pd.Series":
    """In which episodes a measure holds: it is known and true, and the episode is no error."""
    return episodes[measure].eq(True) & episodes["outcome"].ne("error")


def score(
    episodes: "Iterable[Mapping[str, Any]] | pd.DataFrame", by: Sequence[str] = SCORE_KEY
) -> "pd.DataFrame":
    """One line per group of episodes, in order of appearance: n, errors, steps, and per rate of
    RATES its value (`sr`), `sr_k` of `sr_n`, and Wilson's `sr_low` and `sr_high`.

    A measure that is undefined in an episode (a selection has no CMR) leaves it out of its n; an
    error counts as never holding.
    """
    import pandas as pd

    names = list(by)
    table = _as_table(episodes)
    if table.empty:
        table = pd.DataFrame(columns=[*names, "outcome", "steps", *MEASURES])
    flat = table[names].assign(n=1, errors=table["outcome"].eq("error").astype(int))
    flat["steps"] = table["steps"].astype(int)
    for name, measure in zip(RATES, MEASURES, strict=True):
        flat[f"{name}_k"] = holds(table, measure).astype(int)
        flat[f"{name}_n"] = table[measure].notna().astype(int)
    lines = flat.groupby(names, sort=False, dropna=False).sum().reset_index()
    for name in RATES:
        add_rate(lines, name)
    return lines


def add_rate(lines: "pd.DataFrame", name: str) -> None:
    """Add the rate NAME with Wilson's interval to lines with NAME_k and NAME_n."""
    k, n = (lines[f"{name}_{part}"].to_numpy(int) for part in "kn")
    lines[name] = np.divide(k, n, out=np.full(len(k), np.nan), where=n > 0)
    lines[f"{name}_low"], lines[f"{name}_high"] = intervals(k, n)


def rate_of(line: Any, name: str = "sr") -> Estimate:
    """The rate NAME of a line of `score`."""
    return rate(int(line[f"{name}_k"]), int(line[f"{name}_n"]))


def step_times(episodes: "Iterable[Mapping[str, Any]] | pd.DataFrame") -> dict[str, float]:
    """Mean wall milliseconds of one control step by part: summed seconds over summed steps."""
    table = _as_table(episodes)
    if table.empty:
        return {}
    steps = max(int(table["steps"].sum()), 1)
    return {
        name.removeprefix("seconds_"): 1e3 * float(table[name].astype(float).sum()) / steps
        for name in [name for name in map(str, table.columns) if name.startswith("seconds_")]
        if table[name].notna().any()
    }


def _as_table(episodes: "Iterable[Mapping[str, Any]] | pd.DataFrame") -> "pd.DataFrame":
    import pandas as pd

    return episodes if isinstance(episodes, pd.DataFrame) else pd.DataFrame(list(episodes))


def layout_names(episodes: "pd.DataFrame") -> "pd.Series":
    """The name of every episode's starting layout, which begins with its suite and task.

    Needs the columns suite, task, episode and seed. Raises: BadSuite for a damaged list.
    """
    import pandas as pd

    lines: list[tuple[str, str, int, str]] = []
    for suite in dict.fromkeys(episodes["suite"]):
        if suites.has_list(suite):
            lines += _listed_layouts(suite)
    listed = pd.DataFrame(lines, columns=[*EPISODE, "layout"])
    layout = episodes[EPISODE].merge(listed, on=EPISODE, how="left")["layout"]
    layout = layout.set_axis(episodes.index)
    # A warm-up suite has no list: its layouts are drawn from the seed.
    drawn = "episode " + episodes["episode"].astype(str) + " seed " + episodes["seed"].astype(str)
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
    rows = suites.benchmark(suite)
    return tuple((row.suite, row.task, row.episode, layout_name(row)) for row in rows)


def with_layouts(episodes: "pd.DataFrame") -> "pd.DataFrame":
    """The episodes with the column `layout`, which is added where it is absent."""
    return episodes if "layout" in episodes else episodes.assign(layout=layout_names(episodes))


def compare(
    episodes: "pd.DataFrame", methods: Sequence[str] = (), *, by_task: bool = True
) -> "pd.DataFrame":
    """Success of every pair of methods on the episodes that both ran, a line each.

    Per task and track, unless `by_task` is false, and over all tasks of a track where there are
    several. `methods` gives their order (default: of appearance); the later (`other`) is compared
    against the earlier (`one`). `difference` is SR of `other` minus SR of `one`; `low` and `high`
    are its 95 % cluster bootstrap. `p_mcnemar` is exact and takes every pair for independent. `p`
    takes only layouts for independent (the same number where no layout returns). `p_holm` is `p`
    corrected for the suite's comparisons with one policy of its kind (single tasks, or all tasks
    together), so that it does not depend on what else a table holds.

    Raises: BadSuite, as `layout_names`.
    """
    import pandas as pd

    order = list(methods or dict.fromkeys(episodes["method"]))
    table = with_layouts(episodes)[[*PAIR_KEY, "method", "layout"]]
    table = table.assign(won=holds(episodes, "success").astype(int))
    lines = []
    for (suite, split, policy), track in table.groupby(["suite", "split", "policy"], sort=False):
        parts = [(task, track[track["task"] == task]) for task in dict.fromkeys(track["task"])]
        if len(parts) > 1:
            parts.append((ALL_TASKS, track))
        for task, part in parts if by_task else parts[-1:]:
            wide = part.pivot(index=[*PAIR_KEY, "layout"], columns="method", values="won")
            for one, other in combinations([name for name in order if name in wide], 2):
                pairs = wide[[one, other]].dropna()
                if len(pairs):
                    names = dict(suite=suite, task=task, split=split, policy=policy)
                    found = _compare_pairs(pairs[one].astype(int), pairs[other].astype(int))
                    lines.append({**names, "one": one, "other": other, **found})
    found = pd.DataFrame(lines, columns=COMPARED)
    whole = found["task"].eq(ALL_TASKS)
    for index in found.groupby(["suite", "policy", whole], sort=False).groups.values():
        found.loc[index, "p_holm"] = holm(found.loc[index, "p"])
    return found


COMPARED = (
    *("suite", "task", "split", "policy", "one", "other", "pairs", "layouts", "both", "only_one"),
    *("only_other", "neither", "difference", "low", "high", "p_mcnemar", "p", "p_holm"),
)
"""The columns of `compare`."""


def _compare_pairs(one: "pd.Series[int]", other: "pd.Series[int]") -> dict[str, Any]:
    neither, only_other, only_one, both = np.bincount(2 * one + other, minlength=4).tolist()
    clusters = (other - one).groupby(level="layout", sort=True).agg(["sum", "size"])
    gain, n = clusters["sum"].to_numpy(float), clusters["size"].to_numpy(float)
    low, high = bootstrap_interval(gain, n)
    p = p_mcnemar = mcnemar(only_one, only_other)
    if len(gain) < len(one):
        p = sign_flip(gain)
    return {
        **dict(pairs=len(one), layouts=len(gain)),
        **dict(both=both, only_one=only_one, only_other=only_other, neither=neither),
        **dict(difference=(only_other - only_one) / len(one), low=low, high=high),
        **dict(p_mcnemar=p_mcnemar, p=p, p_holm=p),
    }


def points_text(found: Any, digits: int = 0) -> str:
    """A difference of success in points, with its interval: "+3 [-1, +7]"."""
    return signed_interval(100 * found.difference, 100 * found.low, 100 * found.high, digits)


def mcnemar(only_one: int, only_other: int) -> float:
    """The exact two-sided p of McNemar's test from the discordant pairs; 1 where there are none."""
    from scipy.stats import binomtest

    n = only_one + only_other
    return float(binomtest(only_one, n).pvalue) if n else 1.0


def holm(p: "Sequence[float] | pd.Series[float]") -> list[float]:
    """Holm's step-down correction of a family of p values."""
    values = np.array(p, float)
    order = np.argsort(values)
    stepped = values[order] * np.arange(len(values), 0, -1)
    corrected = np.empty(len(values))
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(stepped))
    return corrected.tolist()


def ratio(slow: Sequence[float], fast: Sequence[float]) -> tuple[float, float, float]:
    """Geometric mean of the ratios within each repeat, and its 95 % interval (Student's, of the
    logarithms)."""
    found = student(np.log(np.array(slow) / np.array(fast)))
    low, high = np.exp([found.low, found.high]).tolist()
    return float(np.exp(found.value)), low, high


def student(values: Sequence[float] | np.ndarray) -> Estimate:
    """A mean with Student's 95 % interval; a single value has none."""
    from scipy import stats

    n = len(values)
    middle = float(np.mean(values))
    if n < 2:
        return Estimate(middle, NAN, NAN, n)
    half = float(stats.t.ppf(0.975, n - 1) * np.std(values, ddof=1) / np.sqrt(n))
    return Estimate(middle, middle - half, middle + half, n)


def rate_over_layouts(episodes: "pd.DataFrame", measure: str = "success") -> Estimate:
    """How often a measure holds; its interval is over layouts where one returns, else Wilson's.

    An error counts as an episode in which it does not hold.
    """
    clusters = layout_clusters(episodes, measure)
    found = rate(int(clusters["won"].sum()), len(episodes))
    low, high = layout_interval(clusters["won"].to_numpy(), clusters["n"].to_numpy())
    return found if np.isnan(low) else Estimate(found.value, low, high, found.n)


def layout_clusters(
    episodes: "pd.DataFrame", measure: str = "success", by: Sequence[str] = ()
) -> "pd.DataFrame":
    """One row per layout of each group `by`: its episodes `n`, and the `won`, in which a measure
    holds."""
    table = with_layouts(episodes)[[*by, "layout"]].assign(n=1.0)
    table["won"] = holds(episodes, measure).astype(float)
    return table.groupby([*by, "layout"], sort=True)[["won", "n"]].sum()


def layout_interval(won: Values, n: Values) -> tuple[float, float]:
    """95 % interval of a rate over layouts, of which each has `won` of `n` episodes.

    nan where no layout returns: then every episode is one by itself.
    """
    if len(n) == 0 or n.max() <= 1:
        return NAN, NAN
    return bootstrap_interval(won, n, least=0.0)


def bootstrap_interval(gain: Values, n: Values, least: float = -1.0) -> tuple[float, float]:
    """95 % interval of sum(gain) / sum(n) when whole clusters are resampled (BCa).

    `gain` sums the gains of a cluster's `n` episodes: from `least` (-1 for a difference, 0 for a
    rate) to 1 each. Where all clusters are alike, resampling would give an interval of no width;
    then the interval allows for clusters of another kind, `least` or 1, that c draws may have
    missed: as large a share of them as Clopper and Pearson allow for 0 of c.

    Where few clusters differ it is too narrow: under no difference, with 40 to 250 clusters of one
    pair, it excludes 0 in 9 to 10 % of draws where some four differ; where one cluster alone
    differs, it can be narrower than where none does. Then read the exact p (`compare`).
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


def resampled_mean(sums: "pd.DataFrame", least: float = -1.0) -> Estimate:
    """The mean over clusters with a `sum` of `size` cases each, by `bootstrap_interval`."""
    gain, n = sums["sum"].to_numpy(float), sums["size"].to_numpy(float)
    low, high = bootstrap_interval(gain, n, least)
    return Estimate(float(gain.sum() / n.sum()), low, high, int(n.sum()))


def sign_flip(gain: Values) -> float:
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


def precision(detections: "pd.DataFrame", wanted: "pd.DataFrame") -> Estimate:
    """AP50: the mean over tasks, each with its own phrase, of their average precision.

    `wanted` has one row per object to find, and n counts them; bootstrapped by episode.
    """
    import pandas as pd

    if not len(wanted):
        return NONE
    both = pd.concat([wanted[EPISODE], detections.reindex(columns=EPISODE)], ignore_index=True)
    number = both.groupby(EPISODE, sort=False).ngroup().to_numpy()
    of_object, of_detection = number[: len(wanted)], number[len(wanted) :]
    tasks = []
    for (suite, task), rows in wanted.reset_index().groupby(["suite", "task"], sort=False):
        found = ((detections.suite == suite) & (detections.task == task)).to_numpy()
        score, hit = (detections[name].to_numpy()[found] for name in ("score", "hit"))
        objects = of_object[rows.index]
        tasks.append((score.astype(float), hit.astype(bool), of_detection[found], objects))

    def mean_precision(times: np.ndarray) -> float:
        areas = [
            average_precision(score, hit, float(times[objects].sum()), times[detected])
            for score, hit, detected, objects in tasks
        ]
        known = [area for area in areas if not np.isnan(area)]
        return float(np.mean(known)) if known else NAN

    n = int(number.max()) + 1
    low, high = _percentiles(n, lambda draws: np.array([mean_precision(times) for times in draws]))
    return Estimate(mean_precision(np.ones(n)), low, high, len(wanted))


def average_precision(
    score: Values,
    hit: Bool[np.ndarray, " n"],
    wanted: float,
    times: Values | None = None,
) -> float:
    """Area under the interpolated precision-recall curve of detections.

    `wanted` objects should have been found; nan when there are none. `times` counts every detection
    so often (None: once).
    """
    if wanted <= 0:
        return NAN
    order = np.argsort(-score, kind="stable")
    weight = np.ones(len(score)) if times is None else times[order]
    right = weight * hit[order]
    precisions = np.cumsum(right) / np.maximum(np.cumsum(weight), 1e-9)
    return float((np.maximum.accumulate(precisions[::-1])[::-1] * right).sum() / wanted)


def _percentiles(n: int, statistic: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float]:
    """The 2.5th and 97.5th percentile of a statistic of how often each of n clusters is drawn."""
    if n < 2:
        return NAN, NAN
    counts = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), DRAWS)
    low, high = np.nanpercentile(statistic(counts.astype(float)), [2.5, 97.5])
    return float(low), float(high)


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

    nan where McNemar's exact test on `pairs` episodes detects none. Two unrelated methods of 50 %
    success have half of the pairs `discordant`; between methods that mostly succeed on the same
    episodes smaller differences are detected.
    """
    from scipy.optimize import brentq

    def excess(effect: float) -> float:
        return power(pairs, effect, discordant=discordant) - POWER

    if excess(discordant) <= 0:
        return NAN
    return float(brentq(excess, 0.0, discordant, xtol=1e-4))


def detectable_effect_text(rows: Sequence[EpisodeRow]) -> str:
    """One line to print before a run: what a comparison of two methods on `rows` can detect."""
    # A benchmark's layouts return under every seed; those of a warm-up suite do not.
    layouts = {
        (row.suite, row.task, layout_name(row), row.seed if row.suite in suites.WARM_UPS else 0)
        for row in rows
    }
    pairs, units = len(rows), len(layouts)
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


THRESHOLDS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Least margins to act on, in shares of the votes: one vote of five apart."""
ACTS = ("acts", "SR when it acts", "acts without the target", "and touches something")


def abstentions(episodes: "pd.DataFrame") -> "pd.DataFrame":
    """Every method that votes, by policy and threshold on its margin, in every suite that was run
    with and without targets: the shares ACTS, all of the episodes but the second, which is of those
    in which it acts. An episode that ended before the vote has no margin: it does not act.
    """
    import pandas as pd

    key = ["suite", "method", "policy"]
    lines: list[dict[str, Any]] = []
    if {"margin", "touched"} <= set(episodes.columns):
        groups = {
            name: part
            for name, part in episodes.groupby(key, sort=False)
            if part["margin"].notna().any()
        }
        for (suite, method, policy), present in groups.items():
            absent = groups.get((f"{suite}{ABSENT}", method, policy))
            if absent is None:
                continue
            for threshold in THRESHOLDS:
                acting, without = (each[each["margin"] >= threshold] for each in (present, absent))
                line = dict(suite=suite, method=method, policy=policy, threshold=threshold)
                counts = (
                    (len(acting), len(present)),
                    (int(acting["success"].eq(True).sum()), len(acting)),
                    (len(without), len(absent)),
                    (int(without["touched"].eq(True).sum()), len(absent)),
                )
                rates = {name: rate(*count) for name, count in zip(ACTS, counts, strict=True)}
                lines.append({**line, **rates})
    return pd.DataFrame(lines, columns=[*key, "threshold", *ACTS])
