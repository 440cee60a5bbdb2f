"""Arms that ask what the policy follows: another command or none, and a tint that changes sides."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
import pytest

from tests.test_methods import ALIKE, GREY, LINE, MUG, RED, ROW, TEAL, looking, where
from tests.toys import TOYS, observation, personal
from vap_core.attend import Attender, Prompting
from vap_core.base.errors import BadStudy
from vap_core.policies.protocol import PolicyInput
from vap_core.prompt import tint
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters import (
    SWITCHED,
    OtherCommand,
    PromptContext,
    Switch,
    SwitchPrompter,
    TintPrompter,
)
from vap_core.rollout.types import Frame
from vap_core.simulation import suites
from vap_core.simulation.scenes import build
from vap_core.simulation.suites.open_row import build_scene
from vap_core.simulation.types import Observation
from vap_core.study.logs import switch_columns, switching_lines
from vap_core.study.methods import find, make_prompter, needs_memory, needs_stack
from vap_core.study.trials import Study

TASK = ("simpler-bridge", "put-camera")


class Waiting:
    """A policy that does nothing."""

    label = "waiting"
    execute = 1

    def start(self, rng: np.random.Generator) -> None:
        return None

    def plan(
        self, states: Sequence[None], inputs: Sequence[PolicyInput]
    ) -> tuple[list[None], list[np.ndarray]]:
        still = np.array([[0, 0, 0, 0, 0, 0, 1]], np.float32)
        return list(states), [still] * len(inputs)


def looked(step: int, moved: set[str]) -> tuple[Observation, PromptContext]:
    """What the prompter gets at a step of the toy world."""
    views, context = looking({"front": LINE})
    assert context.truth is not None
    truth = replace(context.truth, step=step, moved=frozenset(moved))
    return views, replace(context, truth=truth)


@pytest.mark.parametrize(
    ("when", "moments", "at"),
    [
        ("early", [(0, {"mug"}), (1, set()), (9, set())], 1),
        ("moved", [(3, {"other"}), (4, {"mug"}), (5, set())], 1),
    ],
)
def test_the_tint_goes_to_a_lookalike_once_and_stays(
    when: Literal["early", "moved"], moments: list[tuple[int, set[str]]], at: int
) -> None:
    """ROW has five steps, so that early is from the first one on."""
    prompter = SwitchPrompter(Attender(TOYS, {"mug": MUG}), Switch(when), ALIKE)
    state, attended = prompter.start(*looked(0, set()))
    assert (attended.images["front"] == tint(LINE, where(LINE, TEAL), RED)).all()
    said = attended.text
    for i, moment in enumerate(moments):
        views, context = looked(*moment)
        ((state, attended),) = prompter.steps([state], [views], [context])
        prompted = GREY if i >= at else TEAL
        assert (attended.images["front"] == tint(LINE, where(LINE, prompted), RED)).all()
        assert attended.text == said
        events = [event for event in attended.events if event.text == f"{SWITCHED}twin"]
        assert [event.frame_index for event in events] == [moment[0]] * (i == at)
    alone = replace(ROW, placements=ROW.placements[:2])
    with pytest.raises(BadStudy, match="places no look-alike of 'mug'"):
        prompter.start(*looking({"front": LINE}, alone))


def test_a_view_without_the_object_is_looked_at_again() -> None:
    """The hand's camera sees it from step 2 on: it is looked for at steps 1, 2, 4 and so on."""
    dark, red = np.zeros_like(LINE), tint(LINE, where(LINE, TEAL), RED)
    for front, wrist, found in (
        (LINE, [dark, LINE, LINE], [None, 2, 3]),
        (LINE, [dark, dark, LINE, LINE], [None, None, None, 4]),
        (dark, [dark, LINE], [None, 2]),
    ):
        started = [
            TintPrompter(Attender(TOYS, {"mug": MUG}, Prompting(relook=again)))
            for again in (True, False)
        ]
        context = PromptContext(ROW.instruction)
        views = observation({"front": front, "wrist": dark})
        state, attended = started[0].start(views, context)
        once, _ = started[1].start(views, context)
        assert ("red" in attended.text) == (front is LINE)
        for seen, at in zip(wrist, found, strict=True):
            views = observation({"front": front, "wrist": seen})
            ((state, attended),) = started[0].steps([state], [views], [context])
            ((once, plain),) = started[1].steps([once], [views], [context])
            assert (attended.images["wrist"] == (seen if at is None else red)).all()
            assert (attended.images["front"] == (red if front is LINE else front)).all()
            assert ("red" in attended.text) == (front is LINE or at is not None)
            assert state.frame_index == once.frame_index
            assert all(event.frame_index == state.frame_index for event in attended.events)
            assert (plain.images["wrist"] == seen).all(), "vap looks once"


