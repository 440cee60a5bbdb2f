"""Where objects stand at the start of an episode: random places at a distance from each other."""

from collections.abc import Sequence

import numpy as np

from vap_core.base.types import value
from vap_core.simulation.assets import objects
from vap_core.simulation.types import Placement

Spot = tuple[float, float]
TRIES = 4000


@value
class Area:
    """A rectangle on the table, metres in the world frame."""

    x0: float
    x1: float
    y0: float
    y1: float

    def at(self, u: float, v: float) -> Spot:
        """The spot at share u of its depth (x) and v of its width (y)."""
        return self.x0 + u * (self.x1 - self.x0), self.y0 + v * (self.y1 - self.y0)


def scatter(
    rng: np.random.Generator,
    area: Area,
    reach_m: Sequence[float],
    fixed: Sequence[tuple[Spot, float]] = (),
    gap_m: float = 0.05,
    tries: int = TRIES,
) -> list[Spot]:
    """One spot in `area` per radius in `reach_m`, with discs of those radii `gap_m` apart.

    They keep the same distance from the `fixed` (spot, radius).
    Raises: ValueError when the area is too small for that, or `tries` too few.
    """
    for _ in range(tries):
        spots = _try_spots(rng, area, reach_m, fixed, gap_m)
        if spots is not None:
            return spots
    raise ValueError(
        f"layout.scatter: {len(reach_m)} objects and {len(fixed)} fixed ones do not fit {area} "
        f"with {gap_m} m between them"
    )


def radius_m(model: str) -> float:
    """Half the diagonal of the box around an object's outline on the table.

    A disc of that radius around the object's spot covers the outline where the spot is the box's
    centre. Of objects with a handle or a strap on one side the spot is the centre of the body's
    base, up to 1 cm beside it.
    """
    x, y, _ = objects.extent_m(objects.get_object(model))
    return 0.5 * float(np.hypot(x, y))


def place(model: str, spot: Spot, yaw: float) -> Placement:
    """A placement rounded as in the lists, to 0.1 mm and 0.1 mrad."""
    return Placement(
        model=model,
        x=round(float(spot[0]), 4),
        y=round(float(spot[1]), 4),
        yaw=round(float(yaw), 4),
    )


def random_yaw(rng: np.random.Generator) -> float:
    """Any yaw, radians."""
    return float(rng.uniform(-np.pi, np.pi))


def place_at_random_yaws(
    rng: np.random.Generator, models: Sequence[str], spots: Sequence[Spot]
) -> list[Placement]:
    """Each model on its spot, at a random yaw."""
    placements = []
    for model, spot in zip(models, spots, strict=True):
        placements.append(place(model, spot, random_yaw(rng)))
    return placements


def scattered(
    rng: np.random.Generator,
    area: Area,
    models: Sequence[str],
    *,
    gap_m: float,
    fixed: Sequence[tuple[Spot, float]] = (),
) -> tuple[Placement, ...]:
    """Each model anywhere in an area at a random yaw; distances as in `scatter`."""
    radii = list(map(radius_m, models))
    spots = scatter(rng, area, radii, fixed=fixed, gap_m=gap_m)
    return tuple(place_at_random_yaws(rng, models, spots))


def nearest_m(spot: Spot, spots: Sequence[Spot]) -> float:
    """The distance to the nearest of `spots`."""
    return min(float(np.hypot(spot[0] - x, spot[1] - y)) for x, y in spots)


def draw_lookalikes(rng: np.random.Generator, stem: str, n: int = 2) -> list[str]:
    """The names of `n` of the personal object's look-alikes, drawn without repeats."""
    names = [model.name for model in objects.lookalikes(stem)]
    return list(map(str, rng.permutation(names)[:n]))


def _try_spots(
    rng: np.random.Generator,
    area: Area,
    reach_m: Sequence[float],
    fixed: Sequence[tuple[Spot, float]],
    gap_m: float,
) -> list[Spot] | None:
    """Spots drawn one after the other, or None when no free one is found.

    The order is random, because the objects that are placed last are more often at the rim.
    """
    taken = list(fixed)
    spots = [(0.0, 0.0)] * len(reach_m)
    for i in rng.permutation(len(reach_m)).tolist():
        spot = _draw_free_spot(rng, area, reach_m[i], taken, gap_m)
        if spot is None:
            return None
        spots[i] = spot
        taken.append((spot, reach_m[i]))
    return spots


def _draw_free_spot(
    rng: np.random.Generator,
    area: Area,
    radius: float,
    taken: Sequence[tuple[Spot, float]],
    gap_m: float,
) -> Spot | None:
    for _ in range(30):
        spot = area.at(*rng.random(2).tolist())
        if _is_free(spot, radius, taken, gap_m):
            return spot
    return None


def _is_free(spot: Spot, radius: float, taken: Sequence[tuple[Spot, float]], gap_m: float) -> bool:
    x, y = spot
    for (a, b), other_radius in taken:
        if not np.hypot(x - a, y - b) > radius + other_radius + gap_m:
            return False
    return True
