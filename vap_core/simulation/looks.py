"""How things look: a variant's room, its light, and the errors of real cameras.

Displaced mounts, different exposures and noise are all drawn from the episode. This module loads no
simulator.
"""

import zlib
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from vap_core.base.types import Rgb, value
from vap_core.simulation.types import EpisodeRow

if TYPE_CHECKING:
    import mujoco


@value
class Sensor:
    """Standard deviations of a camera's errors.

    `jitter_m` and `jitter_rad` of its place and direction, `exposure` in stops, `balance` as a
    share of the red and blue gain, `noise` in grey levels of 255. All zero is a perfect camera that
    changes nothing.
    """

    jitter_m: float = 0.0
    jitter_rad: float = 0.0
    exposure: float = 0.0
    balance: float = 0.0
    noise: float = 0.0


PERFECT = Sensor()
WEBCAM = Sensor(jitter_m=0.004, jitter_rad=0.012, exposure=0.18, balance=0.03, noise=2.5)
"""A webcam on a clamp that is mounted again every day."""


@value
class Disturbance:
    """The errors of one camera in one episode.

    `shift_m` and `turn` in its own frame (OpenGL axes), and the gains of red, green and blue.
    """

    shift_m: Float64[np.ndarray, "3"]
    turn: Float64[np.ndarray, "3 3"]
    gain: Float64[np.ndarray, "3"]


def draw_disturbance(sensor: Sensor, row: EpisodeRow, camera: str) -> Disturbance:
    """The disturbance that `row` and `camera` determine."""
    from scipy.spatial.transform import Rotation

    name = zlib.crc32(f"{row.suite}.{row.task}.{camera}".encode())
    rng = np.random.default_rng([row.seed, row.episode, name])
    shift = rng.standard_normal(3)
    turn = rng.standard_normal(3)
    exposure = rng.standard_normal()
    tones = rng.standard_normal(2)
    balance = 1.0 + sensor.balance * np.array([tones[0], 0.0, tones[1]])
    return Disturbance(
        shift_m=sensor.jitter_m * shift,
        turn=Rotation.from_rotvec(sensor.jitter_rad * turn).as_matrix(),
        gain=2.0 ** (sensor.exposure * exposure) * balance,
    )


def apply_sensor(
    sensor: Sensor, rgb: Rgb, disturbance: Disturbance, row: EpisodeRow, camera: str, step: int
) -> Rgb:
    """The picture as the sensor delivers it at control step `step`."""
    if sensor == PERFECT:
        return rgb
    name = zlib.crc32(f"{row.task}.{camera}".encode())
    stream = np.random.SFC64([row.seed, row.episode, step, name])
    picture = np.random.Generator(stream).standard_normal(rgb.shape, np.float32)
    picture *= np.float32(sensor.noise)
    picture += rgb * disturbance.gain.astype(np.float32)
    np.rint(picture, out=picture)
    np.clip(picture, 0, 255, out=picture)
    return picture.astype(np.uint8)


Colour3 = tuple[float, float, float]


@value
class SceneStyle:
    """The look of the room; colours are linear 0..1.

    `planks` are the table's light and dark wood, or one colour twice for a plain top; `grain` is
    the seed of its boards. `lamp_pos_m` and `lamp` place and dim the one lamp, `ambient` is the
    fill light; `shadows` are off because they triple the frame time. `robot` multiplies every
    colour of the robot; `camera_shift_m` moves the fixed cameras, in the frame of the body that
    carries them, while they look at the same point.
    """

    planks: tuple[Colour3, Colour3] = ((0.80, 0.69, 0.55), (0.70, 0.58, 0.44))
    grain: int = 7
    wall: Colour3 = (0.73, 0.76, 0.78)
    floor: Colour3 = (0.43, 0.42, 0.42)
    lamp_pos_m: tuple[float, float, float] = (0.9, -0.6, 1.8)
    lamp: float = 0.55
    ambient: float = 0.38
    shadows: bool = False
    robot: Colour3 = (1.0, 1.0, 1.0)
    camera_shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


DEFAULT_STYLE = SceneStyle()


@value
class Light:
    """What the light of the lamp, and that of the room, are multiplied by."""

    lamp: float = 1.0
    ambient: float = 1.0


PLAIN_LIGHT = Light()


def dim(scene: "mujoco.MjvScene", light: Light) -> None:
    """Multiply the light of a picture before it is rendered; the room's is the headlight's."""
    if light.lamp == light.ambient == 1.0:
        return
    for lamp in scene.lights[: scene.nlight]:
        if lamp.headlight:
            lamp.ambient[:] *= np.float32(light.ambient)
        else:
            lamp.diffuse[:] *= np.float32(light.lamp)
