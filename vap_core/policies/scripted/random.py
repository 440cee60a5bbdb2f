"""The random control: smooth random actions, without images or text.

What it solves, the task gives away.
"""

import copy
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64

from vap_core.base.types import value
from vap_core.policies.protocol import Chunk
from vap_core.simulation.env import Env

KEEP = 0.8
"""Share of one action that goes on in the next."""
MOVE_M_S = 0.20
TURN_RAD_S = 0.6
JOINT_RAD_S = 0.6


@value
class RandomState:
    """The episode's own stream, and the last draw, whose mean is zero."""

    rng: np.random.Generator
    last: Float32[np.ndarray, " a"]


class Random:
    """Moves at random at the speed of the expert, the gripper opening and closing."""

    label = "random"
    execute = 1

    def start(self, rng: np.random.Generator) -> RandomState:
        return RandomState(rng, np.zeros(0, np.float32))

    def plan_from_simulation(
        self, states: Sequence[RandomState], envs: Sequence[Env]
    ) -> tuple[list[RandomState], list[Chunk]]:
        next_states = []
        chunks = []
        for state, env in zip(states, envs, strict=True):
            rng = copy.deepcopy(state.rng)
            drawn = _draw(rng, state.last, env)
            next_states.append(RandomState(rng, drawn))
            chunks.append(_action(drawn)[None])
        return next_states, chunks


def _draw(
    rng: np.random.Generator, last: Float32[np.ndarray, " before"], env: Env
) -> Float32[np.ndarray, " a"]:
    """The next draw: a share of the last one and fresh noise."""
    if not len(last):
        last = np.zeros(env.action_size, np.float32)
    fresh = rng.standard_normal(env.action_size) * _scales(env)
    return (KEEP * last + np.sqrt(1 - KEEP**2) * fresh).astype(np.float32)


def _action(drawn: Float32[np.ndarray, " a"]) -> Float32[np.ndarray, " a"]:
    """The action of a draw; the gripper is as often nearly closed as nearly open."""
    gripper = np.clip(0.5 + drawn[-1], 0.0, 1.0)
    return np.array([*drawn[:-1], gripper], np.float32)


def _scales(env: Env) -> Float64[np.ndarray, " a"]:
    """The deviation of every number of an action."""
    if env.control == "ee":
        rates = [MOVE_M_S] * 3 + [TURN_RAD_S] * 3
    else:
        rates = [JOINT_RAD_S] * (env.action_size - 1)
    return np.array([*(rate / env.hz for rate in rates), 1.0])
