"""What a rollout needs of any environment, and the adapters of other libraries' environments.

Our own simulator's is `simulation.env.Env`. A suite names its environment (Suite.environment).
"""

from collections.abc import Callable, Sequence
from typing import Any

from vap_core.environments import gym, libero
from vap_core.environments.protocol import Environment as Environment
from vap_core.environments.protocol import World as World
from vap_core.simulation import suites
from vap_core.simulation.assets import objects
from vap_core.simulation.env import Env
from vap_core.simulation.scenes import Scene
from vap_core.simulation.types import EpisodeRow

type AnyScene = Scene | World
WORLDS: dict[str, Callable[[EpisodeRow], World]] = {
    "libero": libero.LiberoWorld,
    "gym": gym.GymWorld,
}
"""How the world of some rows of one task is made, by the name of its environment."""
suites.ELSEWHERE.update(libero.SUITES)
objects.MAKERS.append(libero.find_object)


def open_env(scene: AnyScene, cameras: Sequence[str], **settings: Any) -> Environment:
    """An environment in which no episode has begun; `settings` are those of our own Env."""
    if isinstance(scene, Scene):
        return Env(scene, cameras=cameras, **settings)
    return scene.open(scene.image_size, cameras)


def open_world(rows: Sequence[EpisodeRow]) -> World:
    """The world of some rows of one task. Raises: MissingPart, where its library is absent."""
    return WORLDS[suites.suite(rows[0].suite).environment](rows[0])
