"""How far apart two tables of word embeddings are (P appendix, tab:embedding_comparison).

    compare(open_table(vlm), open_table(policy))

Row i of both tables is token i. Three measures: the cosine of each token's two embeddings; linear
centred kernel alignment (CKA), which no rotation changes; and kNN@1, the share of the first table's
tokens whose nearest row of the second, by cosine, is their own.

Tables are read in blocks of rows, and no matrix of tokens by tokens is made (embedding_search):
257,152 x 2,048 needs about a gigabyte.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from vap_core.analysis.embedding_search import (
    BLOCK,
    Table,
    Watch,
    paired_cosines,
    squared_lengths,
    take,
    tokens_with_nearer,
    unit_rows,
    unsettled_tokens,
)
from vap_core.base.errors import BadPolicy
from vap_core.base.types import value

DIRECTIONS = (32, 256)
"""Numbers of leading directions that bound a cosine, one after the other."""


@value
class ArrayTable:
    """A table that is in memory."""

    rows: Float32[np.ndarray, "v d"]

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows.shape[0], self.rows.shape[1]

    def block(self, start: int, stop: int) -> Float32[np.ndarray, "r d"]:
        return self.rows[start:stop]


@value
class Comparison:
    """What two tables have in common over `tokens` tokens.

    `cka` is the plain estimate, which the paper prints; it nears 1 when there are fewer tokens than
    features, whatever they are. `cka_debiased` (Song et al. 2012) does not; it is nan for fewer
    than four tokens, or where the tables have no structure. A token whose row is zero in a table
    has no direction: cosine and kNN@1 (`nearest`) leave `without_direction` of them out.
    """

    tokens: int
    without_direction: int
    cosine_mean: float
    cosine_std: float
    cosine_min: float
    cka: float
    cka_debiased: float
    nearest: float


def compare(one: Table, other: Table, watch: Watch | None = None) -> Comparison:
    """Compare the tokens that both tables have, the first ones. Raises: BadPolicy."""
    watch = watch or _unwatched
    n = min(one.shape[0], other.shape[0])
    _check_widths(one, other)
    moments = _Moments(one, other, n, watch)
    asked = np.flatnonzero(~np.isnan(moments.cosines))
    left = asked
    directions = moments.directions(max(DIRECTIONS))
    for k in DIRECTIONS:
        if k < one.shape[1]:
            leading = np.ascontiguousarray(directions[:, -k:])
            left = unsettled_tokens(one, other, moments.cosines, left, leading, watch)
    lost = np.zeros(n, bool)
    for first in watch(range(0, len(left), BLOCK), f"cosines of {len(left)} tokens"):
        tokens = left[first : first + BLOCK]
        rows = take(one, tokens)
        lost[tokens] = tokens_with_nearer(rows, tokens, moments.cosines[tokens], other, n)
    return _comparison(moments, lost[asked])


def compare_tokens(one: Table, other: Table, tokens: Int64[np.ndarray, " t"]) -> Comparison:
    """Compare some tokens: cosine and CKA among them, kNN@1 in the whole second table.

    Raises: BadPolicy.
    """
    _check_widths(one, other)
    ours = ArrayTable(take(one, tokens))
    theirs = ArrayTable(take(other, tokens))
    moments = _Moments(ours, theirs, len(tokens), _unwatched)
    asked = np.flatnonzero(~np.isnan(moments.cosines))
    n = min(one.shape[0], other.shape[0])
    lost = tokens_with_nearer(ours.rows[asked], tokens[asked], moments.cosines[asked], other, n)
    return _comparison(moments, lost)


class _Moments:
    """Sums over all tokens, of which CKA and the leading directions are made.

    Two passes: means first, so that nothing large cancels. `cosines` are the tokens', nan where a
    row is zero.
    """

    def __init__(self, one: Table, other: Table, n: int, watch: Watch) -> None:
        width = one.shape[1]
        self.n = n
        mean_one = np.zeros(width)
        mean_other = np.zeros(width)
        starts = range(0, n, BLOCK)
        for start in watch(starts, "means"):
            stop = min(start + BLOCK, n)
            mean_one += one.block(start, stop).sum(0, dtype=np.float64) / n
            mean_other += other.block(start, stop).sum(0, dtype=np.float64) / n
        self.cross = np.zeros((width, width))
        self.of_one = np.zeros((width, width))
        self.of_other = np.zeros((width, width))
        self.of_units = np.zeros((width, width))
        self.cosines = np.zeros(n)
        self.squares_one = np.zeros(n)
        self.squares_other = np.zeros(n)
        for start in watch(starts, "products"):
            stop = min(start + BLOCK, n)
            ours = one.block(start, stop)
            theirs = other.block(start, stop)
            units = unit_rows(theirs)
            self.of_units += units.T @ units
            self.cosines[start:stop] = paired_cosines(ours, theirs)
            ours = ours - mean_one.astype(np.float32)
            theirs = theirs - mean_other.astype(np.float32)
            self.cross += ours.T @ theirs
            self.of_one += ours.T @ ours
            self.of_other += theirs.T @ theirs
            self.squares_one[start:stop] = squared_lengths(ours)
            self.squares_other[start:stop] = squared_lengths(theirs)

    def cka(self) -> float:
        """Linear CKA of the centred tables X and Y: |X'Y|^2 / (|X'X| |Y'Y|)."""
        scale = np.linalg.norm(self.of_one) * np.linalg.norm(self.of_other)
        return float(np.square(self.cross).sum() / scale) if scale else float("nan")

    def cka_debiased(self) -> float:
        """The same of unbiased estimates of the dependence (HSIC)."""
        if self.n < 4:
            return float("nan")
        cross = _unbiased(self.cross, self.squares_one, self.squares_other)
        of_one = _unbiased(self.of_one, self.squares_one, self.squares_one)
        of_other = _unbiased(self.of_other, self.squares_other, self.squares_other)
        if min(of_one, of_other) <= 0:
            return float("nan")
        return float(cross / np.sqrt(of_one * of_other))

    def directions(self, k: int) -> Float32[np.ndarray, "d k"]:
        """The `k` directions along which the second table's unit rows lie most, ascending."""
        _, vectors = np.linalg.eigh(self.of_units)
        return vectors[:, -k:].astype(np.float32)


