"""What a policy is: it maps prompted images, text and proprioception to chunks of actions."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from vap_core.base.types import Views, value
from vap_core.simulation.env import Env

Chunk = Float32[np.ndarray, "t a"]
"""Future actions, one row per control step, with a number for each of `Env.action_names`."""


@value
class PolicyInput:
    """All that a policy may read: images, text and proprioception. Never simulator state.

    `state` is that of simulation.types.Observation.
    """

    images: Views
    text: str
    state: Float32[np.ndarray, " s"]


@runtime_checkable
class Policy[S](Protocol):
    """A frozen policy over a batch of episodes.

    What one episode carries is state, an argument and a result. `plan` leaves the states that it is
    given as they are: where one episode fails a batch, the others are asked again. `label` names it
    wherever its numbers appear. `execute` rows of every chunk are executed before it is called
    again. A rollout needs all four, and ends with an error at a chunk of another shape or type than
    `Chunk`.
    """

    label: str
    execute: int

    def start(self, rng: np.random.Generator) -> S:
        """The state of a new episode; `rng` is that episode's own generator."""
        ...

    def plan(
        self, states: Sequence[S], inputs: Sequence[PolicyInput]
    ) -> tuple[list[S], list[Chunk]]:
        """The next chunk of every episode in the batch."""
        ...


@runtime_checkable
class PrivilegedPolicy[S](Protocol):
    """A stand-in for a policy that reads the simulator instead of images.

    The expert and the random control are such. Their results are bounds, never results of a method.
    """

    label: str
    execute: int

    def start(self, rng: np.random.Generator) -> S:
        """The state of a new episode; `rng` is that episode's own generator."""
        ...

    def plan_from_simulation(
        self, states: Sequence[S], envs: Sequence[Env]
    ) -> tuple[list[S], list[Chunk]]:
        """The next chunk of every episode in the batch."""
        ...
