"""The audit proves that tint and text reach the policy, notices a policy that is deaf to them, and changes nothing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vap_core.base.errors import BadOutput, BadPolicy, BadStudy
from vap_core.policies.protocol import (
    TEXT,
    PolicyInput,
    inputs_observed,
    observe_inputs,
    report_input,
)
from vap_core.rollout.loop import Follow, Trial, rollout
from vap_core.rollout.prompters import generic
from vap_core.study import logs
from vap_core.study.trials import DEMO, Study, make_trial, register_personal

STUDY = replace(DEMO, tasks=DEMO.tasks[:1], episodes=2)
ROWS = [replace(row, max_steps=4) for row in STUDY.rows(*STUDY.tasks[0])]


@pytest.fixture(scope="module")
def bank(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("memory")
    register_personal(STUDY, folder)
    return folder


@pytest.fixture(scope="module")
def trial(bank: Path) -> Trial:
    return replace(make_trial(STUDY, ROWS, "vap", bank), audit=True)


def test_tint_and_words_are_proven_to_arrive_and_nothing_changes(trial: Trial) -> None:
    audited, plain = (list(rollout(t, ROWS, batch=2)) for t in (trial, replace(trial, audit=False)))
    for one, other in zip(audited, plain, strict=True):
        assert other.consumed == ()
        assert [(call.step, call.name) for call in one.consumed] == [
            (step, name) for step in (0, 2) for name in (TEXT, "front")
        ]
        assert all(call.changed and call.sound for call in one.consumed)
        assert all(call.pixels > 30 for call in one.consumed if call.name == "front")
        assert all(
            np.array_equal(a.action, b.action)
            for a, b in zip(one.frames, other.frames, strict=True)
        )


def test_generic_consumes_what_the_cameras_saw(trial: Trial) -> None:
    (episode,) = rollout(replace(trial, prompter=generic(), method="generic"), ROWS[:1])
    assert {(call.changed, call.sound, call.pixels) for call in episode.consumed} == {
        (False, True, 0)
    }


def test_a_policy_that_is_deaf_to_the_prompt_is_found_out(trial: Trial, tmp_path: Path) -> None:
    class Deaf:
        label, execute, start = trial.policy.label, trial.policy.execute, trial.policy.start

        def plan(self, states, inputs):  # type: ignore[no-untyped-def]
            grey = [
                PolicyInput(
                    {name: np.full_like(rgb, 128) for name, rgb in seen.images.items()},
                    "pick up the cup",
                    seen.state,
                )
                for seen in inputs
            ]
            return trial.policy.plan(states, grey)

    episodes = list(rollout(replace(trial, policy=Deaf()), ROWS[:1]))
    assert not any(call.sound for call in episodes[0].consumed)
    logs.write_audit(tmp_path, episodes)
    said = logs.verdict(tmp_path)
    assert "audit vap: 2 policy calls; 2 of 2 images tinted" in said
    assert "4 reached the policy otherwise" in said
    assert "episode 0 step 0: front is missing" in said


def test_a_policy_that_tells_nothing_is_refused(trial: Trial) -> None:
    class Silent:
        label, execute, start = "silent", 1, trial.policy.start

        def plan(self, states, inputs):  # type: ignore[no-untyped-def]
            return list(states), [np.zeros((1, 7), np.float32) for _ in inputs]

    with pytest.raises(BadPolicy, match="silent does not report what it consumes"):
        list(rollout(replace(trial, policy=Silent()), ROWS[:1]))


def test_telling_is_heard_inside_the_block_only() -> None:
    report_input(0, "front", "before")
    assert not inputs_observed()
    with observe_inputs() as heard:
        report_input(0, "front", np.zeros(3))
        report_input(1, TEXT, "the red cup")
        assert inputs_observed()
    report_input(0, "side", "after")
    assert {i: sorted(of) for i, of in heard.items()} == {0: ["front"], 1: [TEXT]}
    with observe_inputs() as again:
        report_input(0, "front", np.zeros(3, np.float32))
    assert again[0]["front"] != heard[0]["front"], "another dtype is another tensor"


def test_bounds_and_unaudited_runs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadStudy, match="nothing to audit"):
        Study(STUDY.tasks, ("generic",), policy="random", audit=True)
    with pytest.raises(BadOutput, match="was not audited"):
        logs.read_audit(tmp_path)
    logs.write_audit(tmp_path, [])
    assert not (tmp_path / "audit").exists()


def test_followed_at_its_calls_a_policy_sees_as_much_and_the_steps_between_cost_nothing(
    trial: Trial,
) -> None:
    (every,), (called,) = (
        list(rollout(replace(trial, follow=follow), ROWS[:1], keep_images=True))
        for follow in ("step", "call")
    )
    assert [bool(frame.images) for frame in every.frames] == [True] * 5
    assert [bool(frame.images) for frame in called.frames] == [True, False, True, False, True]
    assert [(call.step, call.name) for call in called.consumed] == [
        (call.step, call.name) for call in every.consumed
    ]
    assert [call.raw for call in called.consumed[:2]] == [call.raw for call in every.consumed[:2]]


@pytest.mark.parametrize(("follow", "audited"), [("call", True), ("step", False)])
def test_what_a_study_asks_for_reaches_its_trials(
    bank: Path, follow: Follow, audited: bool
) -> None:
    made = make_trial(replace(STUDY, follow=follow, audit=audited), ROWS, "vap", bank)
    assert (made.follow, made.audit) == (follow, audited)


def test_a_call_that_a_killed_run_made_too_counts_once(trial: Trial, tmp_path: Path) -> None:
    episodes = list(rollout(trial, ROWS[:1]))
    logs.write_audit(tmp_path, episodes)
    once = logs.verdict(tmp_path)
    logs.write_audit(tmp_path, episodes)
    assert logs.verdict(tmp_path) == once
    assert once.startswith("audit vap: 2 policy calls; 2 of 2 images tinted")
