"""The contract of a prompter: images of the same size and a text, each episode for itself."""

from typing import Any

import numpy as np

from vap_core.base.types import Attended, Views
from vap_core.contracts.given import short_rows
from vap_core.rollout.prompters import PromptContext, Prompter, SceneTruth, checked_steps
from vap_core.simulation.env import Env
from vap_core.simulation.suites.open_row import open_row
from vap_core.simulation.types import Observation

Step = tuple[Observation, PromptContext]


def step_of(prompter: Prompter[Any], env: Env, number: int) -> Step:
    """What a rollout gives a prompter at this control step: of the truth only what it declares."""
    cameras = {camera.name: camera for camera in env.cameras()}
    truth = None
    needs = prompter.needs_truth
    if needs == "always" or (needs == "start" and number == 0):
        truth = SceneTruth(env.row, env.truth(masks=True).masks, step=number)
    return env.observe(), PromptContext(env.row.instruction, cameras, truth)


def two_steps(prompter: Prompter[Any], where: str) -> list[tuple[Step, Step]]:
    """The first two steps of two episodes."""
    found = []
    for row in short_rows(where, steps=2):
        with open_row(row) as env:
            first = step_of(prompter, env, 0)
            env.step(np.zeros(env.action_size, np.float32))
            found.append((first, step_of(prompter, env, 1)))
    return found


def check_fits(attended: Attended, observation: Observation) -> None:
    assert attended.text
    checked_steps([(None, attended)], "", [observation])


def copies(images: Views) -> Views:
    return {name: image.copy() for name, image in images.items()}


def test_it_says_what_it_reads_and_whether_it_highlights(prompter: Prompter[Any]) -> None:
    assert prompter.needs_truth in ("never", "start", "always")
    assert isinstance(prompter.highlights, bool)
    assert dict(prompter.references) is not None


def test_every_step_has_a_text_and_images_that_fit(prompter: Prompter[Any], where: str) -> None:
    for first, second in two_steps(prompter, where):
        state, attended = prompter.start(*first)
        check_fits(attended, first[0])
        ((_, attended),) = prompter.steps([state], [second[0]], [second[1]])
        check_fits(attended, second[0])


def test_what_it_is_given_stays_as_it_was(prompter: Prompter[Any], where: str) -> None:
    """At the first step and at the next."""
    first, second = two_steps(prompter, where)[0]
    before = [copies(seen.images) for seen, _ in (first, second)]
    state, _ = prompter.start(*first)
    prompter.steps([state], [second[0]], [second[1]])
    for (seen, _), images in zip((first, second), before, strict=True):
        for name, image in seen.images.items():
            assert np.array_equal(image, images[name])


def test_a_batch_equals_one_by_one(prompter: Prompter[Any], where: str) -> None:
    steps = two_steps(prompter, where)
    alone = []
    for first, second in steps:
        state, _ = prompter.start(*first)
        ((_, attended),) = prompter.steps([state], [second[0]], [second[1]])
        alone.append(attended)
    states = [prompter.start(*first)[0] for first, _ in steps]
    observations = [second[0] for _, second in steps]
    contexts = [second[1] for _, second in steps]
    for expected, (_, found) in zip(
        alone, prompter.steps(states, observations, contexts), strict=True
    ):
        assert found.text == expected.text
        for name, image in found.images.items():
            assert np.array_equal(image, expected.images[name])
