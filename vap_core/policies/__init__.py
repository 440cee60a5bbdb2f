"""Policies: everything that maps prompted images, text and proprioception to chunks of actions."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from vap_core.sim.env import Env
from vap_core.values import Chunk, PolicyInput


@runtime_checkable
class Policy[S](Protocol):
    """A frozen policy over a batch of episodes; what one episode carries is state, an argument and a result.

    `label` names it wherever its numbers appear. `execute` rows of every chunk are executed before it is asked again.
    """

    label: str
    execute: int

    def start(self, rng: np.random.Generator) -> S:
        """The state of a new episode; `rng` is that episode's own stream."""
        ...

    def plan(self, states: Sequence[S], inputs: Sequence[PolicyInput]) -> tuple[list[S], list[Chunk]]:
        """The next chunk of every episode in the batch."""
        ...


@runtime_checkable
class Insider[S](Protocol):
    """What stands in for a policy but reads the simulator instead of pictures: the expert and the random control. Bounds, never results."""

    label: str
    execute: int

    def start(self, rng: np.random.Generator) -> S:
        """The state of a new episode; `rng` is that episode's own stream."""
        ...

    def plan_inside(self, states: Sequence[S], envs: Sequence[Env]) -> tuple[list[S], list[Chunk]]:
        """The next chunk of every episode in the batch."""
        ...
