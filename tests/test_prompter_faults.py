"""What a prompter does wrong is the error of its episode; the others go on."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import pytest

from vap_core.base.types import Attended, Rgb
from vap_core.evaluation.study import Study
from vap_core.evaluation.trials import make_trial
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters.protocol import PromptContext, checked_steps, unchanged
from vap_core.simulation.types import Observation

STUDY = Study((("simpler-bridge", "pick-shaver"),), ("generic",), policy="random", episodes=3)
ROWS = tuple(replace(row, max_steps=3) for row in STUDY.rows("simpler-bridge", "pick-shaver"))
Result = tuple[int, Attended]
Change = Callable[[list[Result], int], object]


class Faulty:
    """Leaves everything as it is, then does something wrong with the second episode's result."""

    needs_truth = "never"
    highlights = False
    references: Mapping[str, tuple[Rgb, ...]] = {}

    def __init__(self, change: Change) -> None:
        self.change = change
        self.begun = 0

    def start(self, observation: Observation, context: PromptContext) -> Result:
        self.begun += 1
        return self.begun, unchanged(observation.images, context.instruction)

    def steps(
        self,
        states: Sequence[int],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> object:
        results = []
        for state, observation, context in zip(states, observations, contexts, strict=True):
            results.append((state, unchanged(observation.images, context.instruction)))
        return self.change(results, states.index(2)) if 2 in states else results


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Trial:
    made = make_trial(STUDY, ROWS, "generic", tmp_path_factory.mktemp("bank"))
    return replace(made, images_every=1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda all_, i: all_[:i] + all_[i + 1 :], "0 results for 1 episode; return one for each"),
        (lambda all_, i: [*all_, all_[i]], "2 results for 1 episode; return one for each"),
        (lambda all_, i: None, "NoneType; return a list, one result per episode"),
        (lambda all_, i: [*all_[:i], 7, *all_[i + 1 :]], "int as a result; return the state and"),
        (
            lambda all_, i: [*all_[:i], (2, None), *all_[i + 1 :]],
            "tuple as a result; return the state and an Attended",
        ),
    ],
)
def test_a_fault_is_the_error_of_its_episode(trial: Trial, change: Change, message: str) -> None:
    faulty = replace(trial, prompter=Faulty(change))
    one, bad, other = rollout(faulty, ROWS, batch=3)
    statuses = [each.outcome.status for each in (one, bad, other)]
    assert statuses == ["failure", "error", "failure"]
    assert [each.outcome.steps for each in (one, bad, other)] == [3, 1, 3]
    last = bad.outcome.detail.strip().splitlines()[-1]
    assert re.search(f"^ValueError: prompter Faulty: steps returned {message}", last)


def test_a_prompter_that_errs_in_batches_alone_is_asked_one_by_one(trial: Trial) -> None:
    faulty = Faulty(lambda results, i: results if len(results) == 1 else [])
    episodes = rollout(replace(trial, prompter=faulty), ROWS, batch=3)
    assert [episode.outcome.status for episode in episodes] == ["failure"] * 3


def test_the_number_of_episodes_is_in_the_message() -> None:
    line = "prompter Faulty: steps returned 0 results for 2 episodes; return one for each"
    with pytest.raises(ValueError, match=line):
        checked_steps([], Faulty(lambda results, i: results), 2)
