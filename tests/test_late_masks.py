"""True masks that are drawn after an episode, for a recording that is kept after all."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.toys import Kept
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.types import Frame
from vap_core.simulation.cameras import Renderer
from vap_core.simulation.occluder import Occlusion
from vap_core.simulation.types import EpisodeRow, Outcome
from vap_core.study.trials import Study, make_trial

TASK = ("tabletop", "put-plant")
"""Its cameras are displaced in every episode, and one is at the wrist."""


class Waiting(Kept):
    """A sink that draws the masks at the end, or never."""

    def __init__(self, wanted: bool) -> None:
        super().__init__()
        self.wanted = wanted

    def draw_by(self, draw: Callable[[Frame], Frame]) -> None:
        self.draw = draw

    def close(self, outcome: Outcome) -> None:
        assert not any(frame.truth.masks for frame in self.frames)
        if self.wanted:
            self.frames = [self.draw(frame) for frame in self.frames]


@pytest.fixture
def trial_and_rows(tmp_path: Path) -> tuple[Trial, list[EpisodeRow]]:
    study = Study((TASK,), ("generic",), policy="random")
    rows = [replace(row, max_steps=6) for row in study.rows(*TASK)[:2]]
    return make_trial(study, rows, "generic", tmp_path), rows


@pytest.mark.parametrize("occlusion", [None, Occlusion(start=2, frames=3)])
def test_masks_drawn_later_are_those_of_the_time(
    trial_and_rows: tuple[Trial, list[EpisodeRow]], occlusion: Occlusion | None
) -> None:
    trial, rows = trial_and_rows
    trial = replace(trial, occlusion=occlusion)
    at_once = [Kept() for _ in rows]
    later = [Waiting(wanted=True) for _ in rows]
    for sinks in (at_once, later):
        left = iter(sinks)
        list(rollout(trial, rows, lambda header, left=left: next(left), batch=2))  # type: ignore[misc]
    for drawn, waited in zip(at_once, later, strict=True):
        assert len(drawn.frames) == len(waited.frames) > 5
        for one, other in zip(drawn.frames, waited.frames, strict=True):
            assert set(one.truth.masks) == set(other.truth.masks) == set(one.images)
            for camera, masks in one.truth.masks.items():
                assert set(masks) == set(other.truth.masks[camera])
                for name, mask in masks.items():
                    assert np.array_equal(mask, other.truth.masks[camera][name])
                assert np.array_equal(one.truth.hand[camera], other.truth.hand[camera])


def test_an_episode_that_is_dropped_draws_no_masks(
    trial_and_rows: tuple[Trial, list[EpisodeRow]], monkeypatch: pytest.MonkeyPatch
) -> None:
    trial, rows = trial_and_rows

    def drawn(*args: object, **kwargs: object) -> None:
        raise AssertionError("masks were drawn")

    monkeypatch.setattr(Renderer, "masks_and_hand", drawn)
    (episode,) = rollout(trial, rows[:1], lambda header: Waiting(wanted=False))
    assert episode.outcome.status == "failure"
