"""How well a measure of the attention tells successes from failures: areas under the ROC curve.

Where episodes are of several suites, only pairs of one suite are compared: a measure that tells the
suites apart tells nothing of an episode.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from vap_core.analysis.attention.intervals import Times, percentiles, resamples
from vap_core.evaluation.perception.estimates import Estimate
from vap_core.evaluation.statistics import SEED

if TYPE_CHECKING:
    import pandas as pd

LEAST_FAILURES = 10
DRAWS = 200
"""How often failures are dealt out at random for `warnings_by_chance`."""
FOLDS = 10
RIDGE = 0.1
BEYOND = "both, beyond the margin"
Scores = Float[np.ndarray, " n"]
Labels = Bool[np.ndarray, " n"]


def auc(scores: Scores, labels: Labels, strata: Sequence[str] = ()) -> float:
    """The share of pairs in order, ties count half; nan without both kinds."""
    once = np.ones((1, len(labels)))
    return float(_resampled(scores, labels, strata, times=once)[0])


def auc_interval(
    scores: Scores, labels: Labels, clusters: Sequence[str], strata: Sequence[str] = ()
) -> Estimate:
    """The area of n episodes, and its interval by resampling clusters (percentiles)."""
    times = resamples(clusters, strata)
    low, high = percentiles(_resampled(scores, labels, strata, times=times))
    return Estimate(value=auc(scores, labels, strata), low=low, high=high, n=len(labels))


def auc_gain(
    scores: tuple[Scores, Scores],
    labels: Labels,
    clusters: Sequence[str],
    strata: Sequence[str] = (),
) -> Estimate:
    """By how much the second of two scores of the same episodes tells them better."""
    first, second = scores
    times = resamples(clusters, strata)
    gains = _resampled(second, labels, strata, times=times)
    gains = gains - _resampled(first, labels, strata, times=times)
    low, high = percentiles(gains)
    gain = auc(second, labels, strata) - auc(first, labels, strata)
    return Estimate(value=gain, low=low, high=high, n=len(labels))


def _resampled(
    scores: Scores, labels: Labels, strata: Sequence[str], *, times: Times
) -> Float[np.ndarray, " resamples"]:
    """The area of every resample, in which episode i stands `times[:, i]` times; nan as `auc`'s."""
    high = scores[labels][:, None]
    low = scores[~labels][None]
    wins = (high > low) + 0.5 * (high == low)
    wins[np.isnan(high) | np.isnan(low)] = np.nan
    positive = times[:, labels]
    negative = times[:, ~labels]
    if not len(strata):
        won = ((positive @ wins) * negative).sum(axis=1)
        pairs = positive.sum(axis=1) * negative.sum(axis=1)
    else:
        names = np.asarray(strata, dtype=str)
        same = (names[labels][:, None] == names[~labels][None]).astype(float)
        won = ((positive @ (wins * same)) * negative).sum(axis=1)
        pairs = ((positive @ same) * negative).sum(axis=1)
    return np.divide(won, pairs, out=np.full(len(times), np.nan), where=pairs > 0)


def left_out_scores(
    predictors: Float[np.ndarray, "n d"], labels: Labels, clusters: Sequence[str]
) -> Scores:
    """What a logistic regression says of layouts that it was not fitted on.

    Clusters are dealt out to FOLDS folds. The intercept is left out: that of a fold without
    positives is higher, which would rank the folds against the truth. A small ridge keeps the fit
    finite where a predictor separates the episodes.
    """
    names, of_cluster = np.unique(np.asarray(clusters, dtype=str), return_inverse=True)
    fold_of = np.random.default_rng(SEED).permutation(len(names)) % FOLDS
    folds_of = fold_of[of_cluster]
    scores = np.zeros(len(labels))
    for fold in range(FOLDS):
        held = folds_of == fold
        mean = predictors[~held].mean(0)
        scale = predictors[~held].std(0) + 1e-9
        known = np.column_stack([np.ones((~held).sum()), (predictors[~held] - mean) / scale])
        slopes = _logistic(known, labels[~held])[1:]
        scores[held] = (predictors[held] - mean) / scale @ slopes
    return scores


def _logistic(design: Float[np.ndarray, "n k"], labels: Labels) -> Float[np.ndarray, " k"]:
    """Newton's method."""
    weights = np.zeros(design.shape[1])
    penalty = RIDGE * np.eye(len(weights))
    for _ in range(50):
        chance = 1 / (1 + np.exp(-(design @ weights)))
        gradient = design.T @ (labels - chance) - penalty @ weights
        hessian = (design.T * (chance * (1 - chance))) @ design + penalty
        step = np.linalg.solve(hessian, gradient)
        weights = weights + step
        if np.abs(step).max() < 1e-12:
            break
    return weights


