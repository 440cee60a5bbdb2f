"""The rules of the failure taxonomy on exact episodes: every sub-case just met and just missed, deciding frames, evidence, confidence."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from tests.test_rules import GOAL, OTHER, SIZES, TARGET, WHERE, row, truth
from vap_core.base import events
from vap_core.base.files import DATA
from vap_core.base.types import Attended, Ballot, Boxes, Grounding, Track
from vap_core.rollout.types import (
    CASES,
    Episode,
    EpisodeHeader,
    Frame,
    MaskCoverage,
    covered_object,
    mask_coverage,
)
from vap_core.simulation.suites.rules import rejudge
from vap_core.simulation.types import REST, ROBOT, Outcome, Truth
from vap_core.study import diagnosis as failures
from vap_core.study.cases import NEIGHBOURS, THRESHOLDS, Thresholds, neighbours
from vap_core.study.diagnosis import diagnose, stages

THIRD = "cup-lookalike-2"
NAN = float("nan")


def view(what, iou=0.0, pixels=500, camera="front", proposal=NAN):
    return MaskCoverage(camera, what, iou, pixels, proposal)


RIGHT = view(TARGET, 0.9, proposal=0.9)
AFAR, NEAR = (0.3, 0.0, 0.5), (0.3, 0.0, 0.08)
"""Where the tcp is: half a metre over the target's foot, and 1 cm over its top."""


def ballot(n):
    zeros = np.zeros(n, np.int64), np.zeros(n, bool)
    return Ballot(*zeros, 0 if n else None, 1.0, 1.0)


def commanded(grip):
    return None if grip is None else np.array([0] * 6 + [grip], np.float32)


def episode(rule, steps, goal="", candidates=1, outcome=None):
    """`steps`: truth, what is shown, where the tcp is, the gripper's command (None at a terminal frame)."""
    known = replace(row(rule, goal), suite="simpler-bridge")
    frames = tuple(
        Frame(
            i,
            i / 5,
            {},
            {},
            {},
            (),
            np.array([*where, 0, 0, 0, 1], np.float32),
            commanded(grip),
            now,
            (),
            tuple(seen),
        )
        for i, (now, seen, where, grip) in enumerate(steps)
    )
    boxes = Boxes(
        np.array([[0, 0, 5, 5]] * candidates, np.float32).reshape(-1, 4),
        np.ones(candidates, np.float32),
        "cup",
    )
    grounding = Grounding(
        camera="front",
        object=TARGET,
        candidates=boxes,
        similarity=np.ones((candidates, 1), np.float32),
        ballot=ballot(candidates),
        winner=0 if candidates else None,
        masks=np.zeros((candidates, 8, 8), bool),
    )
    opening = EpisodeHeader(known, "vap", "p", 5.0, (), "", "", {"front": (grounding,)}, SIZES)
    judged = rejudge(known, SIZES, [frame.truth for frame in frames])
    return Episode(opening, frames, outcome or judged.outcome(), {})


def still(n, seen=(RIGHT,), now=None, where=AFAR, grip=1.0):
    return [(now or truth(), seen, where, grip)] * n


def held(height):
    return truth(up={TARGET: height}, contacts={TARGET: (ROBOT,)}, touched=(TARGET,))


def told(rule, steps, limits=THRESHOLDS, **more):
    found = diagnose(episode(rule, steps, **more), limits)
    assert found is not None
    assert found.sub_case in CASES[found.case]
    return found


def label(found):
    return found.case, found.sub_case, found.frame_index, found.camera


@pytest.mark.parametrize(
    ("opening", "candidates", "sub_case"),
    [
        (view(None, proposal=0.0), 0, "no proposal"),
        (view(None, proposal=0.49), 1, "shifted proposal"),
        (view(OTHER, proposal=0.49), 2, "shifted proposal"),
        (view(OTHER, proposal=0.51), 2, "distractor vote"),
        (view("", proposal=0.51), 1, "poor mask"),
        (view(TARGET, 0.49, proposal=0.51), 1, "poor mask"),
    ],
)
def test_case_1_at_the_opening(opening, candidates, sub_case):
    found = told("picked", still(6, [opening]), candidates=candidates)
    assert label(found) == ("case 1", sub_case, 0, "front")
    assert found.evidence["wrong_share"] == 1.0
    assert sub_case != "distractor vote" or OTHER in found.sentence


