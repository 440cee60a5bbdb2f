"""The random control: smooth random actions, blind and deaf. What it solves, the task gives away."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from vap_core.base.types import value
from vap_core.policies.protocol import Chunk
from vap_core.simulation.env import Env

KEEP = 0.8
"""Share of one action that goes on in the next."""
MOVE_M_S, TURN_RAD_S, JOINT_RAD_S = 0.20, 0.6, 0.6


@value
class RandomState:
    """The episode's own stream, and the last action."""

    rng: np.random.Generator
    last: Float32[np.ndarray, " a"]


class Random:
    """Wanders at the speed of the expert, the gripper opening and closing."""

    label = "random"
    execute = 1

    def start(self, rng: np.random.Generator) -> RandomState:
        return RandomState(rng, np.zeros(0, np.float32))

    def plan_from_simulation(
        self, states: Sequence[RandomState], envs: Sequence[Env]
    ) -> tuple[list[RandomState], list[Chunk]]:
        after = [
            RandomState(state.rng, _wander(state, env))
            for state, env in zip(states, envs, strict=True)
        ]
        return after, [state.last[None] for state in after]


def _wander(state: RandomState, env: Env) -> Float32[np.ndarray, " a"]:
    moves = (
        [MOVE_M_S] * 3 + [TURN_RAD_S] * 3
        if env.control == "ee"
        else [JOINT_RAD_S] * (env.action_size - 1)
    )
    last = state.last if len(state.last) else np.zeros(env.action_size, np.float32)
    fresh = state.rng.standard_normal(env.action_size) * np.array(
        [*(rate / env.hz for rate in moves), 1.0]
    )
    action = KEEP * last + np.sqrt(1 - KEEP**2) * fresh
    return np.array([*action[:-1], np.clip(0.5 + action[-1], 0.0, 1.0)], np.float32)
