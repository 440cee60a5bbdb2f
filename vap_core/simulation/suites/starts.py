"""What a seed changes at the start of a listed episode: the arm, the objects and the light.

Seed 0 changes nothing: it is the list itself. Every other seed moves each object within the free
space that all layouts keep around it, so that no layout becomes another one. Where an episode has
several receptacles (shared-sequence-bridge), these may stand closer together than that, and stay in
their places. What a list's own start changes remains, and the seed's change comes on top of it. The
seed's change depends on the seed and the layout alone: the variants of a layout start alike.
"""

import zlib
from dataclasses import asdict, dataclass, replace

import numpy as np

from vap_core.simulation.types import EpisodeRow, Start


@dataclass(frozen=True)
class Spread:
    """How far a seed's start may be from the list's: uniform within, in both directions.

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
    standing = _standing(row)
    offsets = []
    for place in row.placements:
        dx, dy, turn = _rounded(rng.uniform(-1, 1, 3) * most)
        offsets.append((0.0, 0.0, 0.0) if place.model in standing else (dx, dy, turn))
    change = Start(joints_rad=arm, offsets=tuple(offsets), lamp=lamp, ambient=ambient)
    return replace(row, seed=seed, start=_on_top(row.start, change))


def settings() -> dict[str, float]:
    """The spread as JSON, for the configuration of a run whose seeds are not 0."""
    return asdict(SPREAD)


def _standing(row: EpisodeRow) -> frozenset[str]:
    """The objects that no seed moves: the receptacles, where there are several."""
    receptacles = {subgoal.goal for subgoal in row.subgoals if subgoal.rule == "put"}
    return frozenset(receptacles) if len(receptacles) > 1 else frozenset()


def _on_top(listed: Start, change: Start) -> Start:
    """A list's start with a seed's change: angles and offsets are added, light is multiplied."""
    joints = change.joints_rad
    if listed.joints_rad:
        joints = _sum(listed.joints_rad, change.joints_rad)
    offsets = change.offsets
    if listed.offsets:
        sums = []
        for one, other in zip(listed.offsets, change.offsets, strict=True):
            dx, dy, turn = _sum(one, other)
            sums.append((dx, dy, turn))
        offsets = tuple(sums)
    return replace(
        listed,
        joints_rad=joints,
        offsets=offsets,
        lamp=listed.lamp * change.lamp,
        ambient=listed.ambient * change.ambient,
    )


def _sum(one: tuple[float, ...], other: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(np.add(one, other).tolist())


def _rounded(values: np.ndarray) -> tuple[float, ...]:
    """Rounded as in the lists, to 0.1 mm and 0.1 mrad."""
    return tuple(np.round(values, 4).tolist())
