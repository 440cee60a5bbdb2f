"""Every success rule just met and just missed; CMR, wrong object and first object; re-judging a saved episode."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vap_core.rollout.types import Episode, EpisodeHeader, Frame
from vap_core.simulation.suites.rules import Judge, _lowest_m, _middle, rejudge
from vap_core.simulation.types import REST, ROBOT, EpisodeRow, Placement, Truth
from vap_core.study import logs as traces

TARGET, OTHER, GOAL = "cup-personal", "cup-lookalike-1", "plate-prop"
SIZES = {TARGET: (0.04, 0.03, 0.07), OTHER: (0.04, 0.03, 0.07), GOAL: (0.12, 0.09, 0.012)}
WHERE = {TARGET: (0.30, 0.0), OTHER: (0.30, 0.5), GOAL: (0.30, -0.5)}
LIMIT = 0.025 + 0.075 + 0.10
"""Of the near rule: both half-diagonals and ten centimetres."""


def row(rule, goal=""):
    placements = tuple(
        Placement(name, *WHERE[name], 0.0) for name in (TARGET, OTHER, GOAL) if name != GOAL or goal
    )
    return EpisodeRow("s", "t", 0, 0, "do it", "cup", placements, 60, rule, goal)


PICK, NEAR, PUT, SELECT = row("picked"), row("near", GOAL), row("put", GOAL), row("selected")


def truth(at=None, up=None, contacts=None, touched=(), pressed=None):
    """Everything where it started, but `at` (x, y) and `up` metres for some."""
    poses = {name: np.array([*WHERE[name], 0.0, 1.0, 0, 0, 0]) for name in WHERE}
    for name, xy in (at or {}).items():
        poses[name][:2] = xy
    for name, z in (up or {}).items():
        poses[name][2] = z
    return Truth(
        poses,
        {},
        touched,
        pressed or {},
        {name: frozenset(by) for name, by in (contacts or {}).items()},
    )


def judged(episode, *steps):
    return rejudge(episode, SIZES, [truth(), *steps])


def up(height, by=(ROBOT,)):
    return truth(up={TARGET: height}, contacts={TARGET: by}, touched=(TARGET,))


@pytest.mark.parametrize(
    ("steps", "won"),
    [
        ([up(0.0101)] * 5, True),
        ([up(0.0101)] * 4, False),
        ([up(0.0099)] * 9, False),
        ([up(0.2, by=(ROBOT, OTHER))] * 9, False),
        ([up(0.2, by=())] * 9, False),
        ([*[up(0.0101)] * 4, truth(), up(0.0101)], False),
    ],
    ids=[
        "just met",
        "a step short",
        "a hair too low",
        "leaning on another",
        "thrown",
        "in two parts",
    ],
)
def test_picked(steps, won):
    assert judged(PICK, *steps).outcome().success == won


def test_middle_and_lowest_corner_are_those_of_the_eight_turned_corners():
    rng = np.random.default_rng(0)
    for _ in range(200):
        pose = np.concatenate([rng.normal(size=3), rng.normal(size=4)])
        x, y, z = size = tuple(rng.uniform(0.01, 0.3, 3).tolist())
        corners = np.array(list(product((-x / 2, x / 2), (-y / 2, y / 2), (0.0, z))))
        box = Rotation.from_quat(pose[3:], scalar_first=True).apply(corners) + pose[:3]
        assert np.allclose(_middle(pose, size), box.mean(axis=0), rtol=0, atol=1e-12)
        assert abs(_lowest_m(pose, size) - box[:, 2].min()) < 1e-12


def test_an_episode_may_end_once_the_lift_is_done():
    assert judged(PICK, *[up(0.0501)] * 5).done
    assert not judged(PICK, *[up(0.0501)] * 4).done
    assert not judged(PICK, *[up(0.0101)] * 50).done


def beside(distance, **more):
    x, y = WHERE[GOAL]
    return truth(
        at={TARGET: (x, y + distance), **more.pop("at", {})},
        contacts={TARGET: more.pop("by", (REST,))},
        **more,
    )


@pytest.mark.parametrize(
    ("step", "won"),
    [
        (beside(LIMIT - 0.001), True),
        (beside(LIMIT + 0.001), False),
        (beside(LIMIT - 0.001, at={OTHER: (0.30, -0.5 + LIMIT - 0.001 - 0.18)}), False),
        (beside(LIMIT - 0.001, at={OTHER: (0.30, 0.5 + 0.31)}), False),
        (beside(LIMIT - 0.001, up={OTHER: -0.0201}), False),
        (beside(LIMIT - 0.001, up={OTHER: -0.0199}), True),
        (beside(LIMIT - 0.001, up={TARGET: -0.0201}), False),
        (beside(LIMIT - 0.001, by=(ROBOT,)), True),
        (beside(LIMIT - 0.001, by=()), False),
    ],
    ids=[
        "just met",
        "too far",
        "another is nearer",
        "another moved more",
        "another fell",
        "another sank a little",
        "it fell off the table",
        "in the hand",
        "in the air",
    ],
)
def test_near(step, won):
    assert judged(NEAR, step).outcome().success == won


def test_near_needs_a_move_of_three_centimetres():
    close = replace(
        NEAR,
        placements=tuple(
            replace(p, y=-0.5 + LIMIT + 0.01) if p.model == TARGET else p for p in NEAR.placements
        ),
    )
    start = beside(LIMIT + 0.01)
    assert not rejudge(close, SIZES, [start, beside(LIMIT + 0.01 - 0.0299)]).success
    assert rejudge(close, SIZES, [start, beside(LIMIT + 0.01 - 0.0301)]).success


def on(dx, by=(GOAL,), height=0.012):
    x, y = WHERE[GOAL]
    return truth(at={TARGET: (x + dx, y)}, up={TARGET: height}, contacts={TARGET: by})


def upset(step):
    step.objects_world[GOAL][3:] = (0, 1, 0, 0)
    return step


@pytest.mark.parametrize(
    ("step", "won"),
    [
        (on(0.0779), True),
        (on(0.0781), False),
        (on(0.0, by=(GOAL, ROBOT)), True),
        (on(0.0, by=(GOAL, REST)), False),
        (on(0.0, by=(GOAL, OTHER)), False),
        (on(0.0, by=(ROBOT,)), False),
        (on(0.0, height=0.012 + 0.0199), True),
        (on(0.0, height=0.012 + 0.0201), False),
        (on(0.0, height=-0.036), False),
        (upset(on(0.0)), False),
    ],
    ids=[
        "just met",
        "off the edge",
        "still in the hand",
        "half on the table",
        "on another",
        "above it",
        "on a rim",
        "on a tower",
        "beneath it",
        "the plate is upside down",
    ],
)
def test_put(step, won):
    assert judged(PUT, step).outcome().success == won


def test_put_is_done_when_let_go_and_at_rest():
    assert not judged(PUT, *[on(0.0, by=(GOAL, ROBOT))] * 9).done
    assert judged(PUT, *[on(0.0)] * 5).done
    assert not judged(PUT, *[on(0.0)] * 4).done
    assert not judged(PUT, *[on(0.002 * i) for i in range(9)]).done, "it slides"
    assert not judged(PUT, on(0.0), truth()).outcome().success, "success is read at the end"


def press(name, seconds, *touched):
    return truth(
        touched=touched or (name,), pressed={name: seconds}, contacts={name: (ROBOT, REST)}
    )


@pytest.mark.parametrize(
    ("steps", "won"),
    [
        ([press(TARGET, 0.0101)], True),
        ([press(TARGET, 0.0099)], False),
        ([press(OTHER, 0.002), press(TARGET, 0.5)], False),
        ([press(TARGET, 0.5, OTHER, TARGET)], False),
        ([press(TARGET, 0.5, TARGET, OTHER)], True),
        ([press(TARGET, 0.002), press(OTHER, 0.5)], False),
        ([press(TARGET, 0.002), press(OTHER, 0.5), press(TARGET, 0.5)], False),
        ([press(TARGET, 0.5), press(OTHER, 0.5)], True),
    ],
    ids=[
        "just met",
        "a tap",
        "another first",
        "another first in the same step",
        "another after",
        "a tap, then another",
        "a tap, another, then the press",
        "selected stands",
    ],
)
def test_selected(steps, won):
    out = judged(SELECT, *steps).outcome()
    assert out.success == won
    assert out.cmr is None, "the paper defines none for selection"


def test_success_is_read_at_the_end_and_kept_as_once_and_held():
    dropped = judged(PICK, *[up(0.02)] * 7, truth()).outcome()
    assert (dropped.success, dropped.success_once, dropped.held_steps, dropped.steps) == (
        False,
        True,
        7,
        8,
    )


def moved(name, distance):
    x, y = WHERE[name]
    return truth(at={name: (x + distance, y)})


def test_cmr_is_three_centimetres_of_the_target_at_least_once():
    assert judged(PICK, moved(TARGET, 0.0301), truth()).outcome().cmr
    assert not judged(PICK, moved(TARGET, 0.0299)).outcome().cmr
    assert not judged(PICK, moved(OTHER, 0.1)).outcome().cmr


def test_toppling_in_place_is_moving():
    fallen = truth()
    fallen.objects_world[TARGET][3:] = (np.sqrt(0.5), 0, np.sqrt(0.5), 0)
    assert judged(PICK, fallen).outcome().cmr


def test_wrong_object_is_three_centimetres_of_another_or_a_touch_when_selecting():
    assert judged(PICK, moved(OTHER, 0.0301), truth()).outcome().wrong_object
    assert not judged(PICK, moved(OTHER, 0.0299), truth(touched=(OTHER,))).outcome().wrong_object
    assert not judged(PUT, moved(GOAL, 0.1)).outcome().wrong_object, (
        "the receptacle is no wrong object"
    )
    assert (
        judged(PUT, truth(touched=(GOAL,)), truth(touched=(TARGET,))).outcome().first_object_correct
    ), "nor a wrong first one"
    assert judged(SELECT, truth(touched=(OTHER,))).outcome().wrong_object
    assert not judged(SELECT, truth(touched=(TARGET,))).outcome().wrong_object


def test_what_lies_in_the_goal_already_rides_along_and_is_moved_when_it_is_taken_out():
    episode = replace(PUT, inside=(OTHER,))
    together = truth(at={name: (WHERE[name][0] + 0.04, WHERE[name][1]) for name in (GOAL, OTHER)})
    assert not judged(episode, together).outcome().wrong_object
    assert judged(PUT, together).outcome().wrong_object
    assert judged(episode, moved(OTHER, 0.04)).outcome().wrong_object
    assert not judged(episode, moved(OTHER, 0.02)).outcome().wrong_object
    pushed = judged(episode, moved(GOAL, 0.035)).outcome()
    assert not pushed.wrong_object, "it never got there, and stands still"


def test_first_object_is_the_first_touched_or_moved():
    assert (
        judged(PICK, truth(touched=(TARGET,)), truth(touched=(OTHER,)))
        .outcome()
        .first_object_correct
    )
    assert judged(PICK, moved(TARGET, 0.04)).outcome().first_object_correct
    assert judged(PICK, truth(touched=(TARGET, OTHER))).outcome().first_object_correct
    assert not judged(PICK, truth(touched=(OTHER, TARGET))).outcome().first_object_correct
    assert not judged(PICK, truth()).outcome().first_object_correct, "nothing was touched"


def test_an_error_is_never_a_success():
    out = judged(PICK, *[up(0.02)] * 6).outcome("error", "boom")
    assert (out.status, out.success, out.success_once, out.detail) == ("error", False, True, "boom")


def test_events_tell_the_story_once_and_at_their_step():
    told = []
    judge = Judge.start(PICK, SIZES, truth())
    for step in [truth(), truth(touched=(OTHER,)), moved(OTHER, 0.05), *[up(0.02)] * 5, truth()]:
        judge = judge.step(step)
        told += [(event.frame_index, event.level, event.text) for event in judge.events]
    assert told == [
        (2, "WARN", f"first object: {OTHER}"),
        (3, "WARN", f"moved: {OTHER}"),
        (8, "INFO", f"picked: {TARGET}"),
        (9, "WARN", f"lost after 5 held steps: {TARGET}"),
    ]


def test_the_judge_is_a_value():
    judge = Judge.start(PICK, SIZES, truth())
    judge.step(up(0.02))
    assert (judge.steps, judge.run) == (0, 0)


def test_a_saved_episode_is_judged_alike(tmp_path):
    steps = [truth(), press(TARGET, 0.0123456789, TARGET, OTHER), on(0.01), up(1 / 3)]
    frames = tuple(
        Frame(i, i / 5, {}, {}, {}, (), np.zeros(8, np.float32), np.zeros(7, np.float32), step, ())
        for i, step in enumerate(steps)
    )
    judge = rejudge(PUT, SIZES, steps)
    opening = EpisodeHeader(PUT, "vap", "scripted", 5.0, (), "", "", {}, SIZES)
    traces.write_states(tmp_path, [Episode(opening, frames, judge.outcome(), {})])
    ((key, saved),) = traces.read_states(tmp_path)
    assert key == ("s", "t", "vap", 0, 0)
    again = rejudge(PUT, SIZES, saved)
    assert repr(again.outcome()) == repr(judge.outcome())
    for before, after in zip(steps, saved, strict=True):
        assert all(
            (before.objects_world[name] == after.objects_world[name]).all() for name in SIZES
        )
        assert (before.touched, before.pressed_s, before.contacts) == (
            after.touched,
            after.pressed_s,
            after.contacts,
        )
