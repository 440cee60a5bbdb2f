"""The contract of a policy: chunks of actions that fit the robot, and no other randomness than its
episode's."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vap_core.contracts.given import short_rows, trial_of
from vap_core.rollout.calls import check_policy
from vap_core.rollout.loop import rollout
from vap_core.rollout.types import Episode

STEPS = 6


def episodes(policy: Any, where: str, batch: int) -> list[Episode]:
    """The first steps of two episodes."""
    rows = short_rows(where, STEPS)
    trial = trial_of(policy, rows)
    try:
        return list(rollout(trial, rows, batch=batch))
    finally:
        trial.scene.close()


def actions(of: Sequence[Episode]) -> np.ndarray:
    taken = (frame.action for episode in of for frame in episode.frames)
    return np.array([action for action in taken if action is not None])


def states(of: Sequence[Episode]) -> np.ndarray:
    """The robot's state at every step: what the simulator made of the actions."""
    return np.array([frame.state for episode in of for frame in episode.frames])


def check_close(some: Sequence[Episode], others: Sequence[Episode]) -> None:
    """Actions differ by less than 1e-3, and the states that they come to by less than 1e-2."""
    assert np.allclose(actions(some), actions(others), atol=1e-3)
    assert np.allclose(states(some), states(others), atol=1e-2)


class AskedTwice:
    """A policy whose every call is made twice with the same states; the second one counts."""

    def __init__(self, policy: Any) -> None:
        self.label = policy.label
        self.execute = policy.execute
        self.start = policy.start
        self.name = "plan" if hasattr(policy, "plan") else "plan_from_simulation"
        self.call = getattr(policy, self.name)
        setattr(self, self.name, self.again)

    def again(self, states: Any, given: Any) -> Any:
        self.call(states, given)
        return self.call(states, given)


def test_it_has_label_execute_start_and_plan(policy: Any) -> None:
    check_policy(policy)


def test_its_actions_fit_the_robot(policy: Any, where: str) -> None:
    """A chunk of another shape or type ends the rollout with the sentence that says so."""
    for episode in episodes(policy, where, batch=2):
        assert episode.outcome.status != "error", episode.outcome.detail
        assert "cut to it" not in episode.outcome.detail, episode.outcome.detail


def test_an_episode_repeats_its_actions(policy: Any, where: str) -> None:
    once = episodes(policy, where, batch=2)
    np.random.seed(5)  # noqa: NPY002  (global seeding must change nothing)
    again = episodes(policy, where, batch=2)
    assert np.array_equal(actions(once), actions(again))
    assert np.array_equal(states(once), states(again))


def test_a_batch_equals_one_by_one(policy: Any, where: str) -> None:
    check_close(episodes(policy, where, batch=2), episodes(policy, where, batch=1))


def test_the_states_it_is_given_stay_as_they_were(policy: Any, where: str) -> None:
    """Where one episode fails a batch, the rollout asks again for each of the others."""
    once = episodes(policy, where, batch=2)
    check_close(once, episodes(AskedTwice(policy), where, batch=2))
