"""The one picture of a vote: its rows, its dots, its frame, and the words below it."""

from dataclasses import replace

import numpy as np
import pytest

from tests.drawn import K, draw, ground, rig
from vap_core.base.pictures import (
    LOOKALIKES,
    TARGET,
    result_line,
    rgb8,
    shown_candidates,
    vote_picture,
)
from vap_core.base.types import election_scores
from vap_core.vote import vote

CAMERA = rig(0, 1)[0]
RGB, _ = draw(CAMERA, 0)
CELL = 40


def picture(yours: int | None = None, photos: int = K, winner: int | None = 0) -> np.ndarray:
    grounding = replace(ground(CAMERA), winner=winner)
    references = [np.full((9, 12, 3), 200, np.uint8)] * photos
    return vote_picture(grounding, RGB, references, yours=yours, cell_px=CELL)


def test_a_row_for_each_candidate_a_column_for_each_photo() -> None:
    drawn = picture()
    assert drawn.shape == (18 + CELL + 3 * CELL + CELL, CELL + K * CELL + 92, 3)
    framed = (drawn == rgb8(TARGET)).all(axis=2)
    assert framed[18 : 18 + CELL].any(axis=0).sum() == K * (CELL - 8), "a frame around each photo"
    assert not framed[18 + CELL :].any(), "orange is the target's photos alone"


@pytest.mark.parametrize("proof", [None, (-0.2, -0.1, 0.0)])
def test_every_photo_votes_once_in_the_row_that_the_vote_counted(
    proof: tuple[float, ...] | None,
) -> None:
    """What points prove may take a vote from the highest cosine."""
    grounding = ground(CAMERA)
    if proof is not None:
        boxes = replace(grounding.candidates, proof=np.array(proof, np.float32))
        ballot = vote(election_scores(grounding.similarity, boxes))
        assert ballot.votes.tolist() != grounding.ballot.votes.tolist()
        winner = ballot.winner
        grounding = replace(grounding, candidates=boxes, ballot=ballot, winner=winner)
    drawn = vote_picture(grounding, RGB, [np.full((9, 12, 3), 200, np.uint8)] * K, cell_px=CELL)
    dots = (drawn == rgb8(LOOKALIKES[0])).all(axis=2)
    for place, i in enumerate(shown_candidates(grounding)):
        y = 18 + CELL + place * CELL
        seen = [dots[y : y + CELL, CELL + j * CELL :][:, :CELL].any() for j in range(K)]
        assert sum(seen) == grounding.ballot.votes[i]
        assert seen == (grounding.voted == i).tolist()


def test_the_elected_row_is_white_and_says_whether_it_is_right() -> None:
    unknown, right, wrong = picture(), picture(yours=0), picture(yours=2)
    row = slice(18 + CELL, 18 + 2 * CELL)
    for drawn in (unknown, right, wrong):
        assert (drawn[row, 2] == 255).all(axis=1).mean() > 0.8
    assert (unknown != right).any()
    assert (right != wrong).any()
    assert (unknown[row.stop :] == right[row.stop :]).all(), "nothing else changes"
    orange = (wrong == rgb8(TARGET)).all(axis=2)
    assert orange[row.stop :].any(), "the row that would have been right is marked"
    assert not (picture(winner=None)[row, 2] == 255).all(axis=1).any(), "nothing is elected"


def test_it_is_drawn_without_photos_and_without_candidates() -> None:
    assert picture(photos=0).shape[0] < picture().shape[0]
    empty = vote_picture(ground(CAMERA, none=True), RGB, [], cell_px=CELL)
    assert empty.std() > 5
    assert result_line(ground(CAMERA, none=True)).startswith("nothing is elected")


@pytest.mark.parametrize(("winner", "first"), [(0, 0), (2, 2), (None, 0)])
def test_the_elected_candidate_comes_first(winner: int | None, first: int) -> None:
    grounding = replace(ground(CAMERA), winner=winner)
    assert shown_candidates(grounding)[0] == first
    if winner == 2:
        assert result_line(grounding).startswith(
            "#2 is chosen, against the vote for #0: votes 4 of 5"
        )
    if winner == 0:
        assert result_line(grounding) == "#0 elected: votes 4 of 5, lead +0.12"
