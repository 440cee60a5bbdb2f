"""Which candidate is the user's object: each reference votes for its most similar one (P 3.3)."""

from typing import Literal, get_args

import numpy as np
from jaxtyping import Float32, Int64

from vap_core.base.errors import BadCrop, BadEncoder, one_of
from vap_core.base.types import (
    SAME,
    Ballot,
    Boxes,
    PersonalObject,
    Rgb,
    best_of_references,
    election_scores,
)
from vap_core.memory import reference_rows
from vap_core.perception.boxes import other_places
from vap_core.perception.candidates import (
    MOST_CANDIDATES,
    MOST_COMPARED,
    Candidates,
    Proposals,
    describe_fault,
    embed_crops,
    prove,
    row_fault,
)
from vap_core.perception.protocols import Stack

VoteRule = Literal["vote", "average", "best"]
RULES: tuple[str, ...] = get_args(VoteRule)


def similarity(
    candidates: Float32[np.ndarray, "n d"], references: Float32[np.ndarray, "k d"]
) -> Float32[np.ndarray, "n k"]:
    """cos(e_i, z_k) for L2-normalised rows."""
    return np.clip(candidates @ references.T, -1.0, 1.0).astype(np.float32)


def compare(
    obj: PersonalObject, proposals: Proposals | Candidates, stack: Stack
) -> Float32[np.ndarray, "n k"]:
    """cos(e_i, z_k) of every crop of a view, by the encoder of that view.

    Raises: BadEncoder when its rows are not finite, not of length 1 (within 1e-3), or of another
        width than the references': no vote would mean anything. BadCrop, which is one, where it
        embeds the references of the object as it should.
    """
    encoder = stack.encoder_of(proposals.boxes)
    references = reference_rows(obj, encoder)
    fault = row_fault(proposals.embeddings, references) or row_fault(references, references)
    if fault:
        again = embed_crops("vote", encoder, obj.crops)
        kind = BadEncoder if row_fault(again, references) else BadCrop
        raise kind(describe_fault("vote", encoder, fault))
    return similarity(proposals.embeddings, references)


def nominate(
    rgb: Rgb, obj: PersonalObject, offered: Proposals, stack: Stack
) -> tuple[Proposals, Float32[np.ndarray, "n k"]]:
    """The candidates for an object among the proposals of a view, and their cosines.

    Where the stack has a verifier, crops of unfamiliar views are compared point by point, too.

    Raises: BadEncoder, as `compare` does.
    """
    cosine = compare(obj, offered, stack)
    references = reference_rows(obj, stack.encoder_of(offered.boxes))
    few = offered
    if stack.verifier is not None and not offered.boxes.familiar:
        likely = offered.take(shortlist(offered.boxes, cosine, MOST_COMPARED))
        few = prove(rgb, obj, likely, stack.verifier)
        cosine = similarity(few.embeddings, references)
    few = few.take(shortlist(few.boxes, cosine, MOST_CANDIDATES))
    # Not rows of `cosine`: a product of fewer rows may round its last bit otherwise.
    return few, similarity(few.embeddings, references)


def shortlist(
    boxes: Boxes, cosine: Float32[np.ndarray, "n k"], most: int
) -> Int64[np.ndarray, " m"]:
    """Which proposals are candidates, in their order, given their cosines with the references.

    All that a reference votes for and the one of the best mean score, so that an election among the
    candidates is one among all proposals; then, up to `most`, the next by mean in other places.
    """
    if len(boxes) <= most:
        return np.arange(len(boxes))
    scores = election_scores(cosine, boxes)
    by_mean = np.argsort(-scores.astype(np.float64).mean(axis=1), kind="stable")
    kept = np.union1d(best_of_references(scores), by_mean[:1]).tolist()
    return other_places(boxes.xyxy, by_mean, most, kept)


def check_rule(rule: str, what: str) -> None:
    """Raises: UnknownName: no rule of the vote."""
    if rule not in RULES:
        raise one_of(f"{what}: rule", rule, RULES)


def vote(cosine: Float32[np.ndarray, "n k"], rule: VoteRule = "vote") -> Ballot:
    """Elect one of n candidates by K references, given cosines or `election_scores`.

    "vote": b* = argmax_i sum_k [i = argmax_j cos(e_j, z_k)]; a tie in votes goes to the tied
    candidate with the highest mean cosine (P 3.3). "average" is the ablation
    (P tab:ablation_vote): argmax of the mean cosine; "best" is another: argmax of the greatest
    cosine with any one reference. Votes are still counted. Exact duplicates go to the candidate
    listed first, the detector's more confident one.

    Raises: UnknownName: no such rule; ValueError, when there are candidates but no references.
    """
    check_rule(rule, "vote")
    n, k = cosine.shape
    if n == 0:
        return Ballot(np.zeros(0, np.int64), np.zeros(0, bool), None, 0.0, 0.0)
    if k == 0:
        raise ValueError("vote: no references; a personal object has at least one")
    votes = np.bincount(best_of_references(cosine), minlength=n).astype(np.int64)
    mean = cosine.astype(np.float64).mean(axis=1)
    most_votes = votes == votes.max()

    eligible = most_votes if rule == "vote" else np.ones(n, bool)
    score = cosine.astype(np.float64).max(axis=1) if rule == "best" else mean
    best = score[eligible].max()
    winner = int(np.flatnonzero(eligible & (score >= best - SAME))[0])

    others = np.arange(n) != winner
    runner_up = int(votes[others].max(initial=0))
    margin = (int(votes[winner]) - runner_up) / k
    cosine_margin = float(mean[winner] - mean[others].max()) if n > 1 else 2.0
    tied = most_votes & (np.count_nonzero(most_votes) > 1)
    return Ballot(votes, tied, winner, margin, cosine_margin)
