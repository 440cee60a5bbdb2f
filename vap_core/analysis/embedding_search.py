"""Searches a table of word embeddings, block by block, for rows that are nearer than a token's own.

The search is exact and makes no matrix of tokens by tokens. Most tokens are settled by a bound:
with P the projection on some directions and Q on the rest, <a, b> <= <Pa, Pb> + |Qa| |Qb|. That is
an inner product of vectors with one number more than there are directions. Near the bound, and
where float32 cannot decide, rows are compared in full.
"""

from collections.abc import Callable, Iterable
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

BLOCK = 4096
"""Rows that are read at once."""
SLACK = 2e-5
"""More than float32's error in a cosine of a few thousand features."""
Watch = Callable[[Iterable[int], str], Iterable[int]]
"""Passes on the starts of blocks while it shows how far the named pass is."""


@runtime_checkable
class Table(Protocol):
    """A table of embeddings, a row per token."""

    @property
    def shape(self) -> tuple[int, int]: ...

    def block(self, start: int, stop: int) -> Float32[np.ndarray, "r d"]:
        """Rows `start` to `stop`, without the last."""
        ...


def take(table: Table, tokens: Int64[np.ndarray, " t"]) -> Float32[np.ndarray, "t d"]:
    """Some rows of a table, in the order of `tokens`."""
    rows = np.zeros((len(tokens), table.shape[1]), np.float32)
    for start in range(0, table.shape[0], BLOCK):
        stop = min(start + BLOCK, table.shape[0])
        inside = (tokens >= start) & (tokens < stop)
        if inside.any():
            rows[inside] = table.block(start, stop)[tokens[inside] - start]
    return rows


def nearest_tokens(
    embedding: Float32[np.ndarray, " d"], table: Table, k: int
) -> list[tuple[int, float]]:
    """The `k` tokens whose rows are nearest to an embedding, and their cosines."""
    cosines = []
    for start in range(0, table.shape[0], BLOCK):
        rows = table.block(start, min(start + BLOCK, table.shape[0]))
        cosines.append(paired_cosines(np.broadcast_to(embedding, rows.shape), rows))
    every = np.nan_to_num(np.concatenate(cosines), nan=-np.inf)
    best = np.argsort(-every, kind="stable")[:k]
    return [(int(token), float(every[token])) for token in best]


def unsettled_tokens(
    one: Table,
    other: Table,
    cosines: Float64[np.ndarray, " n"],
    tokens: Int64[np.ndarray, " t"],
    directions: Float32[np.ndarray, "d k"],
    watch: Watch,
) -> Int64[np.ndarray, " u"]:
    """The tokens of which the bound by these directions leaves open whether a row is nearer."""
    n = len(cosines)
    theirs = np.zeros((n, directions.shape[1] + 1), np.float32)
    for start in range(0, n, BLOCK):
        stop = min(start + BLOCK, n)
        theirs[start:stop] = _bounding(other.block(start, stop), directions)
    unsettled = []
    firsts = range(0, len(tokens), BLOCK)
    for first in watch(firsts, f"bounds by {directions.shape[1]} directions"):
        asked = tokens[first : first + BLOCK]
        ours = _bounding(take(one, asked), directions)
        least = (cosines[asked] - SLACK).astype(np.float32)
        settled = np.ones(len(asked), bool)
        for start in range(0, n, BLOCK):
            left = np.flatnonzero(settled)
            bounds = ours[left] @ theirs[start : start + BLOCK].T
            _leave_own_out(bounds, asked[left], start)
            settled[left] = bounds.max(1) < least[left]
        unsettled.append(asked[~settled])
    return np.concatenate([tokens[:0], *unsettled])


def tokens_with_nearer(
    rows: Float32[np.ndarray, "t d"],
    tokens: Int64[np.ndarray, " t"],
    cosines: Float64[np.ndarray, " t"],
    other: Table,
    n: int,
) -> Bool[np.ndarray, " t"]:
    """Which tokens have a strictly nearer row in the second table than their own.

    What float32 cannot decide is decided in float64.
    """
    lost = np.zeros(len(tokens), bool)
    ours = unit_rows(rows)
    for start in range(0, n, BLOCK):
        left = np.flatnonzero(~lost)
        theirs = other.block(start, min(start + BLOCK, n))
        found = ours[left] @ unit_rows(theirs).T
        _leave_own_out(found, tokens[left], start)
        near, columns = np.nonzero(found > (cosines[left, None] - SLACK).astype(np.float32))
        for first in range(0, len(near), BLOCK):
            who = left[near[first : first + BLOCK]]
            exact = paired_cosines(rows[who], theirs[columns[first : first + BLOCK]])
            lost[who[exact > cosines[who] + 1e-12]] = True
    return lost


def paired_cosines(
    ours: Float32[np.ndarray, "r d"], theirs: Float32[np.ndarray, "r d"]
) -> Float64[np.ndarray, " r"]:
    """The cosine of every pair of rows in float64; nan where one is zero."""
    a = ours.astype(np.float64)
    b = theirs.astype(np.float64)
    norms = np.sqrt(np.square(a).sum(1) * np.square(b).sum(1))
    return np.divide((a * b).sum(1), norms, out=np.full(len(a), np.nan), where=norms > 0)


def unit_rows(rows: Float32[np.ndarray, "r d"]) -> Float32[np.ndarray, "r d"]:
    """The rows at unit length; a zero row stays."""
    norms = np.sqrt(squared_lengths(rows))
    return rows / np.where(norms > 0, norms, 1).astype(np.float32)[:, None]


def squared_lengths(rows: Float32[np.ndarray, "r d"]) -> Float64[np.ndarray, " r"]:
    """The squared length of every row."""
    return np.square(rows, dtype=np.float64).sum(1)


def _leave_own_out(
    found: Float32[np.ndarray, "t r"], tokens: Int64[np.ndarray, " t"], start: int
) -> None:
    """Sets the token's own row to -inf; columns are the tokens from `start` on."""
    inside = np.flatnonzero((tokens >= start) & (tokens < start + found.shape[1]))
    found[inside, tokens[inside] - start] = -np.inf


def _bounding(
    rows: Float32[np.ndarray, "r d"], directions: Float32[np.ndarray, "d k"]
) -> Float32[np.ndarray, "r k1"]:
    """Vectors whose inner products are no less than the rows' cosines: Pa, and |Qa|."""
    units = unit_rows(rows)
    projected = units @ directions
    rest = np.sqrt(np.maximum(squared_lengths(units) - squared_lengths(projected), 0))
    return np.concatenate([projected, rest[:, None].astype(np.float32)], axis=1)
