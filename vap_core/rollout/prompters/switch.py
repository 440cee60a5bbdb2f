"""A tint that changes sides: the target is prompted first, then one of its look-alikes.

The command and the colour stay. Whether the robot follows, and how soon, says how far the tint
steers it (study.logs). A bound, not a result: the masks are the simulator's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from vap_core.attend import Attender, AttendState
from vap_core.base.types import Attended, Event, Rgb, value
from vap_core.rollout.prompters.oracle import Oracle, OraclePrompter
from vap_core.rollout.prompters.protocol import PromptContext, SceneTruth
from vap_core.simulation.types import Observation

EARLY = 0.1
"""The share of an episode's step limit after which an early switch happens."""
SWITCHED = "the tint is switched to "
"""Begins the event of a switch; the name of the object follows."""


@dataclass(frozen=True)
class Switch:
    """When the tint is switched: early, or once the target has moved, and so was grasped."""

    when: Literal["early", "moved"]


@value
class SwitchState:
    """One episode: the state of its prompting, and whether the tint was switched."""

    attend: AttendState
    switched: bool


class SwitchPrompter:
    """Two oracles that know the mask at every step: of the target, then of the look-alike."""

    needs_truth: Literal["never", "start", "always"] = "always"

    def __init__(self, attender: Attender, switch: Switch, alike: frozenset[str]) -> None:
        self.switch = switch
        self.before = OraclePrompter(attender, Oracle("track"), alike)
        self.after = OraclePrompter(attender, Oracle("track", of="look-alike"), alike)

    @property
    def highlights(self) -> bool:
        return self.before.highlights

    @property
    def references(self) -> Mapping[str, tuple[Rgb, ...]]:
        return self.before.references

    def start(
        self, observation: Observation, context: PromptContext
    ) -> tuple[SwitchState, Attended]:
        """Prompt the target. Raises: BadStudy when the episode places no look-alike of it."""
        assert context.truth is not None, "a prompter that needs truth is given it"
        self.after.prompted_object(context.truth.row)
        state, attended = self.before.start(observation, context)
        return SwitchState(state, switched=False), attended

    def steps(
        self,
        states: Sequence[SwitchState],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> list[tuple[SwitchState, Attended]]:
        results = []
        for state, observation, context in zip(states, observations, contexts, strict=True):
            assert context.truth is not None, "a prompter that needs truth is given it"
            switched = state.switched or self._is_time(context.truth)
            oracle = self.after if switched else self.before
            ((attend, attended),) = oracle.steps([state.attend], [observation], [context])
            if switched and not state.switched:
                name = self.after.prompted_object(context.truth.row)
                event = Event(context.truth.step, "WARN", f"{SWITCHED}{name}")
                attended = replace(attended, events=(event, *attended.events))
            results.append((SwitchState(attend, switched), attended))
        return results

    def _is_time(self, truth: SceneTruth) -> bool:
        if self.switch.when == "early":
            return truth.step >= EARLY * truth.row.max_steps
        return truth.row.target in truth.moved
