"""Where a learned token lies among words, and whether a rotation carries words into a policy."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from vap_core.analysis.embedding_search import nearest_tokens, paired_cosines
from vap_core.base.errors import BadPolicy
from vap_core.evaluation.perception.estimates import NONE, Estimate
from vap_core.evaluation.statistics import bootstrap_interval
from vap_core.policies.embedding_table import check_width, open_table
from vap_core.policies.mini_pi0.token_alignment import (
    align,
    held_out_cosines,
    orthogonal_map,
    shared_tables,
)
from vap_core.policies.token_groups import vocabulary_of

READ = 0.9999
"""A word whose cosine is above it has been left alone: the policy's films never say it."""


def nearest_words(
    embedding: Float32[np.ndarray, " d"], model: Path, k: int = 6
) -> list[tuple[str, float]]:
    """The words of a model that are nearest to an embedding, and their cosines.

    The words are those of a small model's config.json or of a tokenizer.json in the folder. A row
    that is no word's is "token N".

    Raises: BadPolicy, as `open_table`; for an embedding of another width; for a folder without
        words.
    """
    table = open_table(model)
    check_width(table, len(embedding), "the embedding")
    found = vocabulary_of(model)
    if found is None:
        raise BadPolicy(
            f"nearest_words: {model} does not say what its tokens are; put the model's "
            "tokenizer.json there."
        )
    words = {token: word for word, token in found[0].items()}
    nearest = nearest_tokens(embedding, table, k)
    return [(words.get(token, f"token {token}"), cosine) for token, cosine in nearest]


def longest_word(model: Path) -> float:
    """The largest length of a row in a model's table of embeddings.

    Raises: BadPolicy, as `open_table`.
    """
    table = open_table(model)
    return float(np.linalg.norm(table.block(0, table.shape[0]), axis=1).max())


def rotation_deg(embedding: Float32[np.ndarray, " d"], model: Path, policy: Path) -> float:
    """By how many degrees the rotation into a policy's space turns an embedding.

    Raises: BadPolicy, as `align`.
    """
    rotated = align(embedding, model, policy)
    lengths = np.linalg.norm(embedding) * np.linalg.norm(rotated)
    return float(np.degrees(np.arccos(np.clip(embedding @ rotated / lengths, -1, 1))))


def rotation_cosines(model: Path, policy: Path) -> dict[str, Float64[np.ndarray, " w"]]:
    """Cosines of the words that the policy reads to themselves in it, by what is done to them.

    They are copied as they are; rotated by the best orthogonal map over the shared vocabulary; or
    rotated by the map that was fitted without the word itself.

    Raises: BadPolicy, as `shared_tables`.
    """
    source, target = shared_tables(model, policy)
    copied = paired_cosines(source, target)
    # A comparison with nan, of a row of zeros, is false.
    words = np.flatnonzero(copied < READ)
    fitted = (source @ orthogonal_map(source, target)).astype(np.float32)
    return {
        "copied": copied[words],
        "rotated, fitted": paired_cosines(fitted, target)[words],
        "rotated, left out": held_out_cosines(source, target, words),
    }


def mean_cosine(cosines: Float64[np.ndarray, " w"]) -> Estimate:
    """The mean over words, with its bootstrap interval over words; NONE without words."""
    if not len(cosines):
        return NONE
    low, high = bootstrap_interval(cosines, np.ones(len(cosines)))
    return Estimate(value=float(cosines.mean()), low=low, high=high, n=len(cosines))
