"""A traced policy gives the same bits as the eager one, or stays eager and says so."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from vap_core.base.errors import BadPolicy
from vap_core.policies.lerobot import traced
from vap_core.policies.lerobot.adapter import IMAGE, STATE, LeRobot, load_policy
from vap_core.policies.lerobot.traced import ChunkPredictor
from vap_core.policies.mini_pi0.learned_token import WORD
from vap_core.policies.protocol import (
    PolicyInput,
    observe_attention,
    observe_inputs,
    unchanged_weights,
)
from vap_core.simulation import suites
from vap_core.study.trials import shipped

from .test_mini_pi0 import checkpoint  # noqa: F401

SHORT = "pick up the red shaver"
LONG = "put the green camera on the plate near the blue bowl"


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(traced, "CALLS_BEFORE_TRACE", 2)


@pytest.fixture
def policy(checkpoint: Path) -> LeRobot:  # noqa: F811
    return load_policy(checkpoint)


def looks(policy: LeRobot, batch: int, text: str, seed: int = 0) -> list[PolicyInput]:
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(batch):
        images = {}
        for key in policy.wanted:
            if key != STATE:
                pixels = rng.integers(0, 256, (64, 64, 3), np.uint8)
                images[key.removeprefix(IMAGE)] = pixels
        state = rng.standard_normal(policy.wanted[STATE]).astype(np.float32)
        found.append(PolicyInput(images, text, state))
    return found


def plan(policy: LeRobot, inputs: list[PolicyInput], seed: int = 7) -> np.ndarray:
    states = [policy.start(np.random.default_rng([seed, i])) for i in range(len(inputs))]
    return np.stack(policy.plan(states, inputs)[1])


def eager(policy: LeRobot, inputs: list[PolicyInput], seed: int = 7) -> np.ndarray:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(policy.predict, "stays_eager", True)
        return plan(policy, inputs, seed)


def trace(policy: LeRobot, text: str = SHORT) -> None:
    """Call it until it is traced."""
    for _ in range(2):
        plan(policy, looks(policy, 2, text))
    assert policy.predict._last is not None


def count_eager_calls(policy: LeRobot, monkeypatch: pytest.MonkeyPatch) -> list[None]:
    """A list that grows by one with every call that runs the model's Python."""
    calls: list[None] = []
    sample = policy.policy.model.sample_actions

    def counted(*args: Any, **options: Any) -> torch.Tensor:
        calls.append(None)
        return sample(*args, **options)

    monkeypatch.setattr(policy.policy.model, "sample_actions", counted, raising=False)
    return calls


def check_bits(suite: str) -> None:
    policy = load_policy(shipped(suite))
    trace(policy)
    for seed in range(2):
        for batch in (5, 3, 1):
            for text in (SHORT, LONG):
                inputs = looks(policy, batch, text, seed)
                assert np.array_equal(plan(policy, inputs), eager(policy, inputs)), (batch, text)
    assert len(policy.predict._graphs) == 7
    assert len(set(policy.predict._graphs.values())) == 1, "one trace serves all shapes"


def test_the_actions_are_the_same_bits_at_every_batch_and_length_of_text() -> None:
    check_bits("simpler-bridge")


@pytest.mark.sweep
@pytest.mark.parametrize("suite", sorted(set(suites.BENCHMARKS) - {"simpler-bridge"}))
def test_the_actions_of_the_other_shipped_policies_are_the_same_bits(suite: str) -> None:
    check_bits(suite)


def test_noise_is_an_input_and_the_configuration_a_part(policy: LeRobot) -> None:
    trace(policy)
    inputs = looks(policy, 2, SHORT)
    first, second = plan(policy, inputs, 7), plan(policy, inputs, 8)
    assert np.array_equal(second, eager(policy, inputs, 8))
    assert np.abs(first - second).max() > 1e-3
    policy.policy.config.temperature = 0.0
    trace(policy)
    now = plan(policy, inputs, 7)
    assert np.array_equal(now, eager(policy, inputs, 7))
    assert np.array_equal(now, plan(policy, inputs, 8))
    assert not np.array_equal(now, first)


