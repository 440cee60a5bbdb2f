"""A learned word: only its embedding is trained, it tells what the model can see, and it is spoken to a policy whose weights stay."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from vap_core.base.errors import BadMemory, BadPolicy
from vap_core.base.types import Rgb
from vap_core.policies.lerobot.adapter import load_policy
from vap_core.policies.mini_pi0 import learned_token
from vap_core.policies.mini_pi0.learned_token import (
    SUFFIX,
    WORD,
    Photos,
    Token,
    TokenTraining,
    answers,
    augment,
    learn,
)
from vap_core.policies.mini_pi0.vlm import MiniVlm, load_vlm
from vap_core.policies.protocol import PolicyInput
from vap_make.policy.train import initialise_policy
from vap_make.words import vocabulary

from .test_mini_pi0 import checkpoint, config  # noqa: F401

SIDE = 64


@pytest.fixture(scope="module")
def vlm() -> MiniVlm:
    """A tiny model that has learned what red and blue are."""
    rng = np.random.default_rng(9)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = MiniVlm(config())
    optimiser = torch.optim.AdamW(model.parameters(), 3e-3)
    for _ in range(300):
        shown = photos(rng, 8)
        views = (
            torch.from_numpy(np.stack([*shown.own, *shown.rivals])).permute(0, 3, 1, 2).float()
            / 255
        )
        colours = rng.choice(["red", "blue"], 16)
        tokens, there = model.tokenize(
            [f"can you recognize the {colour} cup in this image" for colour in colours]
        )
        right = [
            model.vocabulary["yes" if (i < 8) == (colour == "red") else "no"]
            for i, colour in enumerate(colours)
        ]
        said, _ = model(model.embed_images(views), tokens, there, torch.tensor(right)[:, None])
        loss = torch.nn.functional.cross_entropy(said[:, 0], torch.tensor(right))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert loss < 0.1
    return model.eval().requires_grad_(False)


def photos(rng: np.random.Generator, n: int) -> Photos:
    """Red discs, blue discs, noise."""

    def disc(colour: tuple[int, int, int]) -> Rgb:
        y, x = np.mgrid[:SIDE, :SIDE]
        out = rng.integers(100, 140, (SIDE, SIDE, 3)).astype(np.uint8)
        out[(x - 32) ** 2 + (y - 32) ** 2 < 400] = colour
        return out

    noise = tuple(rng.integers(0, 256, (SIDE, SIDE, 3)).astype(np.uint8) for _ in range(n))
    return Photos(
        tuple(disc((230, 20, 20)) for _ in range(n)),
        tuple(disc((20, 20, 230)) for _ in range(n)),
        noise,
    )


def test_one_embedding_is_learned_and_nothing_else_moves(vlm: MiniVlm) -> None:
    before, rng = vlm.sha256(), np.random.default_rng(0)
    taught, unseen = photos(rng, 6), photos(rng, 6)
    token = learn(vlm, "disc", taught, unseen, TokenTraining(epochs=40, augmentations=3, rate=0.05))
    assert vlm.sha256() == before == token.model
    assert token.embedding.shape == (32,)
    assert token.accuracy > 0.95
    one, again = (
        learn(vlm, "disc", taught, unseen, TokenTraining(epochs=2, augmentations=3)) for _ in "ab"
    )
    assert np.array_equal(again.embedding, one.embedding)


def test_what_cannot_be_told_apart_is_not_learned(vlm: MiniVlm) -> None:
    """Own photos and its rivals' are drawn alike: no word tells new ones apart, though each half may be guessed."""
    rng = np.random.default_rng(1)
    one, two, three, four = (photos(rng, 8).own for _ in range(4))
    token = learn(
        vlm,
        "disc",
        Photos(one, two, ()),
        Photos(three, four, ()),
        TokenTraining(epochs=4, augmentations=2),
    )
    assert token.accuracy < 0.85


def test_crops_of_different_sizes_are_asked_about_together_as_each_alone(vlm: MiniVlm) -> None:
    """Two cameras see an object at two sizes."""
    rng = np.random.default_rng(4)
    crops = [rng.integers(0, 256, (side, side, 3)).astype(np.uint8) for side in (50, 90, 64)]
    embedding = rng.normal(size=vlm.config.width).astype(np.float32)
    together = answers(vlm, embedding, crops)
    alone = [answers(vlm, embedding, [crop])[0] for crop in crops]
    assert np.allclose(together, alone, atol=1e-5)
    assert len(set(np.round(together, 4))) > 1


def test_photos_of_both_kinds_are_needed(vlm: MiniVlm) -> None:
    some = photos(np.random.default_rng(2), 4)
    with pytest.raises(BadMemory, match="needed"):
        learn(vlm, "disc", Photos(some.own, (), ()), some)


def test_framing_keeps_size_and_type() -> None:
    photo = photos(np.random.default_rng(3), 1).own[0]
    out = augment(photo, np.random.default_rng(0))
    assert out.shape == photo.shape
    assert out.dtype == np.uint8
    assert not np.array_equal(out, photo)


@pytest.mark.parametrize("h_w", [(100, 200), (200, 100)])
def test_an_oblong_photo_keeps_both_halves(h_w: tuple[int, int]) -> None:
    photo = np.zeros((*h_w, 3), np.uint8)
    photo[-70:-30, -70:-30] = 255
    for seed in range(5):
        out = augment(photo, np.random.default_rng(seed))
        assert out.shape == photo.shape
        assert (out > 0).mean() > 0.01


