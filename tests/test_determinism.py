"""The same episodes in other processes, under other hash seeds, in other batches, with other threads."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

Rows = dict[str, np.ndarray]
ROUNDING = 2e-5
"""How far an action (metres, radians) of the first steps may be off where rounding differs."""
FIRST = 8
"""Steps of the policy's first answer. Before its next one a pixel can be rounded to another value,
and a picture that differs moves an action by more than rounding."""
LATER, PIXEL = 16, 0.02
"""How far an action may be off up to that step; after it, a contact can make much of it."""


def rollouts(out: Path, hash_seed: int = 0, **options: object) -> Rows:
    words = [f"--{name}={number}" for name, number in options.items()]
    subprocess.run(
        [sys.executable, "-m", "tests.one_rollout", str(out), *words],
        env={**os.environ, "PYTHONHASHSEED": str(hash_seed)},
        check=True,
        capture_output=True,
    )
    with np.load(out) as file:
        return dict(file)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Rows:
    return rollouts(tmp_path_factory.mktemp("base") / "base.npz")


@pytest.mark.sweep
@pytest.mark.timeout(900)
def test_another_process_and_hash_seed_change_no_bit(
    base: Rows, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    other = rollouts(tmp_path / "other.npz", hash_seed=7)
    assert base.keys() == other.keys()
    for name in base:
        assert np.array_equal(base[name], other[name]), name
    record_property("cases", len(base) // 2)


@pytest.mark.sweep
@pytest.mark.timeout(900)
@pytest.mark.parametrize("options", [{"batch": 1}, {"threads": 2}], ids=["batch", "threads"])
def test_batches_and_threads_change_the_last_bits_alone(
    base: Rows,
    tmp_path: Path,
    options: dict[str, int],
    record_property: Callable[[str, object], None],
) -> None:
    other = rollouts(tmp_path / "other.npz", **options)
    assert base.keys() == other.keys()
    outcomes, first, later = 0, 0.0, 0.0
    for name, mine in base.items():
        if name.endswith("-outcome"):
            outcomes += mine[0] != other[name][0]
        else:
            steps = min(len(mine), len(other[name]), LATER)
            difference = np.abs(mine[:steps] - other[name][:steps])
            first = max(first, float(difference[:FIRST].max()))
            later = max(later, float(difference[FIRST:].max()))
    record_property("cases", len(base) // 2)
    record_property("other_outcomes", int(outcomes))
    record_property("largest_difference_of_an_action_in_the_first_8_steps", first)
    record_property("largest_difference_of_an_action_in_the_next_8", later)
    assert outcomes == 0
    assert first < ROUNDING
    assert later < PIXEL
