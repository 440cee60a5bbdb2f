"""What a policy is shown and asked: which frames, how they are read, and the questions beside."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest
import torch
from torch.nn import functional as F  # noqa: N812

from tests.test_policy_training import SUITE, TINY, known
from vap_core.base.files import DATA
from vap_core.policies.mini_pi0.learned_token import WORD
from vap_core.policies.mini_pi0.modeling_mini_pi0 import MiniPI0Policy, fused_attention
from vap_core.simulation.control import arm, rotation_vector
from vap_core.simulation.suites import suite
from vap_make.films.demonstrations import Film
from vap_make.policy import losses
from vap_make.policy import train as policy
from vap_make.policy.batches import (
    SPIN_Z,
    Batch,
    Frames,
    emphasis,
    statistics,
    target_chunk,
    turn,
    turn_otherwise,
    waits,
)


def test_a_commands_learned_word_reaches_the_policy(stage: tuple[Path, list[Film]]) -> None:
    """The hidden states of a command with a learned word change with its embedding, and with it alone."""
    model, _, batch = small_policy(stage[1], 4)
    tokens = batch.tokens.clone()
    tokens[:2, 1] = model.config.words.index(WORD)
    found = []
    for value in (0.0, 1.0):
        learned = torch.full((4, TINY.width), value)
        changed = replace(batch, tokens=tokens, learned=learned)
        hidden, _, _ = losses._look(model, changed)
        found.append(hidden[0].detach())
    differs = (found[0] - found[1]).abs().amax((1, 2)) > 1e-6
    assert differs.tolist() == [True, True, False, False]


def test_frames_close_to_the_start_a_turn_of_the_gripper_or_the_end_come_more_often(
    stage: tuple[Path, list[Film]],
) -> None:
    _, films = stage
    action = np.ones((40, films[0].action.shape[1]), np.float32)
    action[15:, -1] = 0.2
    rest = {
        part: np.repeat(getattr(films[0], part)[:1], 40, axis=0)
        for part in ("images", "ids", "state", "places")
    }
    chances = emphasis(replace(films[0], action=action, **rest), 3.0)
    assert set(np.flatnonzero(chances == 12.0)) == {0, 1, 2}, (
        "there the hand decides which way it turns"
    )
    assert set(np.flatnonzero(chances == 3.0)) == {3, 4, *range(11, 20), *range(35, 40)}
    assert set(np.flatnonzero(chances == 1.0)) == {*range(5, 11), *range(20, 35)}
    thirds = emphasis(replace(films[0], action=action, **rest), 3.0, 3)
    assert [*thirds] == [12.0] * 3 + [3.0] * 11, "pictures are counted, not steps"


def test_every_task_is_drawn_as_often_as_another(stage: tuple[Path, list[Film]]) -> None:
    _, films = stage
    config = policy.configuration(TINY, films[0].state.shape[1], films[0].action.shape[1])
    three = [films[0], replace(films[0], task="another"), replace(films[0], task="another")]
    frames = Frames(TINY, three, statistics(three), config, known(films))
    assert frames.share == pytest.approx([0.5, 0.25, 0.25])


def test_angles_are_read_with_noise_and_nothing_else_is(stage: tuple[Path, list[Film]]) -> None:
    """What a film holds still is mostly noise to the policy, and it is scaled as what varies."""
    _, films = stage
    config = policy.configuration(TINY, films[0].state.shape[1], films[0].action.shape[1])
    states = []
    for noise in (0.0, 0.05):
        recipe = replace(TINY, angle_noise_rad=noise)
        stats = statistics(films, noise)
        drawn = Frames(recipe, films, stats, config, known(films)).draw(
            200, np.random.default_rng(0)
        )
        states.append(drawn.state * stats["observation.state"]["std"])
    still, noisy = states
    assert drawn.state[:, [3, 4]].abs().max() < 5, "what is held still is not blown up"
    added = (noisy - still).numpy()
    angles = [3, 4, 5, *range(7, added.shape[1])]
    assert added[:, angles].std(axis=0) == pytest.approx(0.05, rel=0.2)
    assert np.abs(np.delete(added, angles, axis=1)).max() < 1e-6


def test_a_hand_that_is_shown_turned_otherwise_turns_back_in_time_and_does_all_else_as_before(
    stage: tuple[Path, list[Film]],
) -> None:
    _, films = stage
    film, rate, kinematics = films[0], 0.28, arm(suite(SUITE).robot)
    close = int(np.argmax(film.action[:, -1] < 0.5))
    reach = min(np.pi / 2, 0.8 * rate * close)
    seen = []
    for i in range(20):
        chunk = target_chunk(film, 0, close)
        state, back = turn_otherwise(film, 0, chunk, rate, np.random.default_rng(i))
        assert (np.delete(back, SPIN_Z, axis=1) == np.delete(chunk, SPIN_Z, axis=1)).all()
        assert (
            np.delete(state, [SPIN_Z, -1]) == np.delete(film.state[0], [SPIN_Z, len(state) - 1])
        ).all()
        assert np.abs(back[:, SPIN_Z]).max() <= rate + 1e-6
        seen.append(float(back[:, SPIN_Z].sum()))
        assert state[SPIN_Z] + seen[-1] == pytest.approx(
            film.state[0, SPIN_Z] + film.action[:close, SPIN_Z].sum(), abs=1e-4
        ), "it ends as it did"
        was, now = (kinematics.forward(one[7:].astype(float)) for one in (film.state[0], state))
        assert now[:3, 3] == pytest.approx(was[:3, 3], abs=1e-4), (
            "its last joint turns it on the spot"
        )
        assert rotation_vector(now[:3, :3] @ was[:3, :3].T) == pytest.approx(
            [0, 0, state[SPIN_Z] - film.state[0, SPIN_Z]], abs=0.02
        )
    assert min(seen) < -0.4 * reach, "either way"
    assert max(seen) > 0.4 * reach, "either way"
    state, back = turn_otherwise(
        film, close, target_chunk(film, close, 4), rate, np.random.default_rng(0)
    )
    assert (state == film.state[close]).all(), "a hand that closes stays as it is"
    assert (back == target_chunk(film, close, 4)).all(), "a hand that closes stays as it is"


def test_waiting_is_not_taught_but_for_the_end(stage: tuple[Path, list[Film]]) -> None:
    _, films = stage
    rest = {
        part: np.repeat(getattr(films[0], part)[:1], 40, axis=0)
        for part in ("images", "ids", "state", "places")
    }
    rest["state"][:, 0] += 0.01 * np.arange(40)
    action = np.ones((40, films[0].action.shape[1]), np.float32)
    action[20:24, :-1] = action[36:, :-1] = 0.0
    still = {**rest, "state": rest["state"].copy()}
    still["state"][20:25], still["state"][36:] = rest["state"][20], rest["state"][36]
    assert list(np.flatnonzero(waits(replace(films[0], action=action, **still)))) == [
        20,
        21,
        22,
        23,
    ]
    assert not waits(replace(films[0], action=action, **rest)).any(), "something happens"
    closing = action.copy()
    closing[21:, -1] = 0.0
    assert list(np.flatnonzero(waits(replace(films[0], action=closing, **still)))) == [
        20,
        22,
        23,
    ], "it asks for something"
    chances, shown = (
        emphasis(replace(films[0], action=action, **part), 3.0) for part in (still, rest)
    )
    assert (chances[20:24] == 0).all()
    assert (np.delete(chances, range(20, 24)) == np.delete(shown, range(20, 24))).all()
    waiting = replace(films[0], action=closing, **still)
    assert (target_chunk(waiting, 18, 5) == closing[[18, 19, 21, 24, 25]]).all(), (
        "the chunk goes on behind the wait, from the closed jaw"
    )
    assert (target_chunk(waiting, 18, 2) == closing[18:20]).all()
    assert (target_chunk(waiting, 38, 4)[:, :-1] == 0).all()
    assert (target_chunk(waiting, 38, 4)[:, -1] == closing[-1, -1]).all()


def test_how_the_hand_will_close_is_asked_until_it_does(stage: tuple[Path, list[Film]]) -> None:
    for film in stage[1]:
        closes = int((film.action[:, -1] < 0.5).argmax())
        angle = float(film.state[closes, 5])
        assert closes > 4
        assert (
            turn(film, 0)
            == turn(film, closes - 1)
            == pytest.approx((np.cos(2 * angle), np.sin(2 * angle)))
        )
        around = film.state.copy()
        around[:, 5] += np.pi
        assert turn(replace(film, state=around), 0) == pytest.approx(turn(film, 0), abs=1e-5), (
            "a jaw turned half around is the same"
        )
        assert np.isnan(turn(film, closes)).all(), "it is closed"
        opens = closes + int((film.action[closes:, -1] > 0.5).argmax())
        assert np.isnan(turn(film, opens)).all(), "it closes no more"


def small_policy(
    films: list[Film], batch: int, depth: int = 2
) -> tuple[MiniPI0Policy, losses.Questions, Batch]:
    """An untrained policy of the smallest sizes, the questions beside it, and one batch of so many frames."""
    recipe = replace(TINY, batch=batch, draws=2, depth=depth)
    config = policy.configuration(recipe, films[0].state.shape[1], films[0].action.shape[1])
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model, asked = MiniPI0Policy(config), losses.Questions(recipe.width)
    frames = Frames(recipe, films, statistics(films), config, known(films))
    return model, asked, frames.draw(batch, np.random.default_rng(0))


@pytest.mark.parametrize(("depth", "asked_of"), [(1, [0]), (2, [0]), (4, [1, 2]), (6, [2, 3, 4])])
def test_the_middle_of_the_decoder_is_asked_and_every_layer_after_it_but_the_last(
    stage: tuple[Path, list[Film]], depth: int, asked_of: list[int]
) -> None:
    model, asked, batch = small_policy(stage[1], 4, depth)
    layers = list(model.model.paligemma_with_expert.paligemma.model.language_model.layers)
    seen: list[torch.Tensor] = []
    hooks = [layer.register_forward_hook(lambda _, args, out: seen.append(out)) for layer in layers]
    with patch.object(asked, "forward", wraps=asked.forward) as question:
        losses.losses(model, asked, batch, 1, torch.Generator().manual_seed(0))
    for hook in hooks:
        hook.remove()
    patches = batch.patches.shape[2]
    told = [call.args[0] for call in question.call_args_list]
    assert [
        [torch.equal(one, state[:, :patches]) for state in seen].index(True) for one in told
    ] == asked_of


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
    _, with_goal = losses.losses(model, asked, batch, 1, torch.Generator().manual_seed(0))
    loss, told = losses.losses(model, asked, without, 1, torch.Generator().manual_seed(0))
    assert loss.isfinite()
    assert np.isnan([told["goal_where"], told["goal_hit"]]).all()
    assert np.isfinite(list(with_goal.values())).all()


def test_attention_that_is_fused_gives_the_same_losses_and_gradients(
    stage: tuple[Path, list[Film]],
) -> None:
    model, asked, batch = small_policy(stage[1], 4)
    found = []
    for context in (nullcontext, fused_attention):
        with (
            context(),
            patch.object(
                torch.nn.functional,
                "scaled_dot_product_attention",
                wraps=F.scaled_dot_product_attention,
            ) as kernel,
        ):
            loss, told = losses.losses(model, asked, batch, 2, torch.Generator().manual_seed(0))
        found.append(
            (
                kernel.call_count,
                told,
                torch.autograd.grad(loss, list(model.parameters()), allow_unused=True),
            )
        )
    (few, slow, eager), (many, fast, kernels) = found
    assert many > few
    assert slow == pytest.approx(fast, rel=1e-5)
    for one, other in zip(eager, kernels, strict=True):
        assert (one is None) == (other is None)
        assert one is None or torch.allclose(one, other, rtol=1e-3, atol=1e-5)


def test_one_batch_can_be_learned_by_heart(stage: tuple[Path, list[Film]]) -> None:
    """Flow, patches, place and turn all fall when the same few frames are seen again and again."""
    model, asked, batch = small_policy(stage[1], 12)
    optimiser = torch.optim.AdamW([*model.parameters(), *asked.parameters()], 3e-3)
    told = []
    for step in range(60):
        loss, parts = losses.losses(model, asked, batch, 2, torch.Generator().manual_seed(step))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        told.append(parts)
    early, late = (
        {name: np.mean([one[name] for one in part]) for name in told[0]}
        for part in (told[:5], told[-5:])
    )
    assert late["flow"] < 0.8 * early["flow"]
    assert late["heat"] < 0.8 * early["heat"]
    assert late["where"] < 0.5 * early["where"]
    assert late["turn"] < 0.5 * early["turn"]
    assert late["hit"] > early["hit"]


def test_how_far_the_planned_turn_is_from_the_one_that_was_made() -> None:
    """Knocks that follow are not in the plan that `turn_otherwise` adds."""
    off = []
    for path in sorted((DATA / "demonstrations" / "simpler-bridge" / "data").rglob("*.parquet")):
        for _, film in pd.read_parquet(path).groupby("episode_index"):
            state, action = np.stack(film["observation.state"]), np.stack(film["action"])
            for t in range(len(action)):
                close = int(np.argmax(action[t:, -1] < 0.5))
                if close:
                    turned = state[t + close, SPIN_Z] - state[t, SPIN_Z]
                    off.append(action[t : t + close, SPIN_Z].sum() - turned)
    away = np.abs((np.array(off) + np.pi) % (2 * np.pi) - np.pi)
    assert np.sqrt((away**2).mean()) == pytest.approx(0.21, abs=0.005)
    assert away.max() == pytest.approx(0.69, abs=0.005)
