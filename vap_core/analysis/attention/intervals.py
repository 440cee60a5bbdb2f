"""95 % intervals by resampling whole layouts, because the episodes of one layout are alike.

Layouts are drawn within their suite, so that every resample has as many of each suite.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from vap_core.study.stats import NONE, SEED, Estimate

RESAMPLES = 2000
Values = Float[np.ndarray, " n"]
Times = Float[np.ndarray, "resamples n"]
"""How often an episode stands in each resample."""


def resamples(clusters: Sequence[str], strata: Sequence[str] = ()) -> Times:
    """How often every episode is drawn; `strata` are the suites (none: all are of one)."""
    names, of_cluster = np.unique(np.asarray(clusters, dtype=str), return_inverse=True)
    stratum_of = np.zeros(len(names), int)
    if len(strata):
        _, of_stratum = np.unique(np.asarray(strata, dtype=str), return_inverse=True)
        stratum_of[of_cluster] = of_stratum
    rng = np.random.default_rng(SEED)
    times = np.zeros((RESAMPLES, len(names)))
    for stratum in np.unique(stratum_of):
        members = np.flatnonzero(stratum_of == stratum)
        drawn = members[rng.integers(len(members), size=(RESAMPLES, len(members)))]
        np.add.at(times, (np.arange(RESAMPLES)[:, None], drawn), 1.0)
    return times[:, of_cluster]


def percentiles(values: Float[np.ndarray, " resamples"]) -> tuple[float, float]:
    """The middle 95 % of those that are not nan; nan where all are."""
    finite = values[~np.isnan(values)]
    if not len(finite):
        return float("nan"), float("nan")
    low, high = np.quantile(finite, [0.025, 0.975])
    return float(low), float(high)


def mean(values: Values, clusters: Sequence[str], strata: Sequence[str] = ()) -> Estimate:
    """The mean over episodes."""
    if not len(values):
        return NONE
    times = resamples(clusters, strata)
    low, high = percentiles(times @ values / times.sum(axis=1))
    return Estimate(value=float(values.mean()), low=low, high=high, n=len(values))
