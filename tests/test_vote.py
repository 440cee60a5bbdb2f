"""The vote against a slow readable reference, exact cases and properties."""

import inspect
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.toys import TOYS, MeanColour, personal, scene
from vap_core.attend import Attender
from vap_core.base.errors import BadEncoder, UnknownName
from vap_core.base.types import Boxes, Rgb
from vap_core.memory import remember
from vap_core.perception.candidates import Proposals
from vap_core.perception.protocols import Encoder
from vap_core.perception.references import choose_references
from vap_core.vote import compare, similarity, vote

cosines = st.integers(0, 2**31).flatmap(
    lambda seed: st.tuples(st.integers(1, 6), st.integers(1, 7)).map(
        lambda shape: np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32),
    )
)


def slow_vote(cosine: np.ndarray) -> int:
    """The paper's rule, written out."""
    votes = [0] * len(cosine)
    for k in range(cosine.shape[1]):
        votes[max(range(len(cosine)), key=lambda i: cosine[i, k])] += 1
    tied = [i for i in range(len(cosine)) if votes[i] == max(votes)]
    return max(tied, key=lambda i: np.mean(cosine[i].astype(np.float64)))


@given(cosines)
def test_equals_the_readable_reference(cosine: np.ndarray) -> None:
    assert vote(cosine).winner == slow_vote(cosine)


def test_another_rule_is_refused() -> None:
    with pytest.raises(UnknownName, match="vote: rule 'mean' is unknown; known: average, best, vo"):
        inspect.unwrap(vote)(np.ones((2, 3), np.float32), "mean")


@given(cosines, st.randoms(use_true_random=False))
def test_candidate_order_does_not_matter(cosine: np.ndarray, random: object) -> None:
    order = np.random.default_rng(random.randint(0, 99)).permutation(len(cosine))  # type: ignore[attr-defined]
    before, after = vote(cosine), vote(cosine[order])
    assert order[after.winner] == before.winner
    assert (after.votes == before.votes[order]).all()
    assert after.margin == before.margin


@given(cosines)
def test_reference_order_does_not_matter(cosine: np.ndarray) -> None:
    assert vote(cosine[:, ::-1].copy()).winner == vote(cosine).winner


@given(cosines)
def test_every_reference_votes_once(cosine: np.ndarray) -> None:
    ballot = vote(cosine)
    assert ballot.votes.sum() == cosine.shape[1]
    assert 0 <= ballot.margin <= 1


@given(
    arrays(
        np.float32,
        st.tuples(st.integers(1, 5), st.integers(1, 5)),
        elements=st.sampled_from([0.25, 0.5, 1.0]),
    )
)
def test_margin_and_ties_are_what_they_say(cosine: np.ndarray) -> None:
    ballot = vote(cosine)
    rest = np.delete(ballot.votes, ballot.winner)
    assert (
        ballot.margin
        == (ballot.votes[ballot.winner] - (rest.max() if len(rest) else 0)) / cosine.shape[1]
    )
    assert ballot.tied.any() == (np.count_nonzero(ballot.votes == ballot.votes.max()) > 1)


def test_orthogonal_distractor_never_wins() -> None:
    references = np.eye(4, dtype=np.float32)[:2]
    candidates = np.array([[0, 0, 1, 0], [0.6, 0.8, 0, 0], [0, 0, 0, 1]], np.float32)
    assert vote(similarity(candidates, references)).winner == 1


def test_tie_goes_to_the_higher_mean_cosine() -> None:
    ballot = vote(np.array([[0.9, 0.1], [0.2, 0.8], [0.5, 0.5]], np.float32))
    assert ballot.votes.tolist() == [1, 1, 0]
    assert ballot.tied.tolist() == [True, True, False]
    assert vote(np.array([[0.9, 0.1], [0.2, 0.9]], np.float32)).winner == 1


def test_votes_and_average_differ_where_they_should() -> None:
    cosine = np.array([[0.6, 0.6, 0.0], [0.5, 0.5, 0.9]], np.float32)
    assert vote(cosine, "vote").winner == 0
    assert vote(cosine, "average").winner == 1


def test_no_candidate_is_a_result() -> None:
    ballot = vote(np.zeros((0, 5), np.float32))
    assert ballot.winner is None
    assert ballot.margin == 0.0


def test_ten_thousand_candidates_are_no_trouble() -> None:
    cosine = np.random.default_rng(0).uniform(-1, 0.9, (10_000, 5)).astype(np.float32)
    cosine[7321] = 0.95
    ballot = vote(cosine)
    assert ballot.winner == 7321
    assert ballot.votes.sum() == ballot.votes[7321] == 5


def test_no_reference_is_a_mistake() -> None:
    with pytest.raises(ValueError, match="no references"):
        vote(np.zeros((2, 0), np.float32))


