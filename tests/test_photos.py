"""Real photos: three references of a subject pick its held-out photo out from among photos of two other subjects."""

import os
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from vap_core.base.types import Rgb
from vap_core.memory import load_photo, register
from vap_core.perception.embedded import encoder as embed
from vap_core.perception.embedded import proposer as detect
from vap_core.vote import similarity, vote

PHOTOS = Path(
    os.environ.get("VAP_PHOTOS", Path(__file__).resolve().parents[2] / "shared" / "photos")
)
KINDS = {
    "dog": ("dog", "dog2", "dog6"),
    "toy": ("duck_toy", "monster_toy", "robot_toy", "bear_plushie", "grey_sloth_plushie"),
}
"""Subjects of one kind are each other's distractors; the others face everyone."""

pytestmark = pytest.mark.skipif(
    not PHOTOS.is_dir(), reason=f"no photos at {PHOTOS}; set VAP_PHOTOS to their folder"
)


Rows = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def photos() -> dict[str, list[Rgb]]:
    return {
        folder.name: [load_photo(path) for path in sorted(folder.glob("*.jpg"))]
        for folder in sorted(PHOTOS.iterdir())
        if folder.is_dir()
    }


@pytest.fixture(scope="module")
def rows(photos: dict[str, list[Rgb]]) -> Rows:
    """Embeddings of the whole photos."""
    return {name: embed.load()(pictures) for name, pictures in photos.items()}


@pytest.fixture(scope="module")
def registered(photos: dict[str, list[Rgb]]) -> Rows:
    """Embeddings of the references as `register` cuts them with the shipped detector, which knows renders only."""
    return {
        name: register(name, category(name), pictures, detect.load(), embed.load())[0].embeddings
        for name, pictures in photos.items()
    }


def category(subject: str) -> str:
    return "dog" if subject.startswith("dog") else subject.replace("_", " ")


def rivals(subject: str, subjects: list[str]) -> list[str]:
    return next(
        ([s for s in kind if s != subject] for kind in KINDS.values() if subject in kind),
        [s for s in subjects if s != subject],
    )


def trials(rows: Rows, registered: Rows) -> Iterator[tuple[str, np.ndarray]]:
    """Per subject, choice of references and rivals: cosines (held-out photo, photo of a, photo of b; 3 candidates; K = 3)."""
    for subject, mine in rows.items():
        for chosen in combinations(range(len(mine)), 3):
            references = registered[subject][list(chosen)]
            own = similarity(np.delete(mine, chosen, axis=0), references)
            for a, b in combinations(rivals(subject, sorted(rows)), 2):
                first, second = similarity(rows[a], references), similarity(rows[b], references)
                shape = (len(own), len(first), len(second), 3)
                parts = own[:, None, None], first[None, :, None], second[None, None]
                yield (
                    subject,
                    np.stack([np.broadcast_to(part, shape) for part in parts], axis=-2).reshape(
                        -1, 3, 3
                    ),
                )


def winners(cosine: np.ndarray) -> np.ndarray:
    """`vote` for many elections at once."""
    votes = (cosine.argmax(axis=-2)[..., None] == np.arange(cosine.shape[-2])).sum(axis=-2)
    return np.where(
        votes == votes.max(axis=-1, keepdims=True), cosine.mean(axis=-1), -np.inf
    ).argmax(axis=-1)


@pytest.mark.parametrize("cut", ["whole", "registered"])
def test_the_right_instance_wins_on_photos(rows: Rows, registered: Rows, cut: str) -> None:
    right: dict[str, list[int]] = {}
    for subject, cosine in trials(rows, rows if cut == "whole" else registered):
        tally = right.setdefault(subject, [0, 0])
        tally[0] += int((winners(cosine) == 0).sum())
        tally[1] += len(cosine)
    n = sum(total for _, total in right.values())
    print(f"{cut}: right in {sum(won for won, _ in right.values()) / n:.4f} of {n}")
    assert n > 100_000
    assert sum(won for won, _ in right.values()) / n >= 0.95
    assert min(won / total for won, total in right.values()) >= 0.80, right


def test_the_vectorised_vote_is_the_vote(rows: Rows) -> None:
    rng = np.random.default_rng(0)
    _, cosine = next(trials(rows, rows))
    for i in rng.choice(len(cosine), 50):
        assert vote(cosine[i]).winner == winners(cosine[i][None])[0]
