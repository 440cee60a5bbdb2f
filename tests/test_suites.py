"""Episode rows and the judge: stable, balanced, clear of each other, in view; every rule just met and just missed."""

import hashlib
import json
from dataclasses import asdict

import numpy as np
import pytest

from vap_core import suites
from vap_core.errors import UnknownName
from vap_core.suites import SUITES, Judge, rows
from vap_core.values import Truth

HASHES = {"widowx-pick": "5ffd241ec1089c2f", "franka-pick": "9ab6f5f161f891d5"}


def digest(name: str) -> str:
    listed = [asdict(row) for task in SUITES[name].tasks for row in rows(name, task.name, 20, 0)]
    return hashlib.sha256(json.dumps(listed, sort_keys=True).encode()).hexdigest()[:16]


@pytest.mark.parametrize("name", sorted(HASHES))
def test_rows_are_the_published_ones(name):
    assert digest(name) == HASHES[name]


@pytest.mark.parametrize("name", sorted(HASHES))
def test_global_seeding_changes_nothing_and_more_rows_keep_the_first(name):
    before = digest(name)
    np.random.seed(1)  # noqa: NPY002
    assert digest(name) == before
    task = SUITES[name].tasks[0].name
    short, long = rows(name, task, 5), rows(name, task, 12)
    assert [asdict(row) for row in short] == [asdict(row) for row in long[:5]]


@pytest.mark.parametrize("name", sorted(HASHES))
def test_target_stands_in_every_place_equally_often(name):
    for task in SUITES[name].tasks:
        places = []
        for row in rows(name, task.name, 30):
            order = np.argsort([place.y for place in row.placements])
            places.append(int(np.flatnonzero(order == 0)[0]))
        assert np.bincount(places, minlength=3).tolist() == [10, 10, 10]


@pytest.mark.parametrize("name", sorted(HASHES))
def test_rows_keep_clear_and_in_reach(name):
    suite = SUITES[name]
    for task in suite.tasks:
        for row in rows(name, task.name, 40, seed=2):
            spots = np.array([[place.x, place.y] for place in row.placements])
            gaps = np.linalg.norm(spots[:, None] - spots[None], axis=2)[np.triu_indices(3, 1)]
            assert gaps.min() >= suite.arrangement.clearance_m
            assert np.linalg.norm(spots, axis=1).max() < (0.40 if suite.robot == "wx250s" else 0.60)
            assert row.target.endswith("-personal")
            assert row.instruction == f"pick up my {row.category}"
            assert row.max_steps == suite.max_steps


def test_unknown_names_list_the_known_ones():
    with pytest.raises(UnknownName, match="known: .*widowx-pick"):
        rows("libero", "pick-cup")
    with pytest.raises(UnknownName, match="known: .*pick-vase"):
        rows("franka-pick", "pick-piano")


def test_an_arrangement_that_cannot_keep_clear_is_refused():
    with pytest.raises(ValueError, match="cannot keep"):
        suites.Arrangement(0.3, 0.1, 0.0, (0.0, 0.02), 0.09)


ROW = rows("widowx-pick", "pick-cup", 1)[0]
TARGET, OTHER, THIRD = (place.model for place in ROW.placements)
START = {place.model: np.array([place.x, place.y, 0.0, 1.0, 0, 0, 0]) for place in ROW.placements}


def truth(lift=0.0, held=(), touched=(), shift=None):
    poses = {name: pose.copy() for name, pose in START.items()}
    poses[TARGET][2] += lift
    for name, dx in (shift or {}).items():
        poses[name][0] += dx
    return Truth(poses, {}, frozenset(touched), frozenset(held))


def judged(*steps):
    judge = Judge.start(ROW, truth())
    for step in steps:
        judge = judge.step(step)
    return judge


UP = truth(lift=0.0101, held=(TARGET,), touched=(TARGET,))
HIGH = truth(lift=0.0501, held=(TARGET,), touched=(TARGET,))


def test_picked_needs_five_steps_in_a_row_above_one_centimetre():
    assert judged(*[UP] * 5).outcome().status == "success"
    assert judged(*[UP] * 4).outcome().status == "failure"
    assert judged(*[UP] * 4, truth(), UP).outcome().status == "failure"
    assert judged(*[truth(lift=0.0099, held=(TARGET,))] * 9).outcome().status == "failure"
    assert judged(*[truth(lift=0.2)] * 9).outcome().status == "failure", "lifted, but not by the robot alone"


def test_success_is_read_at_the_end_and_kept_as_once_and_held():
    dropped = judged(*[UP] * 7, truth()).outcome()
    assert (dropped.success, dropped.success_once, dropped.held_steps, dropped.steps) == (False, True, 7, 8)


def test_an_episode_may_end_once_the_lift_is_done():
    assert judged(*[HIGH] * 5).done
    assert not judged(*[HIGH] * 4).done
    assert not judged(*[UP] * 50).done


def test_cmr_is_three_centimetres_of_the_target_at_least_once():
    assert judged(truth(shift={TARGET: 0.0301}), truth()).outcome().cmr
    assert not judged(truth(shift={TARGET: 0.0299})).outcome().cmr
    assert not judged(truth(shift={OTHER: 0.1})).outcome().cmr


def test_wrong_object_is_three_centimetres_of_any_other():
    assert judged(truth(shift={THIRD: 0.0301}), truth()).outcome().wrong_object
    assert not judged(truth(shift={THIRD: 0.0299}), truth(touched=(THIRD,))).outcome().wrong_object
    assert not judged(truth(shift={TARGET: 0.1})).outcome().wrong_object


def test_first_object_is_the_first_touched_or_moved():
    assert judged(truth(touched=(TARGET,)), truth(touched=(OTHER,))).outcome().first_object_correct
    assert judged(truth(shift={TARGET: 0.04})).outcome().first_object_correct
    assert not judged(truth(touched=(OTHER,)), truth(touched=(TARGET,))).outcome().first_object_correct
    assert not judged(truth(touched=(TARGET, OTHER))).outcome().first_object_correct, "both at once is not the target first"
    assert not judged(truth()).outcome().first_object_correct, "nothing was touched"


def test_an_error_is_never_a_success():
    out = judged(*[UP] * 6).outcome("error", "boom")
    assert (out.status, out.success, out.success_once, out.detail) == ("error", False, True, "boom")


def test_events_tell_the_story_once_and_at_their_step():
    told = []
    judge = Judge.start(ROW, truth())
    for step in [truth(), truth(touched=(OTHER,)), truth(shift={OTHER: 0.05}), *[UP] * 5, truth()]:
        judge = judge.step(step)
        told += [(event.frame_index, event.level, event.text) for event in judge.events]
    assert told == [
        (2, "WARN", f"first object: {OTHER}"),
        (3, "WARN", f"moved: {OTHER}"),
        (8, "INFO", f"picked: {TARGET}"),
        (9, "WARN", f"lost after 5 held steps: {TARGET}"),
    ]


def test_the_judge_is_a_value():
    judge = Judge.start(ROW, truth())
    judge.step(UP)
    assert judge.steps == 0
    assert judge.run == 0
