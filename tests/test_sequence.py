"""Several steps in one instruction: taken apart, judged one by one, grounded again, brought home in between."""

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pandas as pd
import pytest

from tests.drawn import columns
from vap_core.base.errors import BadInstruction
from vap_core.instruction.expressions import decompose
from vap_core.policies.scripted.expert import Expert
from vap_core.recording import Recorder
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters import generic, unchanged
from vap_core.simulation import homing
from vap_core.simulation.suites import lists
from vap_core.simulation.suites.open_row import build_scene, open_row
from vap_core.simulation.types import Outcome, of_subgoals
from vap_core.study import diagnosis
from vap_core.study.failures import breakdown, breakdown_table

DONE = Outcome("success", True, True, 5, True, False, True, 30)
MISSED = Outcome("failure", False, False, 0, False, True, False, 60)


@pytest.mark.parametrize(
    ("text", "steps"),
    [
        ("bring my cup", ("bring my cup",)),
        (
            "put my brother's camera on the plate, then my owl in the basket",
            ("put my brother's camera on the plate", "put my owl in the basket"),
        ),
        (
            "put my brother's toy into the bowl, and then my pouch",
            ("put my brother's toy into the bowl", "put my pouch into the bowl"),
        ),
        ("select my brother's vase, then my vase", ("select my brother's vase", "select my vase")),
        (
            "Put my cup on the plate. Then put my mug in the basket.",
            ("Put my cup on the plate", "put my mug in the basket"),
        ),
        ("pick up my cup then my mug", ("pick up my cup", "pick up my mug")),
        ("bring my cup and after that my bag", ("bring my cup", "bring my bag")),
        ("First bring my cup, then my mug", ("First bring my cup", "bring my mug")),
        ("Could you bring my cup, then my bag", ("Could you bring my cup", "bring my bag")),
        ("bring Dr. Brown's cup", ("bring Dr. Brown's cup",)),
        ("Bring my cup! Bring my bag!", ("Bring my cup", "Bring my bag")),
        ("Could you bring my cup? Bring my bag?!", ("Could you bring my cup", "Bring my bag")),
        (
            "bring my cup\nbring my bag\r\n\r\nmy pen",
            ("bring my cup", "bring my bag", "bring my pen"),
        ),
        ("bring my cup!\nThen my bag", ("bring my cup", "bring my bag")),
        ("bring my cup?! then my bag", ("bring my cup", "bring my bag")),
        ("bring my cup, then", ("bring my cup",)),
        ("bring my cup; then; my bag", ("bring my cup", "bring my bag")),
    ],
)
def test_an_instruction_is_taken_apart(text, steps):
    assert decompose(text) == steps


def test_it_in_a_later_step_and_no_step_are_one_line_each():
    with pytest.raises(BadInstruction, match="'it' in .* could be any object .*; name the object."):
        decompose("put my cup on the plate, then put it in the basket")
    for nothing in (
        " . ",
        "then",
        "Then.",
        "and then!",
        "after that,",
        "?",
        "\n",
        ", ;",
        "Then\nthen",
    ):
        with pytest.raises(BadInstruction, match="no command in"):
            decompose(nothing)


def test_a_sequence_succeeds_where_every_step_did():
    both = of_subgoals([DONE, DONE], 2, 75)
    assert (both.status, both.success, both.steps, both.cmr) == ("success", True, 75, True)
    first = of_subgoals([DONE, MISSED], 2, 105)
    assert (first.success, first.cmr, first.wrong_object) == (False, False, True)
    assert [each.success for each in first.subgoals] == [True, False]
    assert not of_subgoals([DONE], 2, 30).success
    broken = replace(MISSED, status="error", detail="why")
    assert of_subgoals([DONE, broken], 2, 40).status == "error"


def test_a_stage_is_a_row_of_its_own():
    row = next(row for row in lists.read("shared-sequence") if row.task == "put-plant-scrubber")
    first, second = row.at(0), row.at(1)
    assert (first.target, second.target) == ("plant-lookalike-3", "scrubber-personal")
    assert first.instruction == "put my brother's plant into the plastic bowl"
    assert second.instruction == "put my scrubber into the plastic bowl"
    assert (first.inside, second.inside) == ((), ("plant-lookalike-3",))
    assert sorted(place.model for place in second.placements) == sorted(
        place.model for place in row.placements
    )
    plain = lists.read("tabletop")[0]
    assert plain.at(0) is plain
    assert plain.stages == 1