def test_a_target_that_is_said_not_to_be_in_view_is_its_own_sub_case():
    before = episode("picked", still(6, [view(None, proposal=0.9)]), candidates=1)
    (grounding,) = before.header.groundings["front"]
    rejected = replace(grounding, winner=None, rejected=0, threshold=1.1)
    silent = replace(before, header=replace(before.header, groundings={"front": (rejected,)}))
    found = diagnose(silent, THRESHOLDS)
    assert label(found) == ("case 1", "not in view", 0, "front")
    assert "too unlike the references" in found.sentence
    assert found.sub_case in CASES["case 1"]
    assert diagnose(before, THRESHOLDS).sub_case == "poor mask"


def test_what_was_chosen_against_the_vote_is_not_called_elected():
    before = episode("picked", still(6, [view(OTHER, proposal=0.9)]), candidates=2)
    (grounding,) = before.header.groundings["front"]
    forced = replace(before.header, groundings={"front": (replace(grounding, winner=1),)})
    found = diagnose(replace(before, header=forced), THRESHOLDS)
    assert f"{OTHER} was chosen against the vote" in found.sentence
    assert f"the vote elected {OTHER}" in diagnose(before, THRESHOLDS).sentence


def test_drift_opens_where_the_track_leaves():
    found = told("picked", still(4) + still(5, [view(OTHER)]))
    assert label(found) == ("case 1", "drift", 4, "front")
    assert f"from step 4 on the track is on {OTHER}" in found.sentence
    lost = told("picked", still(4) + still(5, [view(None)]))
    assert "from step 4 on the track is on nothing" in lost.sentence


def test_a_track_that_stays_on_the_target_drifts_by_covering_it_badly():
    found = told("picked", still(4) + still(5, [view(TARGET, 0.29)]))
    assert label(found) == ("case 1", "drift", 4, "front")
    words = "right at first, from step 4 on the track covers the target badly (IoU 0.29)"
    assert words in found.sentence
    assert TARGET not in found.sentence


def test_no_drift_of_a_published_table_is_told_to_be_onto_its_target():
    """Tables keep the sentences of their day, so every drift is told again from its evidence."""
    drifts = 0
    for path in sorted((DATA / "results").glob("*.parquet")):
        table = pd.read_parquet(path)
        if "case_sentence" not in table:
            continue
        for drift in table[table.sub_case == "drift"].itertuples():
            drifts += 1
            evidence = json.loads(drift.case_evidence)
            shown = evidence[f"shows_{drift.deciding_camera}"]
            names = {"nothing": None, f"nothing in {drift.deciding_camera}": ""}
            if shown.endswith("-personal"):
                shown = TARGET
            seen = view(names.get(shown, shown), evidence["iou"], max(int(evidence["pixels"]), 100))
            found = told("picked", still(4) + still(5, [seen]))
            assert found.sub_case == "drift"
            assert f"is on {TARGET}" not in found.sentence
            assert ("covers the target badly" in found.sentence) == (shown == TARGET)
    assert drifts > 0


def test_a_prompt_that_is_wrong_for_less_than_half_of_the_time_is_no_excuse():
    assert told("picked", still(4) + still(3, [view(OTHER)]) + still(1)).case == "case 3"
    assert told("picked", still(4) + still(4, [view(OTHER)])).case == "case 1"


def test_a_late_drift_onto_what_is_then_touched_is_one():
    steps = [*still(7), *still(1, [view(OTHER)]), *still(2, [view(OTHER)], truth(touched=(OTHER,)))]
    assert label(told("picked", steps)) == ("case 1", "drift", 7, "front")
    assert told("picked", [*still(7), *still(1, [view(None)]), *steps[8:]]).case == "case 3", (
        "lost for a moment is not misled"
    )
    assert told("picked", [*still(7), *still(1, [view(THIRD)]), *steps[8:]]).case == "case 3", (
        "nor is another than the one touched"
    )


def test_an_earlier_brush_of_another_object_does_not_hide_that_the_hand_was_misled():
    taken = truth(touched=(OTHER,))
    brush = still(1, now=truth(touched=(THIRD,)))
    steps = [
        *still(4),
        *brush,
        *still(5),
        *still(1, [view(OTHER)]),
        *still(2, [view(OTHER)], taken),
    ]
    assert label(told("picked", steps)) == ("case 1", "drift", 10, "front")
    steps = [*still(7), *still(2, now=taken), *still(3, [view(OTHER)], taken)]
    assert told("picked", steps).case == "case 3", "it was touched before any prompt was on it"


