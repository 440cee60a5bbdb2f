"""Rotates a learned token from the space of the model it was learned in into a policy's.

Training a policy moves the embeddings of the words that it reads. An orthogonal map between the two
tables of embeddings, fitted over the words that both have, carries a token along.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from vap_core.policies.embedding_table import check_width, open_table

PRIOR = 1e-3
"""Weight of the identity, in squared lengths of a mean row.

It decides only what the words leave open: a small vocabulary has fewer words than features.
"""


def orthogonal_map(
    source: Float32[np.ndarray, "v d"], target: Float32[np.ndarray, "v d"]
) -> Float64[np.ndarray, "d d"]:
    """The orthogonal R for which source @ R is nearest to target (Procrustes)."""
    from scipy.linalg import orthogonal_procrustes

    width = source.shape[1]
    mean_square = np.square(source, dtype=np.float64).sum() / len(source)
    identity = np.sqrt(PRIOR * mean_square / width) * np.eye(width)
    rotation, _ = orthogonal_procrustes(
        np.concatenate([source, identity]), np.concatenate([target, identity])
    )
    return rotation


def align(
    embedding: Float32[np.ndarray, " d"], model: Path, policy: Path
) -> Float32[np.ndarray, " d"]:
    """The embedding, learned in `model`, rotated into the space of the policy; both are folders.

    Raises: BadPolicy.
    """
    check_width(open_table(model), len(embedding), "the embedding")
    source, target = shared_tables(model, policy)
    return (embedding @ orthogonal_map(source, target)).astype(np.float32)


def shared_tables(
    model: Path, policy: Path
) -> tuple[Float32[np.ndarray, "v d"], Float32[np.ndarray, "v d"]]:
    """The two tables over the tokens that both have. Raises: BadPolicy."""
    tables = open_table(model), open_table(policy)
    check_width(tables[1], tables[0].shape[1], str(model))
    n = min(table.shape[0] for table in tables)
    return tables[0].block(0, n), tables[1].block(0, n)
