"""Where things stand at the start of an episode: drawn places that keep clear of each other."""

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
    """One spot in `area` per radius in `reach_m`, so that discs of those radii keep `gap_m` apart, and from the `fixed` (spot, radius).

    Raises: ValueError when the area is too small for that, or `tries` too few.
    """
    for _ in range(tries):
        taken, found = list(fixed), dict.fromkeys(range(len(reach_m)), (0.0, 0.0))
        for i in rng.permutation(
            len(reach_m)
        ).tolist():  # whoever is placed last gets the rim more often
            spot = _free(rng, area, reach_m[i], taken, gap_m)
            if spot is None:
                break
            found[i] = spot
            taken.append((spot, reach_m[i]))
        else:
            return list(found.values())
    raise ValueError(
        f"layout.scatter: {len(reach_m)} objects and {len(fixed)} fixed ones do not fit {area} with {gap_m} m between them"
    )


def _free(
    rng: np.random.Generator,
    area: Area,
    radius: float,
    taken: Sequence[tuple[Spot, float]],
    gap_m: float,
) -> Spot | None:
    for _ in range(30):
        x, y = area.at(*rng.random(2).tolist())
        if all(np.hypot(x - a, y - b) > radius + other + gap_m for (a, b), other in taken):
            return x, y
    return None


def radius_m(model: str) -> float:
    """Half the diagonal of an object's outline on the table."""
    x, y, _ = objects.extent_m(objects.get_object(model))
    return 0.5 * float(np.hypot(x, y))


def place(model: str, spot: Spot, yaw: float) -> Placement:
    """To a tenth of a millimetre and of a milliradian, as the lists keep it."""
    return Placement(
        model, round(float(spot[0]), 4), round(float(spot[1]), 4), round(float(yaw), 4)
    )


def turned(rng: np.random.Generator) -> float:
    """Any yaw, radians."""
    return float(rng.uniform(-np.pi, np.pi))


def rivals(rng: np.random.Generator, stem: str, n: int = 2) -> list[str]:
    """The names of `n` of the personal object's look-alikes, drawn without repeats."""
    return [
        str(name)
        for name in rng.permutation([model.name for model in objects.lookalikes(stem)])[:n]
    ]