@pytest.mark.parametrize("name", ["shared-sequence", "shared-sequence-bridge"])
def test_the_hand_comes_home(name):
    with open_row(lists.read(name)[0]) as env:
        home = env.tcp_base()
        rng = np.random.default_rng(0)
        for _ in range(round(env.hz)):
            wander = 0.05 * rng.standard_normal(env.action_size).astype(np.float32)
            wander[-1] = 0.0
            env.step(wander)
        assert np.linalg.norm(env.tcp_base()[:3, 3] - home[:3, 3]) > 0.01
        way = homing.begin(env)
        steps = 0
        while way.part != "there":
            env.step(homing.action(way, env))
            way = homing.advance(way, env)
            steps += 1
        assert steps / env.hz < 3 * homing.PATIENCE_S + 1
        assert np.linalg.norm(env.tcp_base()[:3, 3] - home[:3, 3]) < 0.03
        assert env.state()[6] > 0.9


class Grounding:
    """Notes every command that it is started with, and what it is asked meanwhile."""

    needs_truth = "always"
    highlights = False
    references = MappingProxyType({})

    def __init__(self):
        self.started = []
        self.targets = []

    def start(self, observation, context):
        self.started.append(context.instruction)
        return 1, unchanged(observation.images, f"the red {context.truth.row.category}")

    def steps(self, states, observations, contexts):
        self.targets += [context.truth.row.target for context in contexts]
        return [
            (state + 1, unchanged(observation.images, "again"))
            for state, observation in zip(states, observations, strict=True)
        ]


@pytest.fixture(scope="module")
def episode():
    """An owl on the plate, then an owl in the basket, by the expert, with pictures."""
    row = next(
        row for row in lists.read("shared-sequence-bridge") if row.task == "put-owl-figurines"
    )
    prompter = Grounding()
    with build_scene(row.suite, [place.model for place in row.placements]) as scene:
        trial = Trial("generic", scene, Expert(), prompter, images_every=3)
        (done,) = rollout(trial, [row])
    return done, prompter


def test_the_steps_follow_one_another(episode):
    done, _ = episode
    assert done.outcome.success
    assert [each.success for each in done.outcome.subgoals] == [True, True]
    numbers = [frame.subgoal for frame in done.frames]
    first, last = numbers.index(0), len(numbers) - 1 - numbers[::-1].index(0)
    assert set(numbers[:first]) == {1}
    assert set(numbers[first : last + 1]) == {0}
    assert set(numbers[last + 1 :]) == {2}
    assert len(done.frames) == done.outcome.steps + 1
    summary = done.summary()
    assert (summary["subgoals_done"], summary["subgoal_1"], summary["subgoal_2"]) == (2, 1, 1)


def test_every_step_is_grounded_anew_with_its_own_command(episode):
    done, prompter = episode
    commands = [span.header.instruction for span in done.subgoals]
    assert prompter.started == commands
    assert commands == [subgoal.instruction for subgoal in done.header.row.subgoals]
    assert list(dict.fromkeys(prompter.targets)) == [
        subgoal.target for subgoal in done.header.row.subgoals
    ]
    texts = [event.text for frame in done.frames for event in frame.events]
    assert "sub-goal 1 of 2 ends: success" in texts
    assert f'sub-goal 2 of 2 begins: "{commands[1]}"' in texts


def test_a_step_can_be_read_as_an_episode(episode):
    done, _ = episode
    part = done.part(1)
    assert part.header.row.target == "owl-figurine-personal"
    assert part.frames[-1].action is None
    assert all(frame.action is not None for frame in part.frames[:-1])
    assert len(part.frames) == part.outcome.steps + 1
    assert part.outcome.success


