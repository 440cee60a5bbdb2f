"""Comparisons of methods on the same episodes: exact tests, cluster bootstrap, Holm's correction.

A pair is one episode (PAIR_KEY) under two methods; an error counts as no success. The independent
unit is the starting layout (`layouts`).
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from vap_core.base.tables import signed_interval
from vap_core.base.types import value
from vap_core.evaluation.layouts import layout_names
from vap_core.evaluation.metrics import Rate, holds, rate

if TYPE_CHECKING:
    import pandas as pd

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
