"""What a seed changes at the start of a listed episode: the arm, the objects and the light.

Seed 0 changes nothing: it is the list itself. Every other seed moves each object within the free
space that all layouts keep around it, so that no layout becomes another one. An episode's start
depends on its seed and its layout alone: the variants of a layout start alike.
"""

import zlib
from dataclasses import asdict, dataclass, replace

import numpy as np

from vap_core.simulation.types import EpisodeRow


@dataclass(frozen=True)
class Spread:
    """How far a start may be from its list's: uniform within, in both directions.

    `joints_rad` of every joint, `place_m` of an object along x and along y, `yaw_rad` of its turn;
    the light is multiplied by 1 - `light` to 1 + `light`.
    """

    joints_rad: float = 0.03
    place_m: float = 0.006
    yaw_rad: float = 0.15
    light: float = 0.15


SPREAD = Spread()


def seeded(row: EpisodeRow, seed: int, joints: int) -> EpisodeRow:
    """The row under a seed, for a robot with so many joints."""
    if not seed:
        return replace(row, seed=seed)
    target = row.placements[0]
    layout = f"{row.task} {target.x:g} {target.y:g} {target.yaw:g}"
    rng = np.random.default_rng([seed, zlib.crc32(layout.encode())])
    lamp, ambient = _rounded(rng.uniform(1 - SPREAD.light, 1 + SPREAD.light, 2))
    arm = _rounded(rng.uniform(-SPREAD.joints_rad, SPREAD.joints_rad, joints))
    most = (SPREAD.place_m, SPREAD.place_m, SPREAD.yaw_rad)
    offsets = []
    for _ in row.placements:
        dx, dy, turn = _rounded(rng.uniform(-1, 1, 3) * most)
        offsets.append((dx, dy, turn))
    start = replace(row.start, joints_rad=arm, offsets=tuple(offsets), lamp=lamp, ambient=ambient)
    return replace(row, seed=seed, start=start)


def settings() -> dict[str, float]:
    """The spread as JSON, for the configuration of a run whose seeds are not 0."""
    return asdict(SPREAD)


def _rounded(values: np.ndarray) -> tuple[float, ...]:
    """Rounded as in the lists, to 0.1 mm and 0.1 mrad."""
    return tuple(np.round(values, 4).tolist())
