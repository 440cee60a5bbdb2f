"""Environments of other libraries, through the protocol that our own keeps too."""

from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from vap_core.base.errors import BadStudy, MissingPart
from vap_core.environments import AnyScene, Environment, World, libero, open_env, open_world
from vap_core.policies.scripted.scripted import PlacedScripted, TruePlaces
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters import generic
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.suites.open_row import build_scene, models_of
from vap_core.simulation.suites.rules import Judge
from vap_core.simulation.types import EpisodeRow, Truth
from vap_core.study.trials import Study, make_policy, make_trial

THERE = find_spec("libero") is not None
needs_libero = pytest.mark.skipif(not THERE, reason="LIBERO is absent: make libero")
TASK = ("libero-personal", "red-coffee-mug-left")
LISTED = [("widowx-pick", "pick-straw-cup"), pytest.param(*TASK, marks=needs_libero)]
NOTHING = Truth({}, {}, (), {}, {})


def rows_of(suite: str, task: str, n: int = 1) -> tuple[EpisodeRow, ...]:
    return suites.rows(suite, task, n)


def scene_of(rows: tuple[EpisodeRow, ...]) -> AnyScene:
    if suites.suite(rows[0].suite).environment:
        return open_world(rows)
    return build_scene(rows[0].suite, models_of(rows))


@pytest.mark.parametrize(("suite", "task"), LISTED)
def test_an_environment_keeps_its_contract(suite: str, task: str) -> None:
    (row,) = rows_of(suite, task)
    scene = scene_of((row,))
    env, cameras = open_env(scene, suites.suite(suite).cameras), suites.suite(suite).cameras
    assert isinstance(env, Environment)
    assert isinstance(scene, World) == bool(suites.suite(suite).environment)
    stream = str(np.random.get_state())  # noqa: NPY002
    env.reset(row)
    first, truth = env.observe(), env.truth(masks=True)
    size = next(iter(first.images.values())).shape[:2]
    assert [*first.images] == [camera.name for camera in env.cameras()] == [*cameras]
    assert all(mask.shape == size for of in truth.masks.values() for mask in of.values())
    assert truth.masks[cameras[0]][row.target].any()
    assert {*truth.objects_world} >= {place.model for place in row.placements}
    assert abs(truth.objects_world[row.target][2]) < 0.01, "z = 0 is the table"
    assert len(env.look(96)[cameras[0]]) == 96
    before = env.state()
    up = np.array([0, 0, 0.02, 0, 0, 0, 1], np.float32)
    for _ in range(5):
        env.step(up)
    after = env.state()
    assert after[2] > before[2] + 0.005
    assert env.time_s == pytest.approx(5 / env.hz)
    assert not env.truth().touched
    env.reset(row)
    assert np.array_equal(env.state(), before)
    assert np.array_equal(env.observe().images[cameras[0]], first.images[cameras[0]])
    for _ in range(5):
        env.step(up)
    assert np.array_equal(env.state(), after)
    assert str(np.random.get_state()) == stream  # noqa: NPY002
    scene.close()


def test_without_ground_truth_an_outcome_says_nothing_of_objects() -> None:
    (row,) = rows_of("widowx-pick", "pick-straw-cup")
    judge = Judge.start(replace(row, rule="official"), {}, NOTHING).step(NOTHING)
    assert not judge.over
    ended = judge.step(replace(NOTHING, succeeded=True))
    assert ended.done
    outcome = ended.outcome()
    assert outcome.success
    assert outcome.wrong_object is outcome.first_object_correct is outcome.cmr is None


def test_what_is_absent_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libero, "find_spec", lambda name: None)
    libero.find_object.cache_clear()
    suites.benchmark.cache_clear()
    with pytest.raises(MissingPart, match="make libero"):
        get_object("red_coffee_mug_1")
    assert len(suites.benchmark(TASK[0])) == 11 * libero.STATES  # tables of results can be read
    libero.find_object.cache_clear()


@needs_libero
def test_a_list_has_every_official_state_with_each_target_in_turn() -> None:
    for name in libero.SUITES:
        for task, personal in zip(suites.suite(name).tasks, libero.PERSONAL[name], strict=True):
            listed = suites.rows(name, task.name)
            assert [row.episode for row in listed] == [*range(libero.STATES)]
            assert {row.target for row in listed} == {personal.target}
            assert len(libero.initial_states(personal.problem)) == libero.STATES


@needs_libero
def test_the_expert_and_the_scripted_policy_reach_the_official_goal() -> None:
    rows = rows_of(*TASK)
    scene, suite = scene_of(rows), suites.suite(TASK[0])
    expert = make_policy("expert", scene, suite, None)
    (episode,) = rollout(Trial("generic", scene, expert, generic()), rows)
    assert episode.outcome.success, episode.outcome
    assert episode.outcome.first_object_correct
    (camera,) = open_env(scene, suite.cameras[:1]).cameras()
    scripted = PlacedScripted(scene.robot, suite.hz, camera, scene.sizes_m)
    assert isinstance(scripted.localizer, TruePlaces)
    scene.close()


PUSHER = """
from vap_core.environments.gym import Map

MAP = Map(
    name="pusher",
    id="Pusher-v5",
    category="puck",
    target="my-puck",
    instruction="push my puck to the goal",
    hz=20.0,
    max_steps=4,
    images={"front": lambda seen, drawn: drawn},
    state=lambda seen: seen,
    success=lambda reward, ended, info: info["reward_dist"] > -0.1,
    episodes=2,
)
SUITE, rows = MAP.suite(), MAP.rows
"""


@pytest.fixture
def pusher(tmp_path: Path) -> Iterator[Study]:
    """Gymnasium's own environment, which knows nothing of objects."""
    pytest.importorskip("imageio", reason="Gymnasium's MuJoCo environments draw with imageio")
    file = tmp_path / "pusher.py"
    file.write_text(PUSHER)
    yield Study((("pusher", "puck"),), ("generic",), policy="random", suite_files=(str(file),))
    del suites.own.OPENED["pusher"]


def test_any_gymnasium_environment_is_a_suite(pusher: Study, tmp_path: Path) -> None:
    rows = pusher.rows("pusher", "puck")
    trial = make_trial(pusher, rows, "generic", tmp_path)
    assert isinstance(trial.scene, World)
    first, again = (list(rollout(trial, rows, keep_images=True)) for _ in range(2))
    for episode, same in zip(first, again, strict=True):
        assert episode.outcome.status == "failure"
        assert episode.outcome.cmr is episode.outcome.wrong_object is None
        assert [frame.images["front"].shape for frame in episode.frames] == [(256, 256, 3)] * 5
        assert np.array_equal(episode.frames[-1].state, same.frames[-1].state)
    assert not np.array_equal(first[0].frames[0].state, first[1].frames[0].state)


def test_what_needs_ground_truth_says_so(pusher: Study, tmp_path: Path) -> None:
    rows = pusher.rows("pusher", "puck")
    trial = make_trial(pusher, rows, "generic", tmp_path)
    prompter = generic()
    prompter.needs_truth = "start"
    with pytest.raises(BadStudy, match="pusher has no ground truth"):
        list(rollout(replace(trial, prompter=prompter), rows, keep_images=True))
    with pytest.raises(BadStudy, match="no scripted motion"):
        make_trial(replace(pusher, policy="expert"), rows, "generic", tmp_path)
