"""Policies: everything that maps prompted images, text and proprioception to chunks of actions."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

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
