"""What a prompter is: it decides what the frozen policy sees and reads."""

from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any, Literal, Protocol, runtime_checkable

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


def checked_steps(returned: object, prompter: object, n: int) -> list[tuple[Any, Attended]]:
    """What `steps` of a prompter returned for `n` episodes.

    Raises: ValueError when it is not a list of one state and one Attended for each episode.
    """
    who = f"prompter {type(prompter).__name__}: steps returned"
    if not isinstance(returned, list | tuple):
        raise ValueError(f"{who} {type(returned).__name__}; return a list, one result per episode")
    if len(returned) != n:
        episodes = "1 episode" if n == 1 else f"{n} episodes"
        raise ValueError(f"{who} {len(returned)} results for {episodes}; return one for each")
    for result in returned:
        is_pair = isinstance(result, list | tuple) and len(result) == 2
        if not is_pair or not isinstance(result[1], Attended):
            raise ValueError(
                f"{who} {type(result).__name__} as a result; return the state and an Attended"
            )
    return [(state, attended) for state, attended in returned]


def unchanged(images: Views, text: str) -> Attended:
    """Images as they are, with `text`."""
    return Attended(
        images=images, text=text, colours=(), tracks={}, groundings={}, events=(), associations=()
    )
