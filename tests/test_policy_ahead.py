"""Batches that are drawn ahead in processes, and what depends on how many there are."""

import multiprocessing
import os
import signal
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.test_policy_training import TINY, known
from vap_core.base.errors import UnknownName, WorkerDied
from vap_core.policies.mini_pi0.learned_token import TokenTraining
from vap_core.policies.mini_pi0.vlm import MiniVlm
from vap_make.films.demonstrations import Film
from vap_make.policy import taught
from vap_make.policy import train as policy
from vap_make.policy.ahead import Ahead
from vap_make.policy.batches import Frames, statistics


def frames_of(films: list[Film], steps: int) -> Frames:
    recipe = replace(TINY, steps=steps, batch=3)
    config = policy.configuration(recipe, films[0].state.shape[1], films[0].action.shape[1])
    return Frames(recipe, films, statistics(films), config, known(films))


@pytest.mark.parametrize("jobs", [1, 2])
def test_batches_drawn_ahead_are_those_of_their_steps(
    stage: tuple[Path, list[Film]], jobs: int
) -> None:
    frames = frames_of(stage[1], steps=7)
    ahead = Ahead(frames, jobs)
    for step in range(3, 7):
        taken = ahead.take(step)
        drawn = frames.draw(3, np.random.default_rng([73, TINY.seed, step]))
        for part in fields(drawn):
            one, other = getattr(taken, part.name), getattr(drawn, part.name)
            assert torch.equal(one.nan_to_num(), other.nan_to_num()), part.name
    assert (ahead.cpu_s > 0) == (jobs > 1), "what this process draws is in its own CPU time"
    ahead.close()
    assert not multiprocessing.active_children()


def test_a_process_that_dies_is_one_line(stage: tuple[Path, list[Film]]) -> None:
    first = Ahead(frames_of(stage[1], steps=100), 2)
    first.take(0)  # torch has set its handler by now
    first.close()
    before = signal.getsignal(signal.SIGCHLD)
    ahead = Ahead(frames_of(stage[1], steps=100), 2)
    ahead.take(0)
    for process in multiprocessing.active_children():
        os.kill(process.pid, signal.SIGKILL)
    time.sleep(1.0)  # torch's handler of SIGCHLD would raise here, outside of `take`

    def take_the_rest() -> None:
        for step in range(1, 100):
            ahead.take(step)

    with pytest.raises(WorkerDied, match="with fewer jobs"):
        take_the_rest()
    ahead.close()
    assert signal.getsignal(signal.SIGCHLD) == before


def test_words_are_the_same_in_one_process_and_in_two(
    stage: tuple[Path, list[Film]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    films = stage[1]
    config = policy.configuration(TINY, films[0].state.shape[1], films[0].action.shape[1])
    MiniVlm(config).save(tmp_path / "vlm")
    monkeypatch.setattr(taught, "TRAINING", TokenTraining(epochs=1, augmentations=1))
    monkeypatch.setattr(taught, "LEAST_ACCURACY", 0.0)
    made = []
    for jobs in (1, 2):
        words, about = taught.learn_words(tmp_path / "vlm", films, 2, tmp_path / str(jobs), jobs)
        made.append((words, about["accuracy"]))
    (one, accuracy), (other, again) = made
    assert list(one) == list(other)
    assert len(one) >= 2
    assert accuracy == again
    assert all(np.array_equal(one[name], other[name]) for name in one)


@pytest.mark.skipif(torch.cuda.is_available(), reason="it has a GPU")
def test_a_device_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match="'cuda' is not on this machine"):
        policy.train(TINY, tmp_path, device="cuda")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_training_on_a_gpu_learns_the_same(
    stage: tuple[Path, list[Film]], tmp_path: Path
) -> None:
    recipe = replace(TINY, stages=1, steps=3, batch=3, draws=2, taught=0)
    flows = []
    for device in ("cpu", "cuda"):
        about = policy.train(
            recipe, tmp_path / device, cache=stage[0].parent, jobs=1, device=device, every=1
        )
        flows.append([line["flow"] for line in about["log"]])
    assert flows[0] == pytest.approx(flows[1], rel=1e-3)
