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
from vap_core.evaluation.statistics import SEED

if TYPE_CHECKING:
    import pandas as pd

LEAST_FAILURES = 10
Scores = Float[np.ndarray, " n"]
Labels = Bool[np.ndarray, " n"]


@dataclass(frozen=True)
class Auc:
    """Chance that a positive has a higher score than a negative, of `n` episodes, and its 95 %
    interval."""

    value: float
    low: float
    high: float
    n: int

    def __str__(self) -> str:
        if np.isnan(self.value):
            return f"- (n = {self.n})"
        return f"{self.value:.2f} [{self.low:.2f}, {self.high:.2f}] (n = {self.n})"


def auc(scores: Scores, labels: Labels, strata: Sequence[str] = ()) -> float:
    """The share of pairs in order, ties count half; nan without both kinds."""
    once = np.ones((1, len(labels)))
    return float(_resampled(scores, labels, strata, times=once)[0])


def auc_interval(
    scores: Scores, labels: Labels, clusters: Sequence[str], strata: Sequence[str] = ()
) -> Auc:
    """The area, and its interval by resampling clusters (percentiles)."""
    times = resamples(clusters, strata)
    low, high = percentiles(_resampled(scores, labels, strata, times=times))
    return Auc(
        value=auc(scores, labels, strata),
        low=low,
        high=high,
        n=len(labels),
    )


def auc_gain(
    scores: tuple[Scores, Scores],
    labels: Labels,
    clusters: Sequence[str],
    strata: Sequence[str] = (),
) -> Auc:
    """By how much the second of two scores of the same episodes tells them better."""
    first, second = scores
    times = resamples(clusters, strata)
    gains = _resampled(second, labels, strata, times=times)
    gains = gains - _resampled(first, labels, strata, times=times)
    low, high = percentiles(gains)
    return Auc(
        value=auc(second, labels, strata) - auc(first, labels, strata),
        low=low,
        high=high,
        n=len(labels),
    )


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
    predictors: Float[np.ndarray, "n d"], labels: Labels, clusters: Sequence[str], folds: int = 10
) -> Scores:
    """What a logistic regression says of layouts that it was not fitted on.

    Clusters are dealt out to `folds` folds. The intercept is left out: that of a fold without
    positives is higher, which would rank the folds against the truth. A small ridge keeps the fit
    finite where a predictor separates the episodes.
    """
    names, of_cluster = np.unique(np.asarray(clusters, dtype=str), return_inverse=True)
    fold_of = np.random.default_rng(SEED).permutation(len(names)) % folds
    folds_of = fold_of[of_cluster]
    scores = np.zeros(len(labels))
    for fold in range(folds):
        held = folds_of == fold
        mean = predictors[~held].mean(0)
        scale = predictors[~held].std(0) + 1e-9
        known = np.column_stack([np.ones((~held).sum()), (predictors[~held] - mean) / scale])
        slopes = _logistic(known, labels[~held])[1:]
        scores[held] = (predictors[held] - mean) / scale @ slopes
    return scores


def _logistic(
    design: Float[np.ndarray, "n k"], labels: Labels, ridge: float = 0.1
) -> Float[np.ndarray, " k"]:
    """Newton's method."""
    weights = np.zeros(design.shape[1])
    penalty = ridge * np.eye(len(weights))
    for _ in range(50):
        chance = 1 / (1 + np.exp(-(design @ weights)))
        gradient = design.T @ (labels - chance) - penalty @ weights
        hessian = (design.T * (chance * (1 - chance))) @ design + penalty
        weights = weights + np.linalg.solve(hessian, gradient)
    return weights


def warnings(table: "pd.DataFrame", measures: Sequence[str]) -> dict[str, Auc]:
    """Failures foretold by the vote margin, by the attention, by both, and what that gains.

    Logistic regressions, scored on layouts that they were not fitted on; predictors are ranks
    within their suite. The margin stands there unfitted, too: a low one foretells a failure.
    `table` are episodes of one method that votes. Empty with fewer than LEAST_FAILURES.
    """
    voted = table[table["margin"].notna()]
    failed = ~voted["success"].to_numpy(bool)
    if failed.sum() < LEAST_FAILURES:
        return {}
    layouts = [f"{one} {other}" for one, other in zip(voted["suite"], voted["layout"], strict=True)]
    suites = list(voted["suite"].astype(str))
    ranks = voted.groupby("suite", observed=True)[["margin", *measures]].rank(pct=True)
    scores = {}
    for name, columns in (
        ("vote margin", ["margin"]),
        ("attention", list(measures)),
        ("both", ["margin", *measures]),
    ):
        scores[name] = left_out_scores(ranks[columns].to_numpy(float), failed, layouts)
    found = {}
    low_margin = -ranks["margin"].to_numpy(float)
    for name, values in {"low vote margin, unfitted": low_margin, **scores}.items():
        found[name] = auc_interval(values, failed, layouts, suites)
    pair = (scores["vote margin"], scores["both"])
    found["both, beyond the margin"] = auc_gain(pair, failed, layouts, suites)
    return found


def predict_success(table: "pd.DataFrame", measures: Sequence[str]) -> "dict[str, Auc]":
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