def warnings(table: "pd.DataFrame", measures: Sequence[str]) -> dict[str, Estimate]:
    """Failures foretold by the vote margin, by the attention, by both, and what that gains.

    Logistic regressions, scored on layouts that they were not fitted on; predictors are ranks
    within their suite. The margin stands there unfitted, too: a low one foretells a failure.
    What a fitted area is compared with is not .5, but that of `warnings_by_chance`. Intervals
    resample the scored layouts; the fits are not repeated, so that they are too narrow. `table` are
    episodes of one method that votes. Empty with fewer than LEAST_FAILURES.
    """
    known = _Voted.of(table, measures)
    if known.failed.sum() < LEAST_FAILURES:
        return {}
    scores = known.scores(known.failed)
    found = {}
    for name, values in scores.items():
        found[name] = auc_interval(values, known.failed, known.layouts, known.suites)
    pair = (scores["vote margin"], scores["both"])
    found[BEYOND] = auc_gain(pair, known.failed, known.layouts, known.suites)
    return found


def warnings_by_chance(
    table: "pd.DataFrame", measures: Sequence[str], draws: int = DRAWS
) -> dict[str, Estimate]:
    """The areas of `warnings` when failures are dealt out at random within their suite.

    The mean and the middle 95 % of the draws: what predictors reach that know nothing. Fitted ones
    lie under .5 in the mean: the failures that a fold holds are missing from its fit, which leans
    away from them. An area inside the range is not shown to be better or worse than chance.
    Failures are dealt out to single episodes, as if those of one layout were independent.
    """
    known = _Voted.of(table, measures)
    if known.failed.sum() < LEAST_FAILURES:
        return {}
    rng = np.random.default_rng(SEED)
    areas: dict[str, list[float]] = {}
    for _ in range(draws):
        failed = _shuffled(known.failed, known.suites, rng)
        drawn = {}
        for name, values in known.scores(failed).items():
            drawn[name] = auc(values, failed, known.suites)
        drawn[BEYOND] = drawn["both"] - drawn["vote margin"]
        for name, area in drawn.items():
            areas.setdefault(name, []).append(area)
    found = {}
    for name, drawn_areas in areas.items():
        low, high = percentiles(np.array(drawn_areas))
        mean = float(np.mean(drawn_areas))
        found[name] = Estimate(value=mean, low=low, high=high, n=len(known.failed))
    return found


def _shuffled(labels: Labels, strata: Sequence[str], rng: np.random.Generator) -> Labels:
    """The labels in another order within each stratum."""
    names = np.asarray(strata, dtype=str)
    shuffled = labels.copy()
    for name in np.unique(names):
        shuffled[names == name] = rng.permutation(labels[names == name])
    return shuffled


@dataclass(frozen=True)
class _Voted:
    """Episodes that voted, with the ranks of their margins and measures within their suite."""

    failed: Labels
    layouts: list[str]
    suites: list[str]
    margin: Float[np.ndarray, "n 1"]
    measured: Float[np.ndarray, "n d"]

    @classmethod
    def of(cls, table: "pd.DataFrame", measures: Sequence[str]) -> "_Voted":
        voted = table[table["margin"].notna()]
        names = zip(voted["suite"], voted["layout"], strict=True)
        ranks = voted.groupby("suite", observed=True)[["margin", *measures]].rank(pct=True)
        return cls(
            failed=~voted["success"].to_numpy(bool),
            layouts=[f"{suite} {layout}" for suite, layout in names],
            suites=list(voted["suite"].astype(str)),
            margin=ranks[["margin"]].to_numpy(float),
            measured=ranks[[*measures]].to_numpy(float),
        )

    def scores(self, failed: Labels) -> dict[str, Scores]:
        """How likely each episode is to fail, by every predictor; `failed` are to be foretold."""
        found = {"low vote margin, unfitted": -self.margin[:, 0]}
        for name, predictors in (
            ("vote margin", self.margin),
            ("attention", self.measured),
            ("both", np.column_stack([self.margin, self.measured])),
        ):
            found[name] = left_out_scores(predictors, failed, self.layouts)
        return found


def predict_success(table: "pd.DataFrame", measures: Sequence[str]) -> dict[str, Estimate]:
    """For every measure of `patterns.per_episode`, how well it tells successes from failures."""
    suites = list(table["suite"].astype(str))
    found = {}
    for name in measures:
        found[name] = auc_interval(
            table[name].to_numpy(float),
            table["success"].to_numpy(bool),
            list(table["layout"]),
            suites,
        )
    return found
