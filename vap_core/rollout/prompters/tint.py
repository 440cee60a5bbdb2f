"""The method as a prompter: an Attender in the loop."""

from collections.abc import Mapping, Sequence
from typing import Literal

from vap_core.attend import Attender, AttendState
from vap_core.base.types import Attended, Rgb
from vap_core.rollout.prompters.protocol import PromptContext
from vap_core.simulation.types import Observation


class TintPrompter:
    """Grounds, tracks and tints by an `Attender`; it reads nothing of the simulator."""

    needs_truth: Literal["never", "start", "always"] = "never"

    def __init__(self, attender: Attender) -> None:
        self.attender = attender

    @property
    def highlights(self) -> bool:
        return self.attender.prompting.highlight

    @property
    def references(self) -> Mapping[str, tuple[Rgb, ...]]:
        return self.attender.references

    def start(
        self, observation: Observation, context: PromptContext
    ) -> tuple[AttendState, Attended]:
        return self.attender.start(observation.images, context.instruction, cameras=context.cameras)

    def steps(
        self,
        states: Sequence[AttendState],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> list[tuple[AttendState, Attended]]:
        views = [observation.images for observation in observations]
        return self.attender.steps(states, views)
