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
"""How far an action (metres, radians) of the first steps may be off with two threads."""


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


def compare(one: Rows, other: Rows) -> tuple[int, float]:
    """How many outcomes differ, and the largest difference of an action in the first 16 steps."""
    assert one.keys() == other.keys()
    outcomes, largest = 0, 0.0
    for name in one:
        if name.endswith("-outcome"):
            outcomes += not np.array_equal(one[name], other[name])
        else:
            steps = min(len(one[name]), len(other[name]), 16)
            largest = max(largest, float(np.abs(one[name][:steps] - other[name][:steps]).max()))
    return outcomes, largest


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Rows:
    return rollouts(tmp_path_factory.mktemp("base") / "base.npz")


@pytest.mark.sweep
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "options",
    [{"hash_seed": 0}, {"hash_seed": 7}, {"batch": 1}, {"batch": 3}],
    ids=["process", "hash seed", "batch of 1", "batch of 3"],
)
def test_processes_hash_seeds_and_batches_change_no_bit(
    base: Rows,
    tmp_path: Path,
    options: dict[str, int],
    record_property: Callable[[str, object], None],
) -> None:
    other = rollouts(tmp_path / "other.npz", **options)
    for name in base:
        assert np.array_equal(base[name], other[name]), name
    record_property("cases", len(base) // 2)


@pytest.mark.sweep
@pytest.mark.timeout(900)
def test_two_threads_change_the_last_bits_alone(
    base: Rows, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    outcomes, largest = compare(base, rollouts(tmp_path / "other.npz", threads=2))
    record_property("cases", len(base) // 2)
    record_property("other_outcomes", outcomes)
    record_property("largest_difference_of_an_action", largest)
    assert outcomes == 0
    assert largest < ROUNDING
