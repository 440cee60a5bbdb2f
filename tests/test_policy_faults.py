"""What a policy does wrong is the error of its episode; a policy without its methods ends the run."""

import os
import re
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vap_core.base.errors import BadPolicy, BadStudy, WorkerDied
from vap_core.policies.protocol import TEXT, PolicyInput, report_input
from vap_core.policies.scripted.scripted import Random
from vap_core.rollout import calls
from vap_core.rollout.calls import check_policy, checked_plan, policy_call
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.types import Episode
from vap_core.simulation.types import EpisodeRow
from vap_core.study import engine, trials
from vap_core.study.trials import Study, make_trial
from vap_core.study.workers import results

STUDY = Study((("simpler-bridge", "pick-shaver"),), ("generic",), policy="random", episodes=3)
ROWS = tuple(replace(row, max_steps=3) for row in STUDY.rows("simpler-bridge", "pick-shaver"))
BAD = ROWS[1]
Change = Callable[[list, list, int], object]


class Faulty(Random):
    """Plans as Random, then does something wrong where the bad episode is the i-th of the batch."""

    def __init__(self, change: Change) -> None:
        self.change = change

    def plan_from_simulation(self, states: Sequence, envs: Sequence) -> object:
        states, chunks = super().plan_from_simulation(states, envs)
        for i, env in enumerate(envs):
            if env.row.episode == BAD.episode:
                return self.change(states, chunks, i)
        return states, chunks


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Trial:
    return make_trial(STUDY, ROWS, "generic", tmp_path_factory.mktemp("bank"))


def with_chunk(chunk: object) -> Change:
    return lambda states, chunks, i: (states, [*chunks[:i], chunk, *chunks[i + 1 :]])


def leave(states: list, chunks: list, i: int) -> object:
    sys.exit(0)


def hang(states: list, chunks: list, i: int) -> object:
    try:
        time.sleep(30)
    except Exception:  # what a policy that retries does
        time.sleep(30)
    return states, chunks


def check_two_of_three(trial: Trial, rows: Sequence[EpisodeRow], message: str) -> None:
    one, bad, other = rollout(trial, rows, batch=3)
    assert [one.outcome.status, bad.outcome.status, other.outcome.status] == [
        "failure",
        "error",
        "failure",
    ]
    assert [one.outcome.steps, bad.outcome.steps, other.outcome.steps] == [3, 0, 3]
    assert re.search(message, bad.outcome.detail)


class Odd(BaseException):
    """What no `except Exception` sees."""


def ends_all(states: list, chunks: list, i: int) -> object:
    raise Odd("of a library")


def closes(states: list, chunks: list, i: int) -> object:
    raise GeneratorExit


def crash(states: list, chunks: list, i: int) -> object:
    raise ValueError("the policy's own mistake")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (crash, "ValueError: the policy's own mistake"),
        (leave, r"the policy raised SystemExit\(0\); raise an Exception"),
        (ends_all, r"the policy raised Odd\('of a library'\); raise an Exception"),
        (closes, r"the policy raised GeneratorExit\(\); raise an Exception"),
        (with_chunk(np.full((1, 7), np.nan, np.float32)), "numbers that are not finite"),
    ],
)
def test_a_fault_is_the_error_of_its_episode(trial: Trial, change: Change, message: str) -> None:
    check_two_of_three(replace(trial, policy=Faulty(change)), ROWS, message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda states, chunks, i: None, "random: plan returned NoneType; return two lists"),
        (lambda states, chunks, i: (states, chunks[:-1]), "returned 2 chunks for 3 episodes"),
        (lambda states, chunks, i: (states, [*chunks, chunks[0]]), "returned 4 chunks for 3 ep"),
        (lambda states, chunks, i: (states[1:], chunks), "returned 2 states for 3 episodes"),
        (lambda states, chunks, i: (states, None), "returned NoneType chunks for 3 episodes"),
        (with_chunk(None), "returned NoneType as a chunk; return a NumPy array"),
        (with_chunk([[0.0] * 7]), "returned list as a chunk"),
        (with_chunk(np.float32(1)), r"returned float32 float32 \(\) as a chunk"),
        (with_chunk(np.zeros(7, np.float32)), r"returned ndarray float32 \(7,\) as a chunk"),
        (with_chunk(np.zeros((0, 7), np.float32)), r"ndarray float32 \(0, 7\)"),
        (
            with_chunk(np.zeros((1, 6), np.float32)),
            r"float32 \(1, 6\) .* \(steps, 7\), in every row ",
        ),
        (with_chunk(np.zeros((1, 7))), r"ndarray float64 \(1, 7\) as a chunk; .* of type float32"),
        (with_chunk(np.full((1, 7), "x")), r"ndarray <U1 \(1, 7\) as a chunk"),
        (
            with_chunk(np.ma.masked_array(np.zeros((1, 7), np.float32), mask=True)),
            r"plan returned MaskedArray float32 \(1, 7\)",
        ),
    ],
)
def test_what_breaks_the_protocol_is_the_error_of_its_episode(
    trial: Trial, change: Change, message: str
) -> None:
    """It is asked again for one episode at a time: the others go on."""
    alone = message.replace("2 chunks for 3 episodes", "0 chunks for 1 episode")
    alone = alone.replace("4 chunks for 3 ep", "2 chunks for 1 ep")
    alone = alone.replace("2 states for 3 episodes", "0 states for 1 episode")
    check_two_of_three(replace(trial, policy=Faulty(change)), ROWS, alone)


