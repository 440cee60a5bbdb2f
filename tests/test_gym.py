"""The benchmarks as gymnasium environments: found by name, passing gymnasium's own check, sync equal to one by one."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import parse_env_id
from gymnasium.utils.env_checker import check_env

from vap_core.base.errors import BadSuite, BadViews, UnknownName
from vap_core.simulation import suites
from vap_core.simulation.gym_env import VapEnv, env_id
from vap_core.simulation.types import Placement

FIRST = [(name, suite.tasks[-1].name) for name, suite in suites.BENCHMARKS.items()]


@pytest.mark.parametrize(("suite", "task"), FIRST)
def test_every_suite_passes_gymnasiums_checker(suite, task):
    env = gym.make(env_id(suite, task), image_size=64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it advises against unbounded state boxes
        check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_an_episode_with_sub_goals_is_refused():
    """Its reward was that of the first sub-goal."""
    with pytest.raises(BadSuite, match="shared-sequence have sub-goals.*vap eval"):
        VapEnv("shared-sequence", suites.suite("shared-sequence").tasks[0].name)


def test_every_id_that_is_registered_can_be_made():
    """Six of 46 could not: their episodes have sub-goals."""
    known = [spec.kwargs for name, spec in gym.registry.items() if name.startswith("vap/")]
    assert len(known) >= 40
    for asked in known:
        assert not any(row.subgoals for row in suites.rows(asked["suite"], asked["task"]))


@pytest.mark.parametrize(
    ("asked", "error", "said"),
    [
        ({"robots": "bogus"}, UnknownName, "robots 'bogus' is unknown; known: menagerie, plain"),
        ({"image_size": 0}, BadViews, "pictures of 0 x 0 pixels; give 1 or more"),
        ({"image_size": -4}, BadViews, "pictures of -4 x -4 pixels; give 1 or more"),
        ({"render_mode": "human"}, UnknownName, "render_mode 'human' is unknown; known: rgb_array"),
        ({"episodes": 0}, BadSuite, "episodes is 0; give 1 or more"),
        ({"episodes": -1}, BadSuite, "episodes is -1; give 1 or more"),
    ],
)
def test_an_environment_that_cannot_be_made_is_one_line(asked, error, said):
    with pytest.raises(error, match=said) as refusal:
        VapEnv("widowx-pick", "pick-straw-cup", **asked)
    assert "\n" not in str(refusal.value)


def test_the_name_in_the_manual_works_and_other_names_read_as_before():
    assert gym.spec("vap/simpler-bridge/put-camera-v0").kwargs == {
        "suite": "simpler-bridge",
        "task": "put-camera",
    }
    assert parse_env_id("vap/simpler-bridge/put-camera-v0") == (
        "vap/simpler-bridge",
        "put-camera",
        0,
    )
    assert parse_env_id("CartPole-v1") == (None, "CartPole", 1)
    assert parse_env_id("ns/Name-v3") == ("ns", "Name", 3)
    with pytest.raises(gym.error.Error, match="Malformed"):
        parse_env_id("a/b/c-v0")


def wander(env, actions, episode):
    seen = [env.reset(seed=5, options={"episode": episode})[0]]
    for action in actions:
        seen.append(env.step(action)[0])
    return seen


def test_synchronous_vector_equals_one_by_one_step_for_step():
    name = env_id("simpler-bridge", "put-camera")
    make = lambda: gym.make(name, image_size=64)  # noqa: E731
    one = make()
    rng = np.random.default_rng(0)
    actions = [
        (0.5 * one.action_space.high * rng.uniform(-1, 1, 7)).astype(np.float32) for _ in range(6)
    ]
    alone = wander(one, actions, 3)
    vector = gym.vector.SyncVectorEnv(
        [make, make], autoreset_mode=gym.vector.AutoresetMode.DISABLED
    )
    together = [vector.reset(seed=[5, 5], options={"episode": 3})[0]]
    for action in actions:
        together.append(vector.step(np.stack([action, action]))[0])
    for step, both in zip(alone, together, strict=True):
        for i in range(2):
            assert (both["images"]["front"][i] == step["images"]["front"]).all()
            assert (both["state"][i] == step["state"]).all()
    one.close()
    vector.close()


def test_a_row_of_your_own_is_checked_and_run():
    env = gym.make(env_id("simpler-bridge", "pick-shaver"), image_size=64)
    row = suites.rows("simpler-bridge", "pick-shaver", 1)[0]
    moved = type(row)(
        **{name: getattr(row, name) for name in row.__slots__}
        | {"placements": (Placement(row.target, 0.27, 0.02, 0.0),)}
    )
    _, info = env.reset(options={"row": moved})
    assert info["steps"] == 0
    bad = type(row)(**{name: getattr(row, name) for name in row.__slots__} | {"variant": "disco"})
    with pytest.raises(BadSuite, match="row 1, field 'variant': 'disco' is unknown; known: base"):
        env.reset(options={"row": bad})
    with pytest.raises(
        BadSuite, match="no episode -1; vap/simpler-bridge/pick-shaver-v0 has 0 .. 23"
    ):
        env.reset(options={"episode": -1})
    with pytest.raises(BadSuite, match="is no EpisodeRow for wx250s"):
        env.reset(options={"row": suites.rows("vlabench", "select-shoe", 1)[0]})
    env.close()
