"""Which candidate is the user's object: each reference votes for its most similar one (P 3.3)."""

from typing import Literal

import numpy as np
from jaxtyping import Float32

from vap_core.base.types import Ballot

VoteRule = Literal["vote", "average"]

SAME = 1e-6
"""Cosines closer than this are equal, so that rounding never decides an election."""


def similarity(
    candidates: Float32[np.ndarray, "n d"], references: Float32[np.ndarray, "k d"]
) -> Float32[np.ndarray, "n k"]:
    """cos(e_i, z_k) for L2-normalised rows."""
    return np.clip(candidates @ references.T, -1.0, 1.0).astype(np.float32)


def vote(cosine: Float32[np.ndarray, "n k"], rule: VoteRule = "vote") -> Ballot:
    """Elect one of n candidates by K references.

    "vote": b* = argmax_i sum_k [i = argmax_j cos(e_j, z_k)]; a tie in votes goes to the tied
    candidate with the highest mean cosine (P 3.3). "average" is the ablation
    (P tab:ablation_vote): argmax of the mean cosine; votes are still counted. Exact duplicates
    go to the candidate listed first, the detector's more confident one.

    Raises: ValueError, when there are candidates but no references.
    """
    n, k = cosine.shape
    if n == 0:
        return Ballot(
            votes=np.zeros(0, np.int64),
            tied=np.zeros(0, bool),
            winner=None,
            margin=0.0,
            cosine_margin=0.0,
        )
    if k == 0:
        raise ValueError("vote: no references; a personal object has at least one")
    best_of_reference = (cosine >= cosine.max(axis=0) - SAME).argmax(axis=0)
    votes = np.bincount(best_of_reference, minlength=n).astype(np.int64)
    mean = cosine.astype(np.float64).mean(axis=1)
    most_votes = votes == votes.max()

    eligible = most_votes if rule == "vote" else np.ones(n, bool)
    best = mean[eligible].max()
    winner = int(np.flatnonzero(eligible & (mean >= best - SAME))[0])

    others = np.arange(n) != winner
    runner_up = int(votes[others].max(initial=0))
    margin = (int(votes[winner]) - runner_up) / k
    cosine_margin = float(mean[winner] - mean[others].max()) if n > 1 else 2.0
    tied = most_votes & (np.count_nonzero(most_votes) > 1)
    return Ballot(votes, tied, winner, margin, cosine_margin)