class Bare:
    def start(self, rng: np.random.Generator) -> None: ...

    def plan(self, states: Sequence[Any], inputs: Sequence[PolicyInput]) -> object:
        return states, [np.zeros((1, 7), np.float32)] * len(inputs)


class Named(Bare):
    label = "named"


class Zero(Named):
    execute = 0


class Numbered(Bare):
    label, execute = 3, 1


class Whole(Named):
    execute = np.int64(1)


class Half(Named):
    execute = np.float64(1.5)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (Bare(), "the policy Bare lacks label, execute; it needs label"),
        (Named(), "the policy Named lacks execute; it"),
        (object(), "the policy object lacks label, execute, start, plan"),
        (Zero(), "Zero.execute is 0; it must be a whole number from 1 on"),
        (Numbered(), "Numbered.label is 3; it must be a string"),
        (Half(), "Half.execute is np.float64(1.5); it must be a whole number from 1 on"),
    ],
)
def test_a_policy_that_lacks_a_part_is_refused_before_the_first_step(
    policy: Any, message: str
) -> None:
    with pytest.raises(BadPolicy, match=re.escape(message)):
        check_policy(policy)


def test_a_whole_number_of_numpy_is_one(trial: Trial) -> None:
    (episode,) = rollout(replace(trial, policy=Whole()), ROWS[:1])
    assert (episode.outcome.status, episode.outcome.steps) == ("failure", 3)


def test_a_trial_checks_its_policy(trial: Trial) -> None:
    with pytest.raises(BadPolicy, match="Zero.execute is 0"):
        replace(trial, policy=Zero())


def test_sys_exit_at_the_start_of_an_episode_is_its_error(trial: Trial) -> None:
    class Leaves(Random):
        def start(self, rng: np.random.Generator) -> object:
            if rng.bit_generator.state == bad:
                sys.exit(3)
            return super().start(rng)

    bad = np.random.default_rng([BAD.seed, BAD.episode]).bit_generator.state
    check_two_of_three(replace(trial, policy=Leaves()), ROWS, "SystemExit: 3")


def test_a_call_that_hangs_is_ended(trial: Trial) -> None:
    limited = replace(trial, policy=Faulty(hang), policy_timeout_s=0.2)
    start = time.monotonic()
    check_two_of_three(limited, ROWS, r"TimeoutError: the policy did not answer within 0\.2 s")
    assert time.monotonic() - start < 10


def test_a_call_in_time_is_left_alone() -> None:
    with policy_call(0.05, ["a"]):
        pass
    time.sleep(0.1)


def test_a_limit_outside_the_main_thread_is_refused() -> None:
    caught = []

    def call() -> None:
        try:
            with policy_call(1.0, ["a"]):
                pass
        except BadStudy as error:
            caught.append(str(error))

    thread = threading.Thread(target=call)
    thread.start()
    thread.join()
    assert "main thread only" in caught[0]


