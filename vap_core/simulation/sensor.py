"""What a real desk does to a picture: cameras knocked a little out of place, exposures that differ, and noise; all drawn from the episode."""

import zlib

import numpy as np
from jaxtyping import Float64

from vap_core.base.types import Rgb, value
from vap_core.simulation.types import EpisodeRow


@value
class Sensor:
    """Standard deviations: `jitter_m` and `jitter_rad` of a camera's place and direction, `exposure` in stops, `balance` as a share of the red
    and blue gain, `noise` in grey levels of 255. All zero is a perfect camera that changes nothing.
    """

    jitter_m: float = 0.0
    jitter_rad: float = 0.0
    exposure: float = 0.0
    balance: float = 0.0
    noise: float = 0.0


PERFECT = Sensor()
DESK = Sensor(jitter_m=0.004, jitter_rad=0.012, exposure=0.18, balance=0.03, noise=2.5)
"""A webcam on a clamp, set up again every morning."""


@value
class Stray:
    """How one camera strays in one episode: `shift_m` and `turn` in its own frame (OpenGL axes), and the gains of red, green and blue."""

    shift_m: Float64[np.ndarray, "3"]
    turn: Float64[np.ndarray, "3 3"]
    gain: Float64[np.ndarray, "3"]


def stray(sensor: Sensor, row: EpisodeRow, camera: str) -> Stray:
    """The same row and camera, the same stray."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(
        [row.seed, row.episode, zlib.crc32(f"{row.suite}.{row.task}.{camera}".encode())]
    )
    shift, turn, exposure, tones = (
        rng.standard_normal(3),
        rng.standard_normal(3),
        rng.standard_normal(),
        rng.standard_normal(2),
    )
    gain = 2.0 ** (sensor.exposure * exposure) * (
        1.0 + sensor.balance * np.array([tones[0], 0.0, tones[1]])
    )
    return Stray(
        sensor.jitter_m * shift, Rotation.from_rotvec(sensor.jitter_rad * turn).as_matrix(), gain
    )


def exposed(
    sensor: Sensor, rgb: Rgb, astray: Stray, row: EpisodeRow, camera: str, step: int
) -> Rgb:
    """The picture as the sensor delivers it at control step `step`."""
    if sensor == PERFECT:
        return rgb
    stream = np.random.SFC64(
        [row.seed, row.episode, step, zlib.crc32(f"{row.task}.{camera}".encode())]
    )
    seen = np.random.Generator(stream).standard_normal(rgb.shape, np.float32)
    seen *= np.float32(sensor.noise)
    seen += rgb * astray.gain.astype(np.float32)
    return np.clip(np.rint(seen, out=seen), 0, 255, out=seen).astype(np.uint8)