@pytest.mark.parametrize(("wrong", "frame"), [((3, 2, 6), 7), ((3, 2, 2), 2)])
def test_the_longest_wrong_run_decides_where_the_prompts_are_wrong_as_a_whole(wrong, frame):
    first, between, last = wrong
    steps = still(2) + still(first, [view(OTHER)]) + still(between) + still(last, [view(OTHER)])
    assert label(told("picked", steps)) == ("case 1", "drift", frame, "front")


def test_the_last_wrong_run_decides_where_the_hand_was_misled_late():
    steps = still(2) + still(3, [view(OTHER)]) + still(9) + still(1, [view(OTHER)])
    found = told("picked", [*steps, *still(1, [view(OTHER)], truth(touched=(OTHER,)))])
    assert label(found) == ("case 1", "drift", 14, "front")


def test_what_a_track_does_after_the_touch_is_not_held_against_it_unless_the_hand_follows():
    steps = still(3) + still(3, now=held(0.03)) + still(20, [view(OTHER)])
    assert label(told("picked", steps, candidates=2))[:2] == ("case 3", "slip")
    steps = still(3) + still(1, now=truth(touched=(TARGET,))) + still(9, [view(OTHER)])
    assert label(told("picked", steps))[:2] == ("case 3", "missed grasp")
    assert label(told("picked", [*steps, *still(1, [view(OTHER)], truth(touched=(OTHER,)))])) == (
        "case 1",
        "drift",
        4,
        "front",
    )


def test_a_view_that_hardly_shows_the_target_does_not_count():
    assert told("picked", still(3) + still(6, [view(None, pixels=99)])).case == "case 3"
    assert told("picked", still(3) + still(6, [view(None, pixels=100)])).case == "case 1"
    assert told("picked", still(3) + still(6, [view(OTHER, pixels=0)])).case == "case 1", (
        "but one that highlights another does"
    )


def test_views_that_contradict_each_other_are_case_2():
    apart = [RIGHT, view(OTHER, camera="wrist", proposal=0.8)]
    assert label(told("selected", still(6, apart))) == ("case 2", "views disagree", 0, "wrist")
    both = [RIGHT, view(TARGET, 0.9, camera="wrist", proposal=0.8)]
    found = told("selected", still(2, both) + still(6, apart))
    assert label(found) == ("case 2", "views drift apart", 2, "wrist")
    assert (found.evidence["shows_front"], found.evidence["shows_wrist"]) == (TARGET, OTHER)
    same = [view(OTHER, proposal=0.8), view(OTHER, camera="wrist", proposal=0.8)]
    assert told("selected", still(6, same), candidates=2).case == "case 1", "all wrong together"
    nowhere = [view("", camera=camera, proposal=0.8) for camera in ("front", "wrist")]
    assert told("selected", still(6, nowhere)).case == "case 2", (
        "no object here and no object there are two things"
    )
    blank = [RIGHT, view(None, camera="wrist", proposal=0.8)]
    assert told("selected", still(6, blank)).case == "case 3", (
        "a view left as it is contradicts nothing"
    )


def on(where, height=0.0, by=(REST,)):
    return truth(
        at={TARGET: where},
        up={TARGET: height},
        contacts={TARGET: by},
        touched=(TARGET,) if ROBOT in by else (),
    )


took = truth(up={OTHER: 0.1}, contacts={OTHER: (ROBOT,)}, touched=(OTHER,))