def _unbiased(
    cross: Float64[np.ndarray, "d e"],
    ours: Float64[np.ndarray, " n"],
    theirs: Float64[np.ndarray, " n"],
) -> float:
    """Song et al.'s unbiased HSIC of linear kernels, of which `ours` and `theirs` are diagonals.

    Rows are centred, so that every row of a kernel sums to zero, and without its diagonal to minus
    that.
    """
    n = len(ours)
    both = (ours * theirs).sum()
    trace = np.square(cross).sum() - both
    sums = ours.sum() * theirs.sum() / ((n - 1) * (n - 2))
    return float((trace + sums - 2 * both / (n - 2)) / (n * (n - 3)))


def _comparison(moments: _Moments, lost: Bool[np.ndarray, " t"]) -> Comparison:
    known = moments.cosines[~np.isnan(moments.cosines)]
    if not len(known):
        raise BadPolicy("embeddings: every row of a table is zero; give trained models.")
    return Comparison(
        tokens=moments.n,
        without_direction=moments.n - len(known),
        cosine_mean=float(known.mean()),
        cosine_std=float(known.std()),
        cosine_min=float(known.min()),
        cka=moments.cka(),
        cka_debiased=moments.cka_debiased(),
        nearest=1 - float(lost.mean()),
    )


def _check_widths(one: Table, other: Table) -> None:
    if one.shape[1] != other.shape[1]:
        raise BadPolicy(
            f"embeddings: the tables have {one.shape[1]} and {other.shape[1]} features; compare a "
            "policy with the model that it was initialised from."
        )


def _unwatched(starts: Iterable[int], label: str) -> Iterable[int]:
    return starts
