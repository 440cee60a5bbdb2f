"""What a prompter is: it decides what the frozen policy sees and reads."""

from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Literal, Protocol, runtime_checkable

from vap_core.base.types import Attended, Camera, Mask, Rgb, Views, value
from vap_core.simulation.types import EpisodeRow, Observation

Masks = Mapping[str, Mapping[str, Mask]]
"""`masks[camera][object]`: visible pixels, as in simulation.types.Truth."""


@value
class SceneTruth:
    """Ground truth of one step, for prompters that declare `needs_truth`.

    `step` counts the control steps that were taken, `moved` names the objects that moved so far
    (simulation.suites.rules).
    """

    row: EpisodeRow
    masks: Masks
    step: int = 0
    moved: frozenset[str] = frozenset()


@value
class PromptContext:
    """What a prompter knows besides the observation.

    `cameras` are the calibrated cameras at this moment, by name. `truth` is there only for a
    prompter that declares it.
    """

    instruction: str
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    truth: SceneTruth | None = None


@runtime_checkable
class Prompter[S](Protocol):
    """Turns observations into what the policy sees and reads.

    What one episode carries is state, an argument and a result. `needs_truth` says when it reads
    the simulator: "never", at the "start", or "always"; one that does is a bound on results, never
    a result. `highlights` says whether it changes pixels inside tracked masks, so that the masks'
    coverage is recorded. `references` are the remembered crops of its objects, by name, for
    recordings.
    """

    needs_truth: Literal["never", "start", "always"]

    @property
    def highlights(self) -> bool: ...

    @property
    def references(self) -> Mapping[str, tuple[Rgb, ...]]: ...

    def start(self, observation: Observation, context: PromptContext) -> tuple[S, Attended]:
        """The first step of an episode."""
        ...

    def steps(
        self,
        states: Sequence[S],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> list[tuple[S, Attended]]:
        """The next step of every episode of a batch.

        The result for one does not depend on the others.
        """
        ...


def unchanged(images: Views, text: str) -> Attended:
    """Images as they are, with `text`."""
    return Attended(
        images=images, text=text, colours=(), tracks={}, groundings={}, events=(), associations=()
    )