@pytest.mark.parametrize(
    ("rule", "goal", "steps", "sub_case", "frame"),
    [
        ("picked", "", still(3) + still(3, now=held(0.02), grip=0.0) + still(3), "slip", 5),
        ("picked", "", still(3) + still(3, now=held(0.02), grip=0.0) + still(3, grip=1.0), "slip", 5),
        ("put", GOAL, still(3) + still(3, now=held(0.02), grip=0.0) + still(3, grip=1.0), "misplacement", 5),
        ("put", GOAL, still(3) + still(3, now=held(0.02), grip=0.0) + still(3, grip=0.1), "slip", 5),
        ("put", GOAL, still(3) + still(6, now=held(0.02), grip=0.0), "timeout", 8),
        ("picked", "", still(3) + still(2, where=NEAR, grip=0.0) + still(9), "missed grasp", 3),
        ("picked", "", still(3) + still(2, where=AFAR, grip=0.0) + still(9), "timeout", 0),
        ("picked", "", still(3) + still(2, now=truth(touched=(TARGET,)), where=NEAR) + still(9), "missed grasp", 3),
        ("picked", "", still(3) + still(2, where=NEAR) + still(9), "timeout", 3),
        ("picked", "", still(3) + still(2, now=truth(touched=(OTHER,))), "wrong object", 3),
        ("picked", "", still(3) + still(2, now=truth(touched=(OTHER,))) + still(2, where=NEAR), "timeout", 5),
        ("picked", "", still(3) + still(2, now=truth(at={OTHER: (0.3, 0.54)}, touched=(OTHER,))) + still(2, where=NEAR), "collision", 3),
        ("picked", "", still(3) + still(2, now=truth(at={OTHER: (0.3, 0.54)})) + still(3, now=truth(touched=(TARGET,))), "collision", 3),
        ("picked", "", still(3) + still(2, now=truth(at={OTHER: (0.3, 0.52)})) + still(3, now=truth(touched=(TARGET,))), "missed grasp", 5),
        ("picked", "", still(3) + still(3, now=truth(touched=(TARGET,))) + still(2, now=truth(at={OTHER: (0.3, 0.54)})), "missed grasp", 3),
        ("selected", "", still(3) + still(2, now=truth(touched=(OTHER,))), "wrong object", 3),
        ("selected", "", still(3) + still(2, now=truth(touched=(OTHER,))) + still(2, now=truth(touched=(TARGET,))), "collision", 3),
        ("selected", "", still(3) + still(9, where=NEAR), "timeout", 3),
        ("picked", "", [*still(3), *still(5, now=took), *still(1, where=NEAR)], "wrong object", 3),
        ("picked", "", [*still(3), *still(4, now=took), *still(1, where=NEAR)], "collision", 3),
        ("picked", "", [*still(3, grip=0.0), *still(5, now=took), *still(1, where=NEAR)], "collision", 3),
    ],
)  # fmt: skip
def test_case_3(rule, goal, steps, sub_case, frame):
    found = told(rule, steps, goal=goal)
    assert label(found) == ("case 3", sub_case, frame, "")
    assert told(rule, [(now, (), *rest) for now, _, *rest in steps], goal=goal).case == "unprompted"


def test_an_open_hand_beside_the_target_at_time_out_missed_no_grasp():
    """The terminal frame has no action: a zero in its place once read as "closes"."""
    found = told("picked", [*still(5), *still(1, where=NEAR, grip=None)])
    assert label(found) == ("case 3", "timeout", 5, "")
    assert found.confidence == 1.0, "no neighbouring limit makes it a grasp"
    assert label(
        told(
            "picked", [*still(4), *still(1, where=NEAR, grip=0.0), *still(1, where=NEAR, grip=None)]
        )
    ) == ("case 3", "missed grasp", 4, "")
    lost = [*still(3), *still(3, now=held(0.03), grip=0.0), *still(1, grip=None)]
    assert told("picked", lost).sub_case == "slip", "nor does the missing action open the hand"


def test_a_missed_grasp_is_told_with_its_distance_from_the_bounding_box():
    closed = still(2, where=NEAR, grip=0.0)
    beside = told("picked", still(3) + closed).sentence
    assert beside == f"closes beside {TARGET} (10 mm from its bounding box) at step 3"
    inside = still(2, where=(0.3, 0.0, 0.05), grip=0.0)
    around = told("picked", still(3) + inside).sentence
    assert around == f"closes around {TARGET} without touching it at step 3"
    touched = truth(touched=(TARGET,))
    reached = told("picked", still(3) + still(2, now=touched, where=NEAR)).sentence
    assert reached == f"touches but does not grasp {TARGET} (10 mm from its bounding box) at step 3"
    inside = still(2, now=touched, where=(0.3, 0.0, 0.05))
    reached = told("picked", still(3) + inside).sentence
    assert reached == f"touches but does not grasp {TARGET} at step 3"


INSIDE = (0.3, 0.0, 0.05)
"""Where the tcp is: within the target's bounding box."""


def test_a_hand_in_the_bounding_box_that_touches_nothing_has_reached_it():
    words = f"reaches {TARGET} and does not touch it"
    assert told("selected", still(3) + still(3, where=INSIDE)).sentence == f"{words} at step 3"
    strayed = still(1, now=truth(touched=(OTHER,)), where=INSIDE)
    found = told("selected", still(3) + strayed)
    assert found.sentence == f"touches {OTHER} at step 3 and {words}"
    almost = (0.3, 0.0, 0.0742)
    found = told("selected", [*still(3), (truth(touched=(OTHER,)), (RIGHT,), almost, 1.0)])
    assert found.sentence == f"touches {OTHER} at step 3 and {words}", "0.4 cm were once 0 cm"
    beside = told("selected", still(3) + still(3, where=NEAR)).sentence
    assert beside == f"comes no closer to {TARGET} than 1 cm at step 3"
    afar = told("selected", still(3) + still(1, now=truth(touched=(OTHER,)))).sentence
    assert afar == f"touches {OTHER} at step 3 and comes no closer to {TARGET} than 43 cm"


