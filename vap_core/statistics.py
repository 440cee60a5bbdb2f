"""Comparisons of methods on the same episodes: exact tests, cluster bootstrap, Holm's correction, and what a study can detect at all.

The pair is the episode: the same suite, task, split, variant, episode, seed and policy under two methods; an error counts as no success.
The independent unit is the starting layout: a list's layout returns under other seeds and, in simpler-fractal, under every variant.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from vap_core import suites
from vap_core.metrics import rate
from vap_core.values import EpisodeRow, value

if TYPE_CHECKING:
    import pandas as pd

EPISODE = ["suite", "task", "split", "variant", "episode", "seed", "policy"]
"""What the two halves of a pair share."""
ALL_TASKS = "all tasks"
RESAMPLES = 4999
SEED = 5
PerCluster = Float64[np.ndarray, " c"]


@value
class Comparison:
    """Success of `other` against `one` on the same episodes of one task (or ALL_TASKS) and track.

    `difference` is SR of `other` minus SR of `one`; `low` and `high` are its 95 % cluster bootstrap. `p_mcnemar` is exact and takes every pair
    for independent; `p` takes only layouts for that (the same number where no layout returns), and `p_holm` corrects it for all comparisons
    of its kind (single tasks, or all tasks together) in one table.
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


def ratio(slow: Sequence[float], fast: Sequence[float]) -> tuple[float, float, float]:
    """Geometric mean of the ratios within each repeat, and Student's 95 % interval of its logarithm."""
    from scipy import stats

    logs = np.log(np.array(slow) / np.array(fast))
    half = stats.t.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / np.sqrt(len(logs))
    return float(np.exp(logs.mean())), float(np.exp(logs.mean() - half)), float(np.exp(logs.mean() + half))


def mcnemar(only_one: int, only_other: int) -> float:
    """The exact two-sided p of McNemar's test from the discordant pairs; 1 where there are none."""
    from statsmodels.stats.contingency_tables import mcnemar as test

    return min(1.0, float(test([[0, only_one], [only_other, 0]], exact=True).pvalue)) if only_one + only_other else 1.0


def holm(p: Sequence[float]) -> list[float]:
    """Holm's step-down correction of a family of p values."""
    from statsmodels.stats.multitest import multipletests

    return [float(each) for each in multipletests(list(p), method="holm")[1]] if p else []


def bootstrap_interval(gain: PerCluster, n: PerCluster, least: float = -1.0) -> tuple[float, float]:
    """95 % interval of sum(gain) / sum(n) when whole clusters are drawn again, with replacement (BCa).

    `gain` sums what a cluster's `n` episodes gained: from `least` (-1 for a difference, 0 for a rate) to 1 each. Where all clusters are alike,
    resampling would claim certainty; then the interval allows for clusters of another kind, `least` or 1, that c draws may have missed: as large
    a share of them as Clopper and Pearson allow for 0 of c.
    """
    from scipy.stats import bootstrap

    means = gain / n
    if np.ptp(means) == 0:
        centre, unseen = float(means[0]), rate(0, len(means), conservative=True).high
        return centre - unseen * (centre - least), centre + unseen * (1 - centre)

    def ratio(gained: np.ndarray, of: np.ndarray, axis: int = -1) -> Any:
        return gained.sum(axis=axis) / of.sum(axis=axis)

    found = bootstrap(
        (gain, n), ratio, n_resamples=RESAMPLES, paired=True, vectorized=True, method="BCa", rng=np.random.default_rng(SEED)
    ).confidence_interval  # fmt: skip
    return float(found.low), float(found.high)


def sign_flip(gain: PerCluster) -> float:
    """Exact two-sided p of no difference: under it, a cluster's gain (a whole number) is as likely to have the other sign.

    McNemar's test where every gain is -1, 0 or 1. The chances of all sums come from one convolution per cluster, as 2^c patterns cannot be tried
    and drawn ones are too coarse for Holm's correction of hundreds of comparisons.
    """
    steps = np.abs(gain).astype(int)
    chance, middle = np.ones(1), int(steps.sum())
    for step in steps[steps > 0].tolist():
        longer = np.zeros(len(chance) + 2 * step)
        longer[: len(chance)] += 0.5 * chance
        longer[2 * step :] += 0.5 * chance
        chance = longer
    extreme = np.abs(np.arange(len(chance)) - middle) >= abs(round(float(gain.sum())))
    return min(1.0, float(chance[extreme].sum()))


def compare(episodes: "pd.DataFrame", methods: Sequence[str] = ()) -> list[Comparison]:
    """Every pair of methods on the episodes that both ran: per task and track, and over all tasks of a track where there are several.

    `methods` gives their order (default: of appearance); the later is compared against the earlier. Episodes are one row each
    (`Episode.summary`), with their `layout` or as `layouts` tells it.
    """
    order = list(methods or dict.fromkeys(episodes["method"]))
    layout = episodes["layout"] if "layout" in episodes else layouts(episodes)
    won = (episodes["success"].eq(True) & episodes["outcome"].ne("error")).astype(int)
    table = episodes[[*EPISODE, "method"]].assign(layout=layout, won=won)
    found = []
    for (suite, split, policy), track in table.groupby(["suite", "split", "policy"], sort=False):
        tasks = list(dict.fromkeys(track["task"]))
        for task in [*tasks, *([ALL_TASKS] if len(tasks) > 1 else [])]:
            part = track if task == ALL_TASKS else track[track["task"] == task]
            wide = part.pivot(index=[*EPISODE, "layout"], columns="method", values="won")
            for one, other in combinations([name for name in order if name in wide], 2):
                found.append(_pair(wide[[one, other]].dropna(), (str(suite), task, str(split), str(policy)), one, other))
    return _corrected([each for each in found if each.pairs])