def test_reaction_and_obedience_are_read_from_an_episode() -> None:
    """A switch after a tenth of the steps; then the hand is where it is told to be."""
    (row,) = suites.rows(*TASK, 1)
    row = replace(row, max_steps=10)
    mine = personal(row.target, row.category, TEAL)
    with build_scene(TASK[0], [place.model for place in row.placements]) as scene:
        alike = frozenset(name for name in scene.objects if "camera" in name)
        prompter = SwitchPrompter(Attender(TOYS, {row.target: mine}), Switch("early"), alike)
        trial = Trial("switched-early", scene, Waiting(), prompter, image_size=64)
        (episode,) = rollout(trial, [row])
    assert trial.bound
    rival = prompter.after.prompted_object(row)
    found = switch_columns(episode)
    assert found["switched_s"] == pytest.approx(1 / 5)
    assert not found["obeyed"]

    def told(frame: Frame) -> Frame:
        """The hand is over the rival from frame 4 on, which it touches in frame 6."""
        name = rival if frame.frame_index >= 4 else row.target
        touched = (rival,) if frame.frame_index == 6 else ()
        x, y = frame.truth.objects_world[name][:2]
        state = frame.state.copy()
        state[:2] = x, y  # the WidowX stands at the origin
        return replace(frame, state=state, truth=replace(frame.truth, touched=touched))

    played = replace(episode, frames=tuple(map(told, episode.frames)))
    found = switch_columns(played)
    assert found["obeyed"]
    assert found["turned_s"] == pytest.approx((4 - 1) / 5)
    assert switch_columns(replace(played, frames=played.frames[:2])) == {}, "no action follows"
    assert switch_columns(replace(played, frames=played.frames[:3])) != {}
    stays = replace(played, frames=played.frames[:4])
    assert switch_columns(stays) == {
        "switched_s": found["switched_s"],
        "turned_s": None,
        "obeyed": False,
    }
    switched = replace(played.frames[4], events=played.frames[1].events)
    there = replace(played, frames=(switched, played.frames[2], played.frames[5]))
    assert switch_columns(there)["turned_s"] is None, "it was nearer to the rival before the switch"
    stored_before = {**switch_columns(there), "turned_s": 0.0}
    rows = [switch_columns(played), switch_columns(stays), stored_before, {}]
    table = pd.DataFrame(rows).assign(
        suite=TASK[0], task=TASK[1], episode=range(4), seed=0, outcome="failure",
        method=["switched-early"] * 3 + ["oracle-track"],
    )  # fmt: skip
    (line,) = switching_lines(table)
    assert "switched in 3 episodes, obeyed in 33 % [6, 79]; the hand turned in 1" in line
    assert line.endswith("median 0.6 s after the switch")
    assert switching_lines(table[["suite", "method"]]) == []


def test_blank_and_other_commands_leave_pictures_alone(tmp_path: Path) -> None:
    views = {"front": np.full((8, 8, 3), 70, np.uint8)}
    with build("wx250s", []) as scene:
        for suite in (*suites.BENCHMARKS, "simpler-bridge-dev"):
            commands = {task.instruction for task in suites.suite(suite).tasks}
            for task in suites.suite(suite).tasks:
                (row,) = suites.rows(suite, task.name, 1)
                said = {}
                for method in ("blank-text", "other-text"):
                    prompter = make_prompter(method, row, tmp_path, scene, None)
                    state, first = prompter.start(observation(views), PromptContext("x"))
                    ((_, later),) = prompter.steps(
                        [state], [observation(views)], [PromptContext("x")]
                    )
                    assert first.text == later.text
                    assert first.images is later.images is views
                    assert not prompter.highlights
                    said[method] = first.text
                assert said["blank-text"] == ""
                assert said["other-text"] in commands - {row.instruction}


def test_the_command_arms_need_neither_memory_nor_perception() -> None:
    assert find("blank-text") == OtherCommand("blank")
    for method in ("blank-text", "other-text"):
        assert not needs_memory(method)
        assert not needs_stack(method)
    study = Study((TASK,), ("other-text",), policy="scripted")
    with pytest.raises(BadStudy, match="parses its command, and blank-text gives it none"):
        replace(study, methods=("generic", "blank-text"))
