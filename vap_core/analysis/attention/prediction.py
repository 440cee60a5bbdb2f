"""How well a measure of the attention tells successes from failures: areas under the ROC curve.

Intervals resample whole layouts, because the episodes of one layout are alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from vap_core.evaluation.statistics import SEED

if TYPE_CHECKING:
    import pandas as pd

RESAMPLES = 2000
LEAST_FAILURES = 10
Scores = Float[np.ndarray, " n"]
Labels = Bool[np.ndarray, " n"]


@dataclass(frozen=True)
class Auc:
    """Chance that a positive has a higher score than a negative, with its 95 % interval.

    `n` episodes in `clusters` layouts, of which `positives` are positive.
    """

    value: float
    low: float
    high: float
    n: int
    positives: int
    clusters: int

    def __str__(self) -> str:
        if np.isnan(self.value):
            return f"- (n = {self.n})"
        return f"{self.value:.2f} [{self.low:.2f}, {self.high:.2f}] (n = {self.n})"


def auc(scores: Scores, labels: Labels) -> float:
    """Mann-Whitney's U by the number of pairs, ties count half; nan without both kinds."""
    from scipy.stats import rankdata

    positives = int(labels.sum())
    negatives = len(labels) - positives
    if positives == 0 or negatives == 0:
        return float("nan")
    ranks = rankdata(scores)
    above = ranks[labels].sum() - positives * (positives + 1) / 2
    return float(above / (positives * negatives))


def auc_interval(scores: Scores, labels: Labels, clusters: Sequence[str]) -> Auc:
    """The area, and its interval by resampling clusters (percentiles)."""
    names, of_cluster = np.unique(np.asarray(clusters, dtype=str), return_inverse=True)
    drawn = np.random.default_rng(SEED).integers(len(names), size=(RESAMPLES, len(names)))
    times = np.zeros((RESAMPLES, len(names)))
    np.add.at(times, (np.arange(RESAMPLES)[:, None], drawn), 1.0)
    values = _resampled(scores, labels, times[:, of_cluster])
    finite = values[~np.isnan(values)]
    low, high = np.quantile(finite, [0.025, 0.975]) if len(finite) else (np.nan, np.nan)
    return Auc(
        value=auc(scores, labels),
        low=float(low),
        high=float(high),
        n=len(labels),
        positives=int(labels.sum()),
        clusters=len(names),
    )


def _resampled(
    scores: Scores, labels: Labels, times: Float[np.ndarray, "resamples n"]
) -> Float[np.ndarray, " resamples"]:
    """The area of every resample, in which episode i stands `times[:, i]` times; nan as `auc`'s."""
    high = scores[labels][:, None]
    low = scores[~labels][None]
    wins = (high > low) + 0.5 * (high == low)
    wins[np.isnan(high) | np.isnan(low)] = np.nan
    positive = times[:, labels]
    negative = times[:, ~labels]
    won = ((positive @ wins) * negative).sum(axis=1)
    pairs = positive.sum(axis=1) * negative.sum(axis=1)
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


def warning_table(table: "pd.DataFrame", measures: Sequence[str]) -> "pd.DataFrame":
    """Failures foretold by the vote margin, by the attention, and by both: areas and intervals.

    Logistic regressions, scored on layouts that they were not fitted on. `table` are episodes of
    one method that votes. With fewer than LEAST_FAILURES nothing is fitted.
    """
    import pandas as pd

    voted = table[table["margin"].notna()]
    failed = ~voted["success"].to_numpy(bool)
    layouts = list(voted["layout"])
    rows = []
    n_failures = int(failed.sum())
    for name, columns in (
        ("vote margin", ["margin"]),
        ("attention", list(measures)),
        ("both", ["margin", *measures]),
    ):
        if n_failures < LEAST_FAILURES:
            said = f"too few failures ({n_failures} of {len(voted)})"
            rows.append({"predictor": name, "AUC for failure": said})
            continue
        scores = left_out_scores(voted[columns].to_numpy(float), failed, layouts)
        rows.append(
            {"predictor": name, "AUC for failure": str(auc_interval(scores, failed, layouts))}
        )
    return pd.DataFrame(rows).set_index("predictor")


def predict_success(table: "pd.DataFrame", measures: Sequence[str]) -> "dict[str, Auc]":
    """For every measure of `patterns.per_episode`, how well it tells successes from failures."""
    found = {}
    for name in measures:
        found[name] = auc_interval(
            table[name].to_numpy(float), table["success"].to_numpy(bool), list(table["layout"])
        )
    return found