def test_a_recording_has_a_lane_of_sub_goals_and_names_the_owners(episode, tmp_path):
    done, _ = episode
    second = done.subgoals[1]
    path = tmp_path / "sequence.rrd"
    with Recorder(path, done.header, explain=diagnosis.explain) as recorder:
        for frame in done.frames:
            if frame.frame_index == second.first:
                recorder.begin_subgoal(second.header)
            recorder.frame(frame)
        recorder.close(done.outcome)
    lane = columns(path, "/vap/status/subgoal", "StateChange:state")
    home = next(frame.frame_index for frame in done.frames if frame.subgoal == 0)
    assert {step: states[0] for step, states in lane.items()} == {
        0: "1: put my brother's owl figurine on the plate",
        home: "way home",
        second.first: "2: put my owl figurine in the basket",
    }
    pane = columns(path, "/vap/instruction", "TextDocument:text")[None][0]
    assert "**by** anna" in pane
    assert "ben's (anna's brother) owl-figurine-lookalike-2" in pane


def test_the_first_step_that_failed_is_diagnosed(episode):
    done, _ = episode
    missed = replace(done.outcome.subgoals[1], status="failure", success=False)
    outcomes = (done.outcome.subgoals[0], missed)
    failed = replace(done, outcome=of_subgoals(outcomes, 2, done.outcome.steps))
    row = {**failed.summary(), **diagnosis.columns(failed)}
    assert (row["outcome"], row["subgoal"], row["case"]) == ("failure", 2, "unprompted")
    assert row["deciding_frame"] >= failed.subgoals[1].first
    assert diagnosis.columns(done)["case"] == ""
    counts = breakdown(pd.DataFrame([row, {**done.summary(), **diagnosis.columns(done)}]))
    assert counts["sub-goal 2"].tolist() == [1]
    assert "sub-goal 2 % of failures" in breakdown_table(counts)


def test_an_error_after_a_step_that_failed_is_no_failure(episode):
    done, _ = episode
    missed = replace(done.outcome.subgoals[0], status="failure", success=False)
    broken = replace(MISSED, status="error", detail="why")
    ended = replace(done, outcome=of_subgoals([missed, broken], 2, done.outcome.steps))
    found = diagnosis.columns(ended)
    assert (ended.outcome.status, found["case"], found.get("subgoal")) == ("error", "", None)
    assert all(found[f"stage_{stage}"] is None for stage in diagnosis.STAGES)


class Stateless(Grounding):
    """Keeps nothing, and looks at the truth only when it begins."""

    needs_truth = "start"
    calls = ""

    def start(self, observation, context):
        self.calls += "S" if context.truth else "s"
        return None, unchanged(observation.images, "")

    def steps(self, states, observations, contexts):
        self.calls += "T" if contexts[0].truth else "t"
        return [(None, unchanged(seen.images, "")) for seen in observations]


def test_a_prompter_without_a_state_begins_once_a_sub_goal():
    row = lists.read("shared-sequence-bridge")[0]
    first, second = row.subgoals
    short = replace(row, subgoals=(replace(first, max_steps=2), replace(second, max_steps=3)))
    prompter = Stateless()
    with build_scene(row.suite, [place.model for place in row.placements]) as scene:
        rollout_of = rollout(Trial("generic", scene, Expert(), prompter, images_every=1), [short])
        assert len(list(rollout_of)) == 1
    assert prompter.calls == "St" + "Sttt"


def test_an_error_on_the_way_home_leaves_the_sub_goals_that_ended(monkeypatch):
    row = lists.read("shared-sequence-bridge")[0]
    short = replace(row, subgoals=(replace(row.subgoals[0], max_steps=2), row.subgoals[1]))

    def fails(*_):
        raise OSError("the arm is stuck")

    with build_scene(row.suite, [place.model for place in row.placements]) as scene:
        monkeypatch.setattr(homing, "advance", fails)
        (done,) = rollout(Trial("generic", scene, Expert(), generic()), [short])
    assert (done.outcome.status, done.outcome.success) == ("error", False)
    assert "the arm is stuck" in done.outcome.detail
    assert [each.status for each in done.outcome.subgoals] == ["failure"]
    assert done.outcome.steps >= 2


def test_a_step_out_of_time_is_followed_by_the_next():
    row = lists.read("shared-sequence-bridge")[0]
    short = replace(row, subgoals=(replace(row.subgoals[0], max_steps=2), row.subgoals[1]))
    with build_scene(row.suite, [place.model for place in row.placements]) as scene:
        (done,) = rollout(Trial("generic", scene, Expert(), generic()), [short])
    assert [each.success for each in done.outcome.subgoals] == [False, True]
    assert done.outcome.subgoals[0].steps == 2
    assert not done.outcome.success
    assert done.summary()["subgoals_done"] == 1