def test_without_a_limit_a_note_says_which_episode_waits(
    trial: Trial, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def late(states: list, chunks: list, i: int) -> object:
        time.sleep(0.3)
        return states, chunks

    monkeypatch.setattr(calls, "NOTE_AFTER_S", 0.1)
    list(rollout(replace(trial, policy=Faulty(late)), [replace(BAD, max_steps=1)]))
    (line,) = capfd.readouterr().err.splitlines()
    name = f"simpler-bridge pick-shaver episode {BAD.episode} seed 0 (generic)"
    assert f"waiting: {name}; --policy-timeout" in line


def test_a_policy_cannot_write_into_what_it_is_shown(trial: Trial) -> None:
    """The recording shows the images that the prompter made, whatever the policy does."""
    shown = []

    class Paints:
        label, execute = "paints", 1

        def start(self, rng: np.random.Generator) -> None: ...

        def plan(self, states: Sequence[Any], inputs: Sequence[PolicyInput]) -> object:
            for given in inputs:
                for image in (*given.images.values(), given.state):
                    shown.append(image)
                    with pytest.raises(ValueError, match="read-only"):
                        image[:] = 0
                mine = {name: rgb.copy() for name, rgb in given.images.items()}
                assert all(rgb.flags.writeable for rgb in mine.values())
            return states, [np.zeros((1, 7), np.float32)] * len(inputs)

    row = replace(ROWS[0], max_steps=1)
    (episode,) = rollout(replace(trial, policy=Paints()), [row], keep_images=True)
    assert episode.outcome.status == "failure", episode.outcome.detail
    assert shown
    assert max(int(rgb.max()) for rgb in episode.frames[0].images.values()) > 0


class Reuses:
    """Writes every chunk into one array, and plans for one episode at a time."""

    label = "reuses"

    def __init__(self, execute: int) -> None:
        self.execute = execute
        self.out = np.zeros((execute, 7), np.float32)
        self.sent: list[np.ndarray] = []

    def start(self, rng: np.random.Generator) -> None: ...

    def plan(self, states: Sequence[Any], inputs: Sequence[PolicyInput]) -> object:
        if len(inputs) > 1:
            raise ValueError("one at a time")
        report_input(0, TEXT, inputs[0].text)
        self.out += np.float32(1e-3)
        self.sent.append(self.out.copy())
        return states, [self.out]


def actions_of(episode: Episode) -> np.ndarray:
    return np.array([frame.action for frame in episode.frames if frame.action is not None])


def test_a_frame_keeps_the_action_that_was_executed(trial: Trial) -> None:
    """Whatever the policy writes into its array later."""
    policy = Reuses(execute=1)
    (episode,) = rollout(replace(trial, policy=policy), ROWS[:1])
    assert np.array_equal(actions_of(episode), np.concatenate(policy.sent))


def test_an_episode_executes_its_own_chunk_to_the_end(trial: Trial) -> None:
    policy = Reuses(execute=3)
    episodes = rollout(replace(trial, policy=policy), ROWS[:2], batch=2)
    for episode, sent in zip(episodes, policy.sent, strict=True):
        assert np.array_equal(actions_of(episode), sent)


def test_an_audit_leaves_the_chunk_as_it_was(trial: Trial) -> None:
    """Its second call writes into the array that the first one returned."""
    policy = Reuses(execute=3)
    (episode,) = rollout(replace(trial, policy=policy, audit=True), ROWS[:1])
    assert episode.outcome.status == "failure", episode.outcome.detail
    assert np.array_equal(actions_of(episode), policy.sent[0])


@pytest.mark.parametrize(("size", "noted"), [(1e30, True), (100.0, True), (0.01, False)])
def test_actions_far_beyond_the_robot_are_noted_in_the_row(
    trial: Trial, size: float, noted: bool
) -> None:
    far = Faulty(with_chunk(np.full((1, 7), size, np.float32)))
    _, bad, _ = rollout(replace(trial, policy=far), ROWS, batch=3)
    detail = bad.summary()["detail"]
    assert bad.outcome.status == "failure"
    assert detail.startswith("3 of 3 actions asked for over 10 times") is noted
    assert bool(detail) is noted


def test_a_sound_answer_passes() -> None:
    chunk = np.zeros((2, 7), np.float32)
    states, chunks = checked_plan(([1, 2], (chunk, chunk)), "mine", 2)
    assert states == [1, 2]
    assert chunks[1] is chunk


def test_a_worker_has_one_thread_whatever_the_environment_says(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    ((_, threads),) = results(os.getenv, ["OMP_NUM_THREADS"], 1, "--workers")
    assert threads == "1"


def test_sys_exit_in_a_worker_does_not_end_this_process() -> None:
    with pytest.raises(WorkerDied, match=r"a worker process called sys.exit\(0\)"):
        list(results(sys.exit, [0], 1, "--workers"))


def test_the_limit_reaches_the_policy_of_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials, "make_policy", lambda *_: Faulty(hang))
    monkeypatch.setattr(Study, "rows", lambda *_: ROWS)
    table = engine.run(
        STUDY,
        tmp_path / "run",
        record="none",
        retries=0,
        progress=False,
        policy_timeout_s=0.2,
        executor=lambda work, jobs, workers, remedy: ((job, work(job)) for job in jobs),
    )
    assert table.outcome.tolist() == ["failure", "error", "failure"]
    assert "did not answer within 0.2 s" in table.detail[1]


@pytest.mark.parametrize("limit_s", [0.0, -1.0, float("nan")])
def test_a_limit_of_no_time_is_refused(trial: Trial, limit_s: float) -> None:
    """A timer of 0 s would never end a call."""
    with pytest.raises(BadStudy, match="policy_timeout_s is .*; give seconds above 0, or None"):
        replace(trial, policy_timeout_s=limit_s)
    with pytest.raises(BadStudy, match="give seconds above 0"), policy_call(limit_s, ["a"]):
        pass


@pytest.mark.parametrize("batch", [0, -1])
def test_a_batch_of_no_episode_is_refused(trial: Trial, batch: int) -> None:
    with pytest.raises(BadStudy, match=f"batch is {batch}; give how many episodes"):
        list(rollout(trial, ROWS, batch=batch))