def test_touching_the_goal_is_no_mistake():
    assert (
        told("put", still(3) + still(3, now=truth(touched=(GOAL,))), goal=GOAL).sub_case
        == "timeout"
    )


def test_only_failures_are_diagnosed():
    lifted = episode("picked", still(3) + still(6, now=held(0.06)))
    assert lifted.outcome.success
    assert diagnose(lifted) is None
    assert failures.columns(lifted)["case"] == ""
    broken = episode(
        "picked",
        still(2),
        outcome=Outcome("error", False, False, 0, False, False, False, 2, "boom"),
    )
    assert diagnose(broken) is None
    assert all(cell is None for cell in stages(broken).values())


def test_confidence_is_the_share_of_neighbouring_limits_that_agree():
    sure = told("picked", still(9, [view(OTHER, proposal=0.9)]), candidates=2)
    assert sure.confidence == 1.0
    torn = told("picked", still(9, [view(TARGET, 0.6, proposal=0.9)]) + still(1))
    assert torn.case == "case 3"
    assert torn.confidence == pytest.approx(15 / 16), "an IoU of 0.6 is poor where 0.65 is asked"


def test_every_limit_has_its_neighbours_and_nothing_else():
    assert set(NEIGHBOURS) == set(Thresholds.__dataclass_fields__)
    assert all(low < getattr(THRESHOLDS, name) < high for name, (low, high) in NEIGHBOURS.items())
    assert len({repr(near) for near in neighbours(THRESHOLDS)}) == 2 * len(NEIGHBOURS)


def test_a_row_of_the_table_can_be_read_back():
    cells = failures.columns(episode("picked", still(9, [view(OTHER, proposal=0.9)]), candidates=2))
    assert (
        cells["case"],
        cells["sub_case"],
        cells["deciding_frame"],
        cells["deciding_camera"],
    ) == ("case 1", "distractor vote", 0, "front")
    assert json.loads(cells["case_evidence"])["shows_front"] == OTHER
    assert set(failures.NO_DIAGNOSIS) == {name for name in cells if name in failures.NO_DIAGNOSIS}


def test_the_road_of_an_episode():
    way = stages(episode("picked", still(3) + still(3, now=held(0.02)) + still(3)))
    assert [way[f"stage_{name}"] for name in failures.STAGES] == [True] * 6 + [False]
    way = stages(episode("picked", still(3, [view(OTHER, proposal=0.3)]), candidates=2))
    assert not any(way[f"stage_{name}"] for name in failures.STAGES)
    way = stages(episode("picked", still(3, [])))
    assert [way[f"stage_{name}"] for name in failures.STAGES[:5]] == [None, None, None, None, False]


def test_a_track_is_held_that_is_right_up_to_the_touch():
    steps = still(3) + still(1, now=truth(touched=(TARGET,))) + still(9, [view(OTHER)])
    way = stages(episode("picked", steps))
    assert (way["stage_tracked"], way["track_right"]) == (True, 1.0)


def test_a_view_that_hardly_shows_the_target_has_no_stages():
    wrist = view(OTHER, pixels=20, camera="wrist", proposal=0.0)
    way = stages(episode("picked", still(3, [RIGHT, wrist])))
    assert (way["stage_proposed"], way["stage_voted"], way["stage_masked"]) == (True, True, True)


@pytest.mark.parametrize(
    ("candidates", "margin", "events", "sub_case", "frame"),
    [
        (0, 0.0, (), "nothing found", 0),
        (1, 0.2, (), "narrow vote", 0),
        (
            1,
            1.0,
            events.visibility_events(4, frozenset({("front", 0)}), frozenset()),
            "lost track",
            4,
        ),
        (1, 1.0, (), "no signal", 5),
    ],
)
def test_without_truth_a_failure_stays_unlabelled(candidates, margin, events, sub_case, frame):
    made = episode("picked", still(6), candidates=candidates)
    nowhere = Truth({}, {}, (), {}, {})
    frames = tuple(
        replace(each, truth=nowhere, coverage=(), events=events if i == 4 else ())
        for i, each in enumerate(made.frames)
    )
    grounding = made.header.groundings["front"][0]
    grounding = replace(grounding, ballot=replace(grounding.ballot, margin=margin))
    made = replace(
        made, frames=frames, header=replace(made.header, groundings={"front": (grounding,)})
    )
    found = diagnose(made)
    assert found is not None
    assert (found.case, found.sub_case, found.frame_index, found.confidence) == (
        "unlabelled",
        sub_case,
        frame,
        0.0,
    )
    assert found.evidence["margin"] == margin
    assert stages(made)["stage_touched"] is None