def test_it_runs_the_model_only_where_somebody_watches(
    policy: LeRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = count_eager_calls(policy, monkeypatch)
    text = f"pick up {WORD}"
    trace(policy, text)
    inputs = looks(policy, 2, text)
    calls.clear()
    plain = plan(policy, inputs)
    assert len(calls) == 0
    with observe_attention() as maps:
        assert np.array_equal(plan(policy, inputs), plain)
    assert len(maps) == 2
    assert len(calls) == 1
    with observe_inputs():
        assert np.array_equal(plan(policy, inputs), plain)
    assert len(calls) == 2
    seen: list[None] = []
    hook = policy.policy.model.action_out_proj.register_forward_hook(lambda *_: seen.append(None))
    plan(policy, inputs)
    assert len(calls) == 3
    assert seen
    hook.remove()
    learned = policy.with_tokens({WORD: np.full(32, 0.5, np.float32)})
    assert np.abs(plan(learned, inputs) - plain).max() > 1e-4
    assert len(calls) == 4
    assert np.array_equal(plan(policy, inputs), plain)
    assert len(calls) == 4


def halve_in_place(layer: torch.nn.Linear) -> None:
    with torch.no_grad():
        layer.weight.mul_(0.5)


def replace_by_half(layer: torch.nn.Linear) -> None:
    layer.weight = torch.nn.Parameter(0.5 * layer.weight, requires_grad=False)


@pytest.mark.parametrize("change", [halve_in_place, replace_by_half])
def test_changed_weights_are_refused_traced_or_not(policy: LeRobot, change: Any) -> None:
    trace(policy)
    inputs = looks(policy, 2, SHORT)
    before = plan(policy, inputs)
    guard = unchanged_weights(policy)
    guard.__enter__()
    change(policy.policy.model.action_out_proj)
    now, live = plan(policy, inputs), eager(policy, inputs)
    assert not np.array_equal(live, before)
    assert np.array_equal(now, live if change is halve_in_place else before)
    with pytest.raises(BadPolicy, match="parameters of .* changed"):
        guard.__exit__(None, None, None)


def test_no_call_sets_every_module_and_none_trains(
    policy: LeRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    switched: list[bool] = []
    train = policy.policy.train

    def spy(mode: bool = True) -> Any:
        switched.append(mode)
        return train(mode)

    monkeypatch.setattr(policy.policy, "train", spy, raising=False)
    inputs = looks(policy, 1, SHORT)
    for _ in range(4):
        plan(policy, inputs)
    assert switched == []
    policy.policy.model.train()
    plan(policy, inputs)
    assert switched == [False]
    assert not any(module.training for module in policy.policy.modules())


class Stub(torch.nn.Module):
    """A policy whose chunk is `what` of its batch."""

    def __init__(self, what: Any, device: str = "cpu") -> None:
        super().__init__()
        self.what = what
        self.config = SimpleNamespace(device=device)

    def predict_action_chunk(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        return self.what(batch)


def by_a_branch(batch: dict[str, torch.Tensor]) -> torch.Tensor:
    return batch["state"] * 2 if batch["mask"].all() else batch["state"]


def by_a_number(batch: dict[str, torch.Tensor]) -> torch.Tensor:
    return batch["state"] * float(batch["state"][0, 0])


def not_at_all(batch: dict[str, torch.Tensor]) -> torch.Tensor:
    if torch.jit.is_tracing():
        raise IndexError("tuple index out of range")
    return 3 * batch["state"]


def stub_batch(episodes: int, seed: int = 0) -> dict[str, torch.Tensor]:
    state = torch.randn((episodes, 4), generator=torch.Generator().manual_seed(seed))
    return {"state": state, "mask": torch.ones((episodes, 6), dtype=torch.bool)}


@pytest.mark.parametrize(
    ("what", "device", "reason"),
    [
        (by_a_branch, "cpu", "the graph gives other actions"),
        (by_a_number, "cpu", "the graph gives other actions"),
        (not_at_all, "cpu", r"tracing failed \(IndexError: tuple index out of range\)"),
        (not_at_all, "cuda", "tracing was tried on the CPU only, not on cuda"),
    ],
)
def test_what_cannot_be_traced_stays_eager_and_says_so_once(
    what: Any, device: str, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    stub: Any = Stub(what, device)
    predict = ChunkPredictor(stub, "stub")
    for seed in range(8):
        batch = stub_batch(2, seed)
        assert torch.equal(predict(batch, None), what(batch))
    assert predict.stays_eager
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("note: stub runs as it is, not as a traced graph")
    assert re.search(reason, line)


def test_a_graph_serves_only_the_shapes_for_which_it_is_right(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Where the batch size becomes a constant of the trace, every size gets its own."""

    def constant_size(batch: dict[str, torch.Tensor]) -> torch.Tensor:
        return batch["state"] * torch.tensor([[2.0]] * len(batch["state"]))

    stub: Any = Stub(constant_size)
    predict = ChunkPredictor(stub, "stub")
    for episodes in (2, 2, 3, 3, 3, 2, 3):
        batch = stub_batch(episodes)
        assert torch.equal(predict(batch, None), 2 * batch["state"])
    assert len(set(predict._graphs.values())) == 2
    assert not predict.stays_eager
    assert capsys.readouterr().err == ""
