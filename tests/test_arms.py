"""Arms that ask what the policy follows: another command or none, and a tint that changes sides."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.toys import observation
from vap_core.base.errors import BadStudy
from vap_core.evaluation.methods import find, make_prompter, needs_memory, needs_stack
from vap_core.evaluation.study import Study
from vap_core.rollout.prompters.protocol import PromptContext
from vap_core.rollout.prompters.text import OtherCommand
from vap_core.simulation import suites
from vap_core.simulation.scenes import build

TASK = ("simpler-bridge", "put-camera")


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