def test_without_truth_not_in_view_is_a_signal():
    made = episode("picked", still(6))
    nowhere = Truth({}, {}, (), {}, {})
    frames = tuple(replace(each, truth=nowhere, coverage=()) for each in made.frames)
    (grounding,) = made.header.groundings["front"]
    rejected = replace(grounding, winner=None, rejected=0, threshold=1.1)
    header = replace(made.header, groundings={"front": (rejected,)})
    found = diagnose(replace(made, frames=frames, header=header))
    assert found is not None
    assert label(found) == ("unlabelled", "not in view", 0, "front")
    assert "not in view, cosine 1.00 below 1.10" in found.sentence


SQUARE = np.zeros((20, 20), bool)
SQUARE[2:6, 2:6] = True
BESIDE = np.roll(SQUARE, 8, axis=1)


def attended(mask, xyxy):
    boxes = Boxes(np.array(xyxy, np.float32).reshape(-1, 4), np.ones(len(xyxy), np.float32), "cup")
    n = len(boxes)
    masks = np.zeros((n, 20, 20), bool)
    grounding = Grounding(
        "front",
        TARGET,
        boxes,
        np.ones((n, 1), np.float32),
        ballot(n),
        0 if n else None,
        masks,
    )
    return Attended({}, "", (), {"front": (Track(mask, 1.0),)}, {"front": (grounding,)}, ())


def seen_by(masks):
    return Truth(
        {name: np.array([*WHERE[name], 0.0, 1.0, 0, 0, 0]) for name in WHERE},
        {},
        (),
        {},
        {},
        {"front": masks},
    )


@pytest.mark.parametrize(
    ("mask", "what", "iou"),
    [
        (SQUARE, TARGET, 1.0),
        (BESIDE, OTHER, 0.0),
        (np.roll(SQUARE, 4, axis=0), "", 0.0),
        (None, None, 0.0),
        (SQUARE & False, None, 0.0),
    ],
)
def test_what_a_mask_covers(mask, what, iou):
    (found,) = mask_coverage(
        attended(mask, [[2, 2, 6, 6]]),
        seen_by({TARGET: SQUARE, OTHER: BESIDE}),
        TARGET,
        opening=False,
    )
    assert (found.camera, found.object, found.iou, found.pixels) == ("front", what, iou, 16)
    assert np.isnan(found.proposal)


@pytest.mark.parametrize(
    ("xyxy", "best"),
    [
        ([[2, 2, 6, 6]], 1.0),
        ([[10, 2, 14, 6], [2, 2, 6, 4]], 0.5),
        ([[10, 2, 14, 6]], 0.0),
        ([], 0.0),
    ],
)
def test_the_best_proposal_counts_at_the_opening(xyxy, best):
    (found,) = mask_coverage(
        attended(SQUARE, xyxy), seen_by({TARGET: SQUARE, OTHER: BESIDE}), TARGET, opening=True
    )
    assert found.proposal == pytest.approx(best)


def test_a_method_that_finds_nothing_first_has_no_proposal():
    without = replace(attended(SQUARE, []), groundings={})
    (found,) = mask_coverage(without, seen_by({TARGET: SQUARE}), TARGET, opening=True)
    assert found.object == TARGET
    assert np.isnan(found.proposal)
    nothing = replace(without, tracks={"front": ()})
    assert mask_coverage(nothing, seen_by({TARGET: SQUARE}), TARGET, opening=True) == ()


def test_a_mask_belongs_to_what_most_of_it_covers():
    half = SQUARE | np.roll(SQUARE, 4, axis=0)
    assert covered_object(half, {TARGET: SQUARE, OTHER: BESIDE}) == TARGET
    assert covered_object(half | np.roll(SQUARE, 8, axis=0), {TARGET: SQUARE, OTHER: BESIDE}) == ""
    assert covered_object(SQUARE, {}) == ""
