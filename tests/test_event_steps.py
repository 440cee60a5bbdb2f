"""The step at which an event of the method is filed, and the margin where a view has no vote."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from vap_core.attend import Attender
from vap_core.base.events import is_lost
from vap_core.base.types import Boxes, PersonalObject, Rgb, Track
from vap_core.perception.protocols import Stack
from vap_core.policies.protocol import PolicyInput
from vap_core.rollout.loop import rollout
from vap_core.rollout.prompters import TintPrompter
from vap_core.rollout.types import Episode
from vap_core.simulation.env import Env
from vap_core.study.trials import Study, make_trial

TASK = ("tabletop", "put-plant")
"""Three cameras."""


def first_view_only(
    images: Sequence[Rgb], phrase: str, threshold: float | None = None
) -> list[Boxes]:
    one = Boxes(np.array([[4, 4, 24, 24]], np.float32), np.ones(1, np.float32), phrase)
    return [one, *[Boxes.empty(phrase) for _ in images[1:]]]


class Alike:
    """Every crop is as like every reference."""

    name = "alike"

    def __call__(self, crops: Sequence[Rgb]) -> np.ndarray:
        return np.tile(np.array([[1, 0]], np.float32), (len(crops), 1))


def whole_box(image: Rgb, boxes: Boxes) -> np.ndarray:
    masks = np.zeros((len(boxes), *image.shape[:2]), bool)
    masks[:, 4:24, 4:24] = True
    return masks


class LosesAtOnce:
    """A tracker whose target is gone at its first step."""

    def start(self, images: Sequence[Rgb], masks: Sequence[np.ndarray]) -> list[int]:
        return [0 for _ in images]

    def step(
        self, states: Sequence[int], images: Sequence[Rgb]
    ) -> tuple[list[int], list[tuple[Track, ...]]]:
        return list(states), [(Track(None, 0.0),) for _ in states]


class Zeros:
    """Four actions of zeros a call."""

    label = "zeros"
    execute = 4

    def __init__(self, size: int) -> None:
        self.size = size

    def start(self, rng: np.random.Generator) -> None: ...

    def plan(
        self, states: Sequence[None], inputs: Sequence[PolicyInput]
    ) -> tuple[list[None], list[np.ndarray]]:
        return list(states), [np.zeros((self.execute, self.size), np.float32) for _ in inputs]


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> Episode:
    study = Study((TASK,), ("generic",), policy="random")
    row = replace(study.rows(*TASK)[0], max_steps=6)
    trial = make_trial(study, [row], "generic", tmp_path_factory.mktemp("bank"))
    stack = Stack("toy", first_view_only, Alike(), whole_box, LosesAtOnce())
    crops = tuple(np.zeros((8, 8, 3), np.uint8) for _ in range(5))
    target = PersonalObject(
        row.target, row.category, np.array([[1, 0]] * 5, np.float32), crops, "alike"
    )
    prompter = TintPrompter(Attender(stack, {row.target: target}))
    policy = Zeros(Env(trial.scene, control=trial.control).action_size)
    (done,) = rollout(replace(trial, prompter=prompter, policy=policy, follow="call"), [row])
    assert done.outcome.status == "failure", done.outcome.detail
    return done


def test_events_have_the_step_of_their_frame_where_images_are_taken_at_calls_only(
    episode: Episode,
) -> None:
    lost = []
    for frame in episode.frames:
        for event in frame.events:
            assert event.frame_index == frame.frame_index, event.text
            if is_lost(event):
                lost.append(frame.frame_index)
    assert lost == [4], "the second call"


def test_a_view_without_candidates_is_no_narrow_vote(episode: Episode) -> None:
    (seen, *blind) = episode.header.groundings
    for camera in blind:
        assert episode.header.groundings[camera][0].ballot.winner is None
    assert (len(blind), episode.summary()["margin"]) == (2, 1.0)
    assert _of_views(episode, blind).summary()["margin"] == 0.0
    assert _of_views(episode, []).summary()["margin"] is None
    assert _of_views(episode, [seen]).summary()["margin"] == 1.0


def _of_views(episode: Episode, cameras: Sequence[str]) -> Episode:
    """The episode as if it had been grounded in these views alone."""
    groundings: Mapping[str, Any] = {name: episode.header.groundings[name] for name in cameras}
    return replace(episode, header=replace(episode.header, groundings=groundings))
