"""Demonstrations show generic objects only, the same ones every time; a command says what its picture shows."""

import itertools
import re
from collections import Counter
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file
from torch.nn import functional as F  # noqa: N812

from vap_core import describe
from vap_core.errors import BadOutput, BadPolicy
from vap_core.policies.checkpoints import fingerprint
from vap_core.policies.lerobot import load
from vap_core.policies.mini_pi0.modeling_mini_pi0 import MiniPI0Policy, fused
from vap_core.policies.mini_pi0.vlm import load as load_vlm
from vap_core.prompt import PALETTE, looks_like
from vap_core.sim import objects
from vap_core.suites import BENCHMARKS, suite
from vap_core.training import demonstrations, policy, vlm
from vap_core.training.commands import command, near, painted, rough, say, tinted
from vap_core.training.dataset import data_sha256
from vap_core.training.demonstrations import PARTS, SIDE, Film, after_a_miss, cached, cast, row
from vap_core.training.questions import LEAST_PX, ask, place
from vap_core.training.words import PAINTS, akin, looks, phrases, vocabulary

SUITE = "simpler-bridge"


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Film]]:
    folder = tmp_path_factory.mktemp("films")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demonstrations, "EPISODES", 2)
        return folder, cached(folder, SUITE, 0, 1)


def test_a_film_shows_a_generic_target_from_first_to_last_action(stage: tuple[Path, list[Film]]) -> None:
    _, films = stage
    assert films
    for film in films:
        steps = len(film.action)
        assert film.images.shape == (steps, 1, SIDE, SIDE, 3)
        assert film.action.shape[1] == 7
        assert film.names[film.goal] == suite(SUITE).task(film.task).goal
        assert {objects.get(name).split for i, name in enumerate(film.names) if i != film.goal} == {"generic"}
        seen = (film.ids == 1).sum((1, 2, 3))
        assert (seen.max() if after_a_miss(film) else seen[0]) > 30, "the target is in view; a hand that missed may hide it at first"
        assert np.linalg.norm(film.places[-1, 0] - film.places[0, 0]) > 0.03, "and is moved"
        still = np.linalg.norm(film.places[-1, 1:] - film.places[0, 1:], axis=1)
        assert np.delete(still, film.goal - 1).max() < 0.03, "its rivals are not"


def test_films_are_kept_and_come_again_alike(stage: tuple[Path, list[Film]], monkeypatch: pytest.MonkeyPatch) -> None:
    folder, films = stage
    (path,) = folder.glob("*.npz")
    before = path.stat().st_mtime_ns
    kept = cached(folder, SUITE, 0, 1)
    assert path.stat().st_mtime_ns == before
    monkeypatch.setattr(demonstrations, "EPISODES", 2)
    for one, other, again in zip(films, kept, demonstrations.films(SUITE, 0, 1), strict=True):
        for part in PARTS:
            assert np.array_equal(getattr(one, part), getattr(other, part))
            assert np.array_equal(getattr(one, part), getattr(again, part))


def test_fewer_pictures_of_the_same_film_teach_the_same(stage: tuple[Path, list[Film]], monkeypatch: pytest.MonkeyPatch) -> None:
    """A suite may keep every third picture: the film is the same otherwise, and a step that has one is told and answered as before."""
    _, whole = stage
    monkeypatch.setattr(demonstrations, "EPISODES", 2)
    before = [command(film, t, SUITE, np.random.default_rng(t)) for film in whole for t in range(0, len(film.action), 3)]
    monkeypatch.setattr(demonstrations, "EVERY", {SUITE: 3})
    films = demonstrations.films(SUITE, 0, 1)
    for film, all_of_it in zip(films, whole, strict=True):
        fewer = replace(all_of_it, images=all_of_it.images[::3], ids=all_of_it.ids[::3])
        assert all(np.array_equal(getattr(film, part), getattr(fewer, part)) for part in PARTS)
    after = [command(film, t, SUITE, np.random.default_rng(t)) for film in films for t in range(0, len(film.action), 3)]
    for one, other in zip(before, after, strict=True):
        assert (one.text, one.way) == (other.text, other.way)
        assert np.array_equal(one.images, other.images)
    recipe = policy.Recipe(SUITE, batch=64)
    config, stats = policy.configuration(recipe, films[0].state.shape[1], 7), policy.statistics(films)
    made = policy.collate(recipe, films, stats, np.random.default_rng(0), config)
    scaled = [(film.state - stats["observation.state"]["mean"].numpy()) / stats["observation.state"]["std"].numpy() for film in films]
    shown = np.concatenate([part[::3] for part in scaled])
    assert all((np.abs(shown - state.numpy()).max(axis=1) < 1e-4).any() for state in made.state), "only steps with a picture are learned from"