def test_a_token_comes_back_from_disk_for_its_own_model_only(tmp_path: Path) -> None:
    token = Token("red-mug", np.arange(4, dtype=np.float32), 0.96875, "f" * 64)
    path = learned_token.save(tmp_path, token)
    back = learned_token.load(tmp_path, "red-mug", "f" * 64)
    assert (back.object, back.accuracy, back.model) == (token.object, token.accuracy, token.model)
    assert np.array_equal(back.embedding, token.embedding)
    with pytest.raises(BadMemory, match="learned in model ffffffff"):
        learned_token.load(tmp_path, "red-mug", "e" * 64)
    with pytest.raises(BadMemory, match="no learned word"):
        learned_token.load(tmp_path, "blue-mug", "f" * 64)
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(BadMemory, match="no learned word"):
        learned_token.load(tmp_path, "red-mug", "f" * 64)
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"object": "blue-mug"}, "is the word of 'blue-mug', not of 'red-mug'"),
        ({"embedding": np.array([1.0, np.nan], np.float32)}, "has numbers that are not finite"),
        ({"accuracy": 7.0}, "has an accuracy of 7, not from 0 to 1"),
        ({"accuracy": float("nan")}, "has an accuracy of nan, not from 0 to 1"),
    ]
    for change, said in wrong:
        learned_token.save(tmp_path, replace(token, **change)).rename(path)
        with pytest.raises(BadMemory, match=said):
            learned_token.load(tmp_path, "red-mug", "f" * 64)
    assert path.name == f"red-mug{SUFFIX}"
    saved = {learned_token.save(tmp_path, token).read_bytes() for _ in range(6)}
    assert len(saved) == 1
    deep = b"[" * 100_000
    path.write_bytes(len(deep).to_bytes(8, "little") + deep)
    with pytest.raises(BadMemory, match="no learned word"):
        learned_token.load(tmp_path, "red-mug", "f" * 64)


def test_a_policy_hears_the_word_and_its_weights_stay(checkpoint: Path) -> None:  # noqa: F811
    policy = load_policy(checkpoint)
    before, rng = policy.sha256(), np.random.default_rng(0)
    spoken = policy.with_tokens({WORD: rng.normal(size=32).astype(np.float32)})
    seen = rng.integers(0, 256, (64, 64, 3)).astype(np.uint8)
    state = policy.start(np.random.default_rng(0))

    def act(who: object, text: str) -> np.ndarray:
        return who.plan([state], [PolicyInput({"front": seen}, text, np.zeros(13, np.float32))])[1][
            0
        ]

    plain = act(policy, f"pick up {WORD}")
    assert not np.allclose(act(spoken, f"pick up {WORD}"), plain, atol=1e-6)
    assert np.array_equal(act(spoken, "pick up the cup"), act(policy, "pick up the cup"))
    assert np.array_equal(act(policy, f"pick up {WORD}"), plain)
    towers = policy.policy.model.paligemma_with_expert
    own = towers.embed_language_tokens(torch.tensor(vocabulary().index(WORD))).detach().numpy()
    assert np.array_equal(act(policy.with_tokens({WORD: own}), f"pick up {WORD}"), plain)
    assert policy.sha256() == before
    with pytest.raises(BadPolicy, match="no word <mine>"):
        policy.with_tokens({"<mine>": np.zeros(32, np.float32)})
    for width in (1, 7):
        with pytest.raises(BadPolicy, match=f"has {width} numbers, and those of .* have "):
            policy.with_tokens({WORD: np.zeros(width, np.float32)})


def test_the_model_answers_after_a_round_trip_and_a_policy_grows_from_it(
    vlm: MiniVlm,
    tmp_path: Path,
    checkpoint: Path,  # noqa: F811
) -> None:
    vlm.save(tmp_path)
    back, looks = load_vlm(tmp_path), torch.rand(3, 3, SIDE, SIDE)
    asked = ["where is the red cup", "is there a cup in this image", "what colour is the cup"]
    assert back.sha256() == load_vlm(tmp_path).sha256()
    kept = back.towers.state_dict()
    assert all(
        torch.equal(kept[name], tensor.bfloat16().float())
        for name, tensor in vlm.towers.state_dict().items()
    )
    assert all(word in vocabulary() for answer in back.answer(looks, asked) for word in answer)
    policy = load_policy(checkpoint).policy
    initialise_policy(back, policy)
    grown = policy.state_dict()
    assert all(
        torch.equal(tensor, grown[f"model.paligemma_with_expert.{name}"])
        for name, tensor in kept.items()
        if name.startswith("paligemma")
    )
    with pytest.raises(BadPolicy, match=r"./vap train vlm"):
        load_vlm(tmp_path / "nothing")


def test_an_answer_does_not_hear_what_comes_after_it(vlm: MiniVlm) -> None:
    """Prefix attention: the first word depends on view and question alone, and padding changes nothing."""
    looks, (asked, there) = (
        vlm.embed_images(torch.rand(1, 3, SIDE, SIDE)),
        vlm.tokenize(["where is the red cup"]),
    )
    one, two = (vlm(looks, asked, there, torch.tensor([[5, word, 7]]))[0] for word in (8, 9))
    assert torch.allclose(one[:, :2], two[:, :2], atol=1e-5)
    assert not torch.allclose(one[:, 2], two[:, 2], atol=1e-3)
    pad = torch.nn.functional.pad(asked, (0, 4)), torch.nn.functional.pad(there, (0, 4))
    assert torch.allclose(vlm(looks, *pad, torch.tensor([[5, 8, 7]]))[0], one, atol=1e-4)