def test_similarity_is_cosine() -> None:
    a, b = np.array([[1, 0], [0, 1]], np.float32), np.array([[0.6, 0.8]], np.float32)
    assert similarity(a, b).tolist() == [[pytest.approx(0.6)], [pytest.approx(0.8)]]


def test_numbers_that_are_not_finite_elect_nothing() -> None:
    """An argmax over NaN would take the first candidate, whatever it is."""
    boxes = Boxes(
        np.array([[0, 0, 9, 9], [9, 9, 20, 20]], np.float32), np.ones(2, np.float32), "cup"
    )
    mine = personal("mine", "cup", (90, 90, 90))
    known = Proposals(boxes, np.repeat(mine.embeddings[:1], 2, axis=0))
    assert compare(mine, known, TOYS).max() == pytest.approx(1.0)
    broken = known.embeddings.copy()
    broken[1, 0] = np.nan
    with pytest.raises(BadEncoder, match="not finite; test it with pytest"):
        compare(mine, Proposals(boxes, broken), TOYS)


class Raw:
    """The mean colour, without the division by its length."""

    name = "raw"

    def __call__(self, crops: Sequence[Rgb]) -> np.ndarray:
        rows = [crop.reshape(-1, 3).mean(axis=0) for crop in crops]
        return np.array(rows, np.float32).reshape(-1, 3)


def test_rows_that_are_not_of_length_1_elect_nothing() -> None:
    """Every cosine would be cut to 1, and the first candidate would win."""
    views = {"front": scene([(4, 4, (200, 30, 30)), (30, 30, (30, 30, 200))])}
    memory = {"mug": personal("mug", "cup", (30, 30, 200), (32, 32, 190))}
    stack = TOYS.with_parts("mine", encoder=Raw())
    with pytest.raises(
        BadEncoder, match=r"'raw' gave a row of length \S+, not of length 1; test it"
    ):
        Attender(stack, memory).start(views, "bring my cup")
    mine = memory["mug"]
    boxes = Boxes(np.array([[0, 0, 9, 9]], np.float32), np.ones(1, np.float32), "cup")
    nearly = Proposals(boxes, mine.embeddings[:1] * np.float32(1.0005))
    assert compare(mine, nearly, TOYS).max() == pytest.approx(1.0)


class Returns(MeanColour):
    """Its rows in another form."""

    def __init__(self, change: Callable[[np.ndarray], object]) -> None:
        self.change = change

    def __call__(self, crops: Sequence[Rgb]) -> Any:
        return self.change(super().__call__(crops))


PHOTOS = [scene([(4, 4, (200, 30, 30))]), scene([(30, 30, (200, 30, 30))])]


def remembering(encoder: Encoder) -> None:
    remember("mug", "cup", PHOTOS, encoder)


def choosing(encoder: Encoder) -> None:
    choose_references(PHOTOS, "cup", TOYS.detector, encoder)


def attending(encoder: Encoder) -> None:
    memory = {"mug": personal("mug", "cup", (200, 30, 30))}
    stack = TOYS.with_parts("mine", encoder=encoder)
    Attender(stack, memory).start({"front": PHOTOS[0]}, "bring my cup")


@pytest.mark.parametrize("ask", [remembering, choosing, attending])
@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (
            lambda rows: rows.astype(np.float64),
            r"ndarray float64 \(\d, 3\), not ndarray float32 \(\d crops, width\)",
        ),
        (
            lambda rows: rows.astype(np.float16),
            r"ndarray float16 \(\d, 3\), not",
        ),
        (lambda rows: rows.tolist(), "list, not ndarray"),
        (lambda rows: memoryview(rows), r"memoryview  \(\d, 3\), not ndarray"),
        (np.ma.masked_array, r"MaskedArray float32 \(\d, 3\), not"),
        (lambda rows: None, "NoneType, not ndarray"),
        (lambda rows: rows.ravel(), r"ndarray float32 \(\d+,\), not"),
        (lambda rows: rows[:-1], r"ndarray float32 \(\d, 3\), not ndarray float32 \(\d crops"),
        (lambda rows: 0 * rows, "a row of length 0, not of length 1"),
    ],
)
def test_rows_of_another_form_are_one_line(
    ask: Callable[[Encoder], None], change: Callable[[np.ndarray], object], fault: str
) -> None:
    with pytest.raises(BadEncoder, match=f"'mean-colour' gave {fault}") as caught:
        ask(Returns(change))
    assert "\n" not in str(caught.value)
    assert "--encoder MODULE:NAME" in str(caught.value)


def test_rows_of_another_width_are_one_line() -> None:
    """A memory of an encoder that has kept its name."""
    boxes = Boxes(np.array([[0, 0, 9, 9]], np.float32), np.ones(1, np.float32), "cup")
    wide = Proposals(boxes, np.full((1, 4), 0.5, np.float32))
    with pytest.raises(BadEncoder, match="gave 4 numbers a crop, and 3 for the references; test"):
        compare(personal("mine", "cup", (90, 90, 90)), wide, TOYS)