def _pair(wide: "pd.DataFrame", about: tuple[str, str, str, str], one: str, other: str) -> Comparison:
    if wide.empty:
        nan = float("nan")
        return Comparison(*about, one, other, 0, 0, 0, 0, 0, 0, nan, nan, nan, nan, nan, nan)
    first, second = wide[one].to_numpy(int), wide[other].to_numpy(int)
    cells = np.bincount(2 * first + second, minlength=4).tolist()
    by_layout = wide.assign(gain=second - first, n=1).groupby("layout", sort=True)[["gain", "n"]].sum()
    gain, pairs = by_layout["gain"].to_numpy(float), by_layout["n"].to_numpy(float)
    low, high = bootstrap_interval(gain, pairs)
    p = mcnemar(cells[2], cells[1])
    plain = Comparison(
        *about, one, other, pairs=len(wide), layouts=len(gain), both=cells[3], only_one=cells[2], only_other=cells[1], neither=cells[0],
        difference=(cells[1] - cells[2]) / len(wide), low=low, high=high, p_mcnemar=p, p=p, p_holm=p,
    )  # fmt: skip
    return plain if len(gain) == len(wide) else replace(plain, p=sign_flip(gain))


def _corrected(found: list[Comparison]) -> list[Comparison]:
    whole = [each.task == ALL_TASKS for each in found]
    families = {kind: iter(holm([each.p for each, of in zip(found, whole, strict=True) if of is kind])) for kind in (True, False)}
    return [replace(each, p_holm=next(families[of])) for each, of in zip(found, whole, strict=True)]


def layouts(episodes: "pd.DataFrame") -> "pd.Series":
    """The name of every episode's starting layout, in which its task comes first; needs suite, task, episode and seed.

    Raises: BadSuite for a benchmark whose list is damaged.
    """
    import pandas as pd

    known = [suite for suite in dict.fromkeys(episodes["suite"]) if suite in suites.BENCHMARKS]
    listed = pd.DataFrame([line for suite in known for line in _listed(suite)], columns=["suite", "task", "episode", "layout"])
    keys = ["suite", "task", "episode"]
    layout = episodes[keys].merge(listed, on=keys, how="left")["layout"].set_axis(episodes.index)
    own = "episode " + episodes["episode"].astype(str) + " seed " + episodes["seed"].astype(str)  # a warm-up's list is drawn from its seed
    return episodes["suite"] + " " + episodes["task"] + " " + layout.where(layout.notna(), own)


@cache
def _listed(suite: str) -> tuple[tuple[str, str, int, str], ...]:
    return tuple((row.suite, row.task, row.episode, layout(row)) for row in suites.lists.read(suite))


def layout(row: EpisodeRow) -> str:
    """Where the target, its look-alikes and its goal start; objects that only crowd the scene do not count."""
    shown = [place for place in row.placements if place.model in (row.target, row.goal) or "-lookalike-" in place.model]
    return "; ".join(f"{p.model} {p.x:g} {p.y:g} {p.yaw:g}" for p in shown)


def power(pairs: int, effect: float, *, alpha: float = 0.05, discordant: float = 0.5) -> float:
    """The chance that McNemar's exact two-sided test on `pairs` episodes finds a true difference `effect` of success rates.

    `discordant` is the share of episodes where exactly one method succeeds, of which (1 + effect / discordant) / 2 favour the better one.
    """
    from scipy.stats import binom

    m = np.arange(pairs + 1)
    reject = binom.ppf(alpha / 2, m, 0.5)  # so many or fewer on one side reject
    reject = np.where(binom.cdf(reject, m, 0.5) > alpha / 2, reject - 1, reject)
    better = 0.5 * (1 + effect / discordant)
    found = binom.cdf(reject, m, better) + binom.sf(m - reject - 1, m, better)
    return float((binom.pmf(m, pairs, discordant) * np.where(reject < 0, 0.0, found)).sum())


def minimum_detectable_effect(pairs: int, *, alpha: float = 0.05, power_wanted: float = 0.8, discordant: float = 0.5) -> float:
    """The least difference of two success rates that McNemar's exact test on `pairs` episodes detects with the wanted power; nan if none.

    Assumes that on the share `discordant` of the episodes exactly one method succeeds: 0.5 is what two unrelated methods of 50 % success give,
    the most that methods which do not hinder each other give. Between methods that mostly win the same episodes smaller differences are found.
    """
    from scipy.optimize import brentq

    def lacking(effect: float) -> float:
        return power(pairs, effect, alpha=alpha, discordant=discordant) - power_wanted

    return float(brentq(lacking, 0.0, discordant, xtol=1e-4)) if lacking(discordant) > 0 else float("nan")


def foresight(rows: Sequence[EpisodeRow]) -> str:
    """What a comparison of two methods on `rows` can find at all, one line, to be said before a run."""
    pairs, units = len(rows), len({(r.suite, r.task, layout(r), r.seed if r.suite in suites.WARM_UPS else 0) for r in rows})
    effect = minimum_detectable_effect(units)
    where = f"{pairs} paired episodes" + (f" on {units} layouts" if units < pairs else "")
    if np.isnan(effect):
        return f"{where}: too few to detect any difference of methods (80 % power, alpha 5 %, exact McNemar, half of the pairs discordant)"
    among = ", counting each layout once" if units < pairs else ""
    assumed = f"alpha 5 %, exact McNemar, half of the pairs discordant{among}"
    return f"{where}: differences of {100 * effect:.0f} points or more are detected with 80 % power ({assumed})"
