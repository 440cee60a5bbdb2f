"""The light of one picture: the scene's own, or brighter or darker."""

import numpy as np

from vap_core.base.types import value

import mujoco  # isort: skip  (cameras has chosen a GL back end)


@value
class Light:
    """What the light of the lamp, and that of the room, are multiplied by."""

    lamp: float = 1.0
    ambient: float = 1.0


PLAIN_LIGHT = Light()


def dim(scene: mujoco.MjvScene, light: Light) -> None:
    """Multiply the light of a picture before it is rendered; the room's is the headlight's."""
    if light.lamp == light.ambient == 1.0:
        return
    for lamp in scene.lights[: scene.nlight]:
        if lamp.headlight:
            lamp.ambient[:] *= np.float32(light.ambient)
        else:
            lamp.diffuse[:] *= np.float32(light.lamp)
