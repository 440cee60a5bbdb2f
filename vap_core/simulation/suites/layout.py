"""Where objects stand at the start of an episode: random places at a distance from each other."""

import zlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from vap_core.base.types import value
from vap_core.simulation.assets import objects
from vap_core.simulation.suites.suite import Suite, Task
from vap_core.simulation.types import EpisodeRow, Placement

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
    x, y, turn = (round(float(number), 4) for number in (*spot, yaw))
    return Placement(model, x, y, turn)


def random_yaw(rng: np.random.Generator) -> float:
    """Any yaw, radians."""
    return float(rng.uniform(-np.pi, np.pi))


def place_at_random_yaws(
    rng: np.random.Generator, models: Sequence[str], spots: Sequence[Spot]
) -> list[Placement]:
    """Each model on its spot, at a random yaw."""
    pairs = zip(models, spots, strict=True)
    return [place(model, spot, random_yaw(rng)) for model, spot in pairs]


def scattered(
    rng: np.random.Generator,
    area: Area,
    models: Sequence[str],
    *,
    gap_m: float,
    fixed: Sequence[tuple[Spot, float]] = (),
) -> tuple[Placement, ...]:
    """Each model anywhere in an area at a random yaw; distances as in `scatter`."""
    spots = scatter(rng, area, list(map(radius_m, models)), fixed=fixed, gap_m=gap_m)
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
    return all(np.hypot(x - a, y - b) > radius + other + gap_m for (a, b), other in taken)


PICKED = (
    "cup",
    "bottle",
    "pen holder",
    "straw cup",
    "owl figurine",
    "vase",
    "camera",
    "shaver",
)


@value
class Arrangement:
    """Three places in a row across the table, as the front camera sees it: metres, world frame.

    Places lie `spread_m` apart around (`x_m`, 0); the row as a whole shifts by up to `shift_m`
    sideways and every object by up to `jitter_m` = (x, y); centres stay `clearance_m` apart, room
    for a gripper between them.
    """

    x_m: float
    spread_m: float
    shift_m: float
    jitter_m: tuple[float, float]
    clearance_m: float

    def __post_init__(self) -> None:
        if self.spread_m - 2 * self.jitter_m[1] < self.clearance_m - 1e-9:
            raise ValueError(
                f"Arrangement: places {self.spread_m} m apart that jitter by {self.jitter_m[1]} m "
                f"cannot keep {self.clearance_m} m clear"
            )


def _pick_tasks(max_steps: int) -> tuple[Task, ...]:
    return tuple(
        Task(f"pick-{kind.replace(' ', '-')}", kind, f"pick up my {kind}", max_steps)
        for kind in PICKED
    )


WIDOWX = Suite(
    name="widowx-pick", robot="wx250s", hz=5.0, cameras=("front",), tasks=_pick_tasks(60)
)
FRANKA = Suite(
    name="franka-pick",
    robot="panda",
    hz=10.0,
    cameras=("front", "side", "wrist"),
    tasks=_pick_tasks(100),
)
ARRANGEMENTS = {
    WIDOWX.name: Arrangement(
        x_m=0.27, spread_m=0.13, shift_m=0.015, jitter_m=(0.025, 0.02), clearance_m=0.09
    ),
    FRANKA.name: Arrangement(
        x_m=0.48, spread_m=0.14, shift_m=0.015, jitter_m=(0.03, 0.015), clearance_m=0.11
    ),
}


def pick_rows(suite: Suite, task: Task, n: int, seed: int) -> tuple[EpisodeRow, ...]:
    """The first `n` episodes; the target stands in each of the three places equally often.

    The order is drawn by `seed`. Episode i depends on (suite, task, seed, i) alone: asking for more
    episodes leaves the first ones as they were.
    """
    return tuple(_pick_row(suite, task, episode, seed) for episode in range(n))


def _pick_row(suite: Suite, task: Task, episode: int, seed: int) -> EpisodeRow:
    name = zlib.crc32(f"{suite.name}.{task.name}".encode())
    block = np.random.default_rng([seed, episode // 3, name, 1]).permutation(3)
    rng = np.random.default_rng([seed, episode, name])
    target = int(block[episode % 3])
    others = rng.permutation([slot for slot in range(3) if slot != target])
    places = _places(ARRANGEMENTS[suite.name], rng)
    slots = [target, *others.tolist()]
    models = [task.personal, f"{task.stem}-lookalike-1", f"{task.stem}-lookalike-2"]
    spots = [(places[slot, 0], places[slot, 1]) for slot in slots]
    placements = place_at_random_yaws(rng, models, spots)
    return suite.row(task, episode, tuple(placements), seed=seed)


def _places(arrangement: Arrangement, rng: np.random.Generator) -> Float64[np.ndarray, "3 2"]:
    """The three places of one episode, from the camera's left to its right (x, y metres)."""
    shift = rng.uniform(-arrangement.shift_m, arrangement.shift_m)
    row = arrangement.spread_m * np.array([-1.0, 0.0, 1.0]) + shift
    jitter = rng.uniform(-1.0, 1.0, (3, 2)) * arrangement.jitter_m
    return np.stack([arrangement.x_m + jitter[:, 0], row + jitter[:, 1]], axis=1)