def test_a_film_can_begin_where_a_grasp_has_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Low beside the target, empty; then up with an open gripper, and a second grasp that succeeds."""
    monkeypatch.setattr(demonstrations, "EPISODES", 3)
    begun = {}
    for share in (0.0, 1.0):
        monkeypatch.setattr(demonstrations, "MISSES", share)
        begun[share] = demonstrations.films(SUITE, 0, 0)
    for first, missed in itertools.product(begun[0.0], begun[1.0]):
        assert missed.state[0, 2] < first.state[0, 2] - 0.08
        assert missed.action[:3, 2].sum() > 0.04 > 0.0 > first.action[:3, 2].sum()
        assert missed.action[2, -1] == 1.0
        assert missed.action[-1, -1] == pytest.approx(first.action[-1, -1])


def test_casts_are_generic_and_of_one_category() -> None:
    for known in BENCHMARKS.values():
        for task in known.tasks:
            for i in range(6):
                names = cast(known, task, np.random.default_rng(i))
                things = names[: len(names) - bool(task.goal)]
                assert {objects.get(name).category for name in things} == {task.category}
                assert {objects.get(name).split for name in things} == {"generic"}
                assert len(set(names)) == len(names) > 1


def test_every_stage_finds_room_for_its_objects() -> None:
    """Cameras beside a plate once found none in half of the stages, and so were hardly in the films."""
    for known in BENCHMARKS.values():
        for n, task in enumerate(known.tasks * 3):
            rng = np.random.default_rng([5, n])
            names = cast(known, task, rng)
            placed = row(known, task, names, n, "base", rng).placements
            assert {one.model for one in placed} == set(names)
            for one, other in itertools.combinations(placed, 2):
                wide = sum(max(objects.extent_m(objects.get(each.model))[:2]) / 2 for each in (one, other))
                assert np.hypot(one.x - other.x, one.y - other.y) > wide - 0.005, (known.name, names)


def test_a_command_says_what_its_picture_shows(stage: tuple[Path, list[Film]]) -> None:
    _, films = stage
    words, ways = set(vocabulary()), Counter[str]()
    for seed in range(160):
        film, rng = films[seed % len(films)], np.random.default_rng(seed)
        t = int(rng.integers(len(film.action)))
        made = command(film, t, SUITE, rng)
        ways[made.way] += 1
        assert set(re.findall(r"[\w']+", made.text.lower())) <= words
        mask, rivals = film.ids[t, 0] == 1, [i for i in range(1, len(film.names)) if i != film.goal]
        mine, *others = (looks(film.names[i]) for i in (0, *rivals))
        if made.way == "plain":
            assert near(film, t, SUITE, rivals)
        elif made.way == "described":
            said = [word for word in (*mine.difference(*others), *phrases(film.names[0])) if f" {word}" in made.text]
            assert said
            assert mine.difference(*others)
        else:
            colour = max((colour for colour in PAINTS if f" {colour.name}" in made.text), key=lambda colour: len(colour.name))
            assert made.way == "painted" or colour in PALETTE
            assert not any(akin(colour.name) & other for other in others)
            if colour in PALETTE and mask.sum() > 60:
                assert looks_like(made.images[0][mask], colour).mean() > 0.15, made.text
    assert min(ways[way] for way in ("tinted", "painted", "described", "plain")) > 5


def test_my_is_said_of_a_generic_thing_too_and_once() -> None:
    rng, task = np.random.default_rng(0), BENCHMARKS["simpler-bridge"].task("put-camera")
    said = {say(task, "", rng) for _ in range(40)}
    assert said == {f"put {word} camera on the plate" for word in ("my", "the", "a")}
    said = {say(task, "blue", rng) for _ in range(40)}
    assert said == {"put the blue camera on the plate", "put my camera on the plate. My camera is blue."}


@settings(max_examples=25)
@given(st.integers(0, 2**16), st.floats(0.1, 1.0))
def test_only_what_is_masked_changes_colour(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    images, masks = rng.integers(0, 256, (2, 12, 12, 3), np.uint8), rng.random((2, 12, 12)) < 0.3
    for change in (tinted, painted):
        out = change(images, masks, PALETTE[seed % len(PALETTE)], share)
        assert (out[~masks] == images[~masks]).all()
    exact = (1 - share) * images[masks].astype(np.float32) + share * np.asarray(PALETTE[0].rgb, np.float32)
    assert np.abs(tinted(images, masks, PALETTE[0], share)[masks] - exact).max() <= 0.51
    empty = np.zeros((12, 12), bool)
    assert not rough(empty, rng).any()


def test_a_training_that_was_stopped_ends_like_one_that_was_not(
    stage: tuple[Path, list[Film]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, _ = stage
    monkeypatch.setattr(demonstrations, "EPISODES", 2)
    monkeypatch.setattr(policy, "HELD_OUT", 2)
    recipe = policy.Recipe(SUITE, stages=2, steps=3, batch=3, draws=2, width=32, depth=2, vision_width=32, vision_depth=1, expert_width=32)
    whole = policy.train(recipe, tmp_path / "whole", cache=folder)
    first = policy.train(recipe, tmp_path / "torn", cache=folder, minutes=0.0)
    assert [line["step"] for line in first["log"]] == [1]
    policy.train(recipe, tmp_path / "torn", cache=folder)
    one, other = (load_file(tmp_path / name / "model.safetensors") for name in ("whole", "torn"))
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert set(whole["held_out"]) == {"flow", "heat", "where", "hit", "goal_where", "goal_hit"}
    assert whole["data_sha256"] == data_sha256([film for n in range(2) for film in cached(folder, SUITE, 0, n)])
    with pytest.raises(BadOutput, match="another recipe or other data"):
        policy.train(replace(recipe, rate=0.1), tmp_path / "torn", cache=folder)
    trained = load(tmp_path / "whole")
    assert trained.execute == 4
    assert (trained.action_size, set(trained.wanted)) == (7, {"observation.images.front", "observation.state"})


def test_training_hears_every_word_that_the_captioner_says() -> None:
    names = [objects.generic(kind, i).name for kind in ("cup", "camera", "vase", "slipper") for i in range(120)]
    heard = {word for name in names for phrase in phrases(name) for word in re.findall(r"\w+", phrase)}
    heard |= {colour.name for colour in PAINTS}
    assert set(describe.WORDS) <= heard, set(describe.WORDS) - heard
    assert heard <= set(vocabulary())


def test_questions_are_true_of_their_views(stage: tuple[Path, list[Film]]) -> None:
    _, films = stage
    known, ends = set(vocabulary()), Counter[tuple[str, ...]]()
    for seed in range(150):
        film, rng = films[seed % len(films)], np.random.default_rng(seed)
        t = int(rng.integers(len(film.action)))
        asked = ask(film.images[t, 0], film.ids[t, 0], film.names, 3, rng)
        assert asked.image.shape == film.images[t, 0].shape
        for question in asked.questions:
            assert set(re.findall(r"[\w']+", question.text.lower())) | set(question.answer) <= known, question.text
            kind = objects.get(film.names[question.target]).category if question.target >= 0 else ""
            assert kind in question.text
            if question.answer == ("no",):  # nothing in view is of that kind and called so
                asked_for = question.text.removeprefix("is there a ").removeprefix("can you recognize the ").removesuffix(" in this image")
                assert not any(asked_for in (objects.get(name).category, *(f"{word} {objects.get(name).category}" for word in looks(name)))
                               for i, name in enumerate(film.names) if (film.ids[t, 0] == i + 1).sum() >= LEAST_PX)  # fmt: skip
            ends[question.answer[:1] if question.answer[:1] in (("yes",), ("no",)) else (question.text.split()[0],)] += 1
            if question.text.startswith("where"):
                assert question.answer == place(film.ids[t, 0] == question.target + 1)
            if question.answer == ("no",):
                assert question.target == -1
    assert min(ends[key] for key in (("yes",), ("no",), ("where",), ("put",))) > 20
    assert 0.5 < ends["yes",] / ends["no",] < 1.6


def test_a_vision_language_model_learns_and_resumes(stage: tuple[Path, list[Film]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, films = stage
    pool = [vlm.View(film.images[t, 0], film.ids[t, 0], film.names) for film in films for t in range(0, len(film.action), 6)]
    monkeypatch.setattr(vlm, "views", lambda *args, **kwargs: pool)
    recipe = vlm.Recipe(stages=1, steps=3, batch=4, width=32, depth=2, vision_width=32, vision_depth=1, expert_width=32)
    whole = vlm.train(recipe, tmp_path / "whole")
    vlm.train(recipe, tmp_path / "torn", minutes=0.0)
    vlm.train(recipe, tmp_path / "torn")
    one, other = (load_vlm(tmp_path / name).sha256() for name in ("whole", "torn"))
    assert one == other
    assert {"words", "heat", "hit", "where", "yes", "no"} <= set(whole["held_out"])
    grown = policy.Recipe(SUITE, stages=1, steps=1, batch=2, draws=1, width=32, depth=2, vision_width=32, vision_depth=1, expert_width=32)
    monkeypatch.setattr(demonstrations, "EPISODES", 2)
    about = policy.train(grown, tmp_path / "policy", vlm=tmp_path / "whole", cache=stage[0])
    assert about["vlm"] == one == load(tmp_path / "policy").policy.config.vlm  # type: ignore[union-attr]
    further = policy.train(replace(grown, rate=0.0), tmp_path / "further", start=tmp_path / "policy", cache=stage[0])
    assert further["vlm"] == one
    assert further["start"]["sha256"] == fingerprint(tmp_path / "policy")
    assert further["start"]["recipe"] == about["recipe"]
    first, second = (load_file(tmp_path / name / "model.safetensors") for name in ("policy", "further"))
    assert all(torch.equal(first[name], second[name]) for name in first)
    other = policy.Learner(replace(policy.configuration(grown, 13, 7), words=("a", "b"))).policy
    with pytest.raises(BadPolicy, match="no mini-pi0 with the same words"):
        policy.go_on(tmp_path / "policy", other)
    (tmp_path / "policy" / "training.json").write_text('{"recipe": ')
    with pytest.raises(BadPolicy, match="training.json is damaged"):
        policy.train(grown, tmp_path / "another", start=tmp_path / "policy", cache=stage[0])


def test_frames_close_to_a_turn_of_the_gripper_a_miss_or_the_end_come_more_often(stage: tuple[Path, list[Film]]) -> None:
    _, films = stage
    action = np.ones((40, films[0].action.shape[1]), np.float32)
    action[15:, -1] = 0.2
    rest = {part: np.repeat(getattr(films[0], part)[:1], 40, axis=0) for part in ("images", "ids", "state", "places")}
    chances = policy.emphasis(replace(films[0], action=action, **rest), 3.0)
    assert set(np.flatnonzero(chances == 3.0)) == {*range(11, 20), *range(35, 40)}
    assert set(np.flatnonzero(chances == 1.0)) == {*range(11), *range(20, 35)}
    thirds = policy.emphasis(replace(films[0], action=action, **rest), 3.0, 3)
    assert [3 * int(i) for i in np.flatnonzero(thirds == 3.0)] == [*range(3, 40, 3)]
    low = {**rest, "state": rest["state"].copy()}
    low["state"][0, 2] -= 0.1
    after_a_miss = policy.emphasis(replace(films[0], action=action, **low), 3.0)
    assert set(np.flatnonzero(after_a_miss != chances)) == {*range(5)}


def test_waiting_is_not_taught_but_for_the_end(stage: tuple[Path, list[Film]]) -> None:
    _, films = stage
    rest = {part: np.repeat(getattr(films[0], part)[:1], 40, axis=0) for part in ("images", "ids", "state", "places")}
    rest["state"][:, 0] += 0.01 * np.arange(40)
    action = np.ones((40, films[0].action.shape[1]), np.float32)
    action[20:24, :-1] = action[36:, :-1] = 0.0
    still = {**rest, "state": rest["state"].copy()}
    still["state"][20:25], still["state"][36:] = rest["state"][20], rest["state"][36]
    assert list(np.flatnonzero(policy.waits(replace(films[0], action=action, **still)))) == [20, 21, 22, 23]
    assert not policy.waits(replace(films[0], action=action, **rest)).any(), "something happens"
    closing = action.copy()
    closing[21:, -1] = 0.0
    assert list(np.flatnonzero(policy.waits(replace(films[0], action=closing, **still)))) == [20, 22, 23], "it asks for something"
    chances, shown = (policy.emphasis(replace(films[0], action=action, **part), 3.0) for part in (still, rest))
    assert (chances[20:24] == 0).all()
    assert (np.delete(chances, range(20, 24)) == np.delete(shown, range(20, 24))).all()
    waiting = replace(films[0], action=closing, **still)
    assert (policy.ahead(waiting, 18, 5) == closing[[18, 19, 21, 24, 25]]).all(), "the chunk goes on behind the wait, from the closed jaw"
    assert (policy.ahead(waiting, 18, 2) == closing[18:20]).all()
    assert (policy.ahead(waiting, 38, 4)[:, :-1] == 0).all()
    assert (policy.ahead(waiting, 38, 4)[:, -1] == closing[-1, -1]).all()


def small_policy(films: list[Film], batch: int, depth: int = 2) -> tuple[MiniPI0Policy, policy.Questions, policy.Batch]:
    """An untrained policy of the smallest sizes, the questions beside it, and one batch of so many frames."""
    recipe = policy.Recipe(SUITE, batch=batch, draws=2, width=32, depth=depth, vision_width=32, vision_depth=1, expert_width=32)
    config = policy.configuration(recipe, films[0].state.shape[1], films[0].action.shape[1])
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model, asked = MiniPI0Policy(config), policy.Questions(recipe.width)
    return model, asked, policy.collate(recipe, films, policy.statistics(films), np.random.default_rng(0), config)


@pytest.mark.parametrize(("depth", "asked_of"), [(1, [0]), (2, [0]), (4, [1, 2]), (6, [2, 3, 4])])
def test_the_middle_of_the_decoder_is_asked_and_every_layer_after_it_but_the_last(
    stage: tuple[Path, list[Film]], depth: int, asked_of: list[int]
) -> None:
    model, asked, batch = small_policy(stage[1], 4, depth)
    layers = list(model.model.paligemma_with_expert.paligemma.model.language_model.layers)  # type: ignore[union-attr]
    seen: list[torch.Tensor] = []
    hooks = [layer.register_forward_hook(lambda _, args, out: seen.append(out)) for layer in layers]
    with patch.object(asked, "forward", wraps=asked.forward) as question:
        policy.losses(model, asked, batch, 1, torch.Generator().manual_seed(0))
    for hook in hooks:
        hook.remove()
    patches = batch.patches.shape[2]
    told = [call.args[0] for call in question.call_args_list]
    assert [[torch.equal(one, state[:, :patches]) for state in seen].index(True) for one in told] == asked_of


def test_the_goal_is_asked_for_where_there_is_one(stage: tuple[Path, list[Film]]) -> None:
    _, films = stage
    assert all(film.goal > 0 for film in films)
    model, asked, batch = small_policy(films, 6)
    assert not batch.place.isnan().any()
    for film in films:  # every place is the target's, and the goal's, of one moment of one film
        assert film.places.shape[1] > film.goal
    spots = torch.cat([torch.from_numpy(film.places[:, [0, film.goal]]) for film in films])
    assert all(any(torch.equal(one, spot) for spot in spots) for one in batch.place)
    goalless = [replace(film, goal=-1) for film in films]
    _, _, without = small_policy(goalless, 6)
    assert without.place[:, 1].isnan().all()
    assert not without.patches[:, 1].any()
    _, with_goal = policy.losses(model, asked, batch, 1, torch.Generator().manual_seed(0))
    loss, told = policy.losses(model, asked, without, 1, torch.Generator().manual_seed(0))
    assert loss.isfinite()
    assert np.isnan([told["goal_where"], told["goal_hit"]]).all()
    assert np.isfinite(list(with_goal.values())).all()


def test_attention_that_is_fused_gives_the_same_losses_and_gradients(stage: tuple[Path, list[Film]]) -> None:
    model, asked, batch = small_policy(stage[1], 4)
    found = []
    for context in (nullcontext, fused):
        with context(), patch.object(torch.nn.functional, "scaled_dot_product_attention", wraps=F.scaled_dot_product_attention) as kernel:
            loss, told = policy.losses(model, asked, batch, 2, torch.Generator().manual_seed(0))
        found.append((kernel.call_count, told, torch.autograd.grad(loss, list(model.parameters()), allow_unused=True)))
    (few, slow, eager), (many, fast, kernels) = found
    assert many > few
    assert slow == pytest.approx(fast, rel=1e-5)
    for one, other in zip(eager, kernels, strict=True):
        assert (one is None) == (other is None)
        assert one is None or torch.allclose(one, other, rtol=1e-3, atol=1e-5)


def test_one_batch_can_be_learned_by_heart(stage: tuple[Path, list[Film]]) -> None:
    """Flow, patches and place all fall when the same few frames are seen again and again."""
    model, asked, batch = small_policy(stage[1], 8)
    optimiser = torch.optim.AdamW([*model.parameters(), *asked.parameters()], 3e-3)
    told = []
    for step in range(60):
        loss, parts = policy.losses(model, asked, batch, 2, torch.Generator().manual_seed(step))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        told.append(parts)
    early, late = ({name: np.mean([one[name] for one in part]) for name in told[0]} for part in (told[:5], told[-5:]))
    assert late["flow"] < 0.8 * early["flow"]
    assert late["heat"] < 0.8 * early["heat"]
    assert late["where"] < 0.5 * early["where"]
    assert late["hit"] > early["hit"]
