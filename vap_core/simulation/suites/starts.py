"""What a seed changes at the start of a listed episode: the arm, the objects and the light.

Seed 0 changes nothing: it is the list itself. Every other seed moves each object within the free
space that all layouts keep around it, so that no layout becomes another one. Where an episode has
several receptacles (shared-sequence-bridge), these may stand closer together than that, and stay in
their places. What a list's own start changes remains, and the seed's change comes on top of it. The
seed's change depends on the seed and the layout alone: the variants of a layout start alike.
"""

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from vap_core.base.errors import BadStudy, an
from vap_core.simulation.assets import objects
from vap_core.simulation.suites.layout import Spot
from vap_core.simulation.suites.suite import Suite
from vap_core.simulation.types import EpisodeRow, Placement, Start


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
    joints, offsets = change.joints_rad, change.offsets
    if listed.joints_rad:
        joints = tuple(np.add(listed.joints_rad, joints).tolist())
    if listed.offsets:
        dx, dy, turn = np.add(listed.offsets, offsets).T.tolist()
        offsets = tuple(zip(dx, dy, turn, strict=True))
    lamp, ambient = listed.lamp * change.lamp, listed.ambient * change.ambient
    return replace(listed, joints_rad=joints, offsets=offsets, lamp=lamp, ambient=ambient)


def _rounded(values: np.ndarray) -> tuple[float, ...]:
    """Rounded as in the lists, to 0.1 mm and 0.1 mrad."""
    return tuple(np.round(values, 4).tolist())


APART_M = 0.01
"""Room between the object's disc and its neighbours' discs."""


def with_object(
    rows: Sequence[EpisodeRow], name: str, whole: Sequence[EpisodeRow]
) -> tuple[EpisodeRow, ...]:
    """The rows of one task with the object `name` as their target.

    It takes the place and turn of the listed target. Where it is too wide for that, it takes the
    nearest target place of the task's `whole` list that has room.

    Raises: UnknownName; BadObject; BadStudy for an object of another category, one that stands
        there already, or one that fits nowhere, and for a shared scene, which names its objects.
    """
    for row in rows:
        if row.owned or row.subgoals:
            raise BadStudy(
                f"--object: {row.suite}/{row.task} is a scene that people share, and names the "
                "objects that they own; take a task of another suite."
            )
    spots = _target_spots(whole)
    radii_m = _disc_radii_m(rows, name)
    return tuple(_replaced(row, name, spots, radii_m) for row in rows)


def check_category(name: str, suite: Suite, task_name: str, known: Iterable[Suite]) -> None:
    """Refuse an object of another category than the task's.

    Raises: UnknownName; BadObject; BadStudy, which names the tasks of `known` that it fits.
    """
    model = objects.get_object(name)
    wanted = suite.task(task_name).category
    if model.category == wanted:
        return
    fitting = [
        f"{other.name}/{task.name}"
        for other in known
        for task in other.tasks
        if task.category == model.category
    ]
    remedy = f"import it with --category {wanted!r}, if it is one"
    if fitting:
        remedy = f"take a task with {an(model.category)}: {', '.join(fitting)}"
    raise BadStudy(
        f"--object: {name} is {an(model.category)}, and {suite.name}/{task_name} asks for a "
        f"{wanted}; {remedy}."
    )


def _target_spots(rows: Sequence[EpisodeRow]) -> tuple[Spot, ...]:
    """The places of the rows' targets, each once."""
    return tuple(dict.fromkeys((row.placements[0].x, row.placements[0].y) for row in rows))


def _disc_radii_m(rows: Sequence[EpisodeRow], name: str) -> dict[str, float]:
    """The radius of the disc that an object's outline fits in, for `name` and all in the rows."""
    names = {name}
    for row in rows:
        names.update(place.model for place in row.placements)
    radii_m = {}
    for each in names:
        vertex = objects.mesh_of(objects.get_object(each)).vertex[:, :2]
        centre = (vertex.min(axis=0) + vertex.max(axis=0)) / 2
        radii_m[each] = float(np.linalg.norm(vertex - centre, axis=1).max())
    return radii_m


def _replaced(
    row: EpisodeRow, name: str, spots: Sequence[Spot], radii_m: Mapping[str, float]
) -> EpisodeRow:
    """The row with the object as its target."""
    target, *others = row.placements
    if name in [place.model for place in others]:
        raise BadStudy(
            f"--object: {name} is one of the objects around the target of {row.suite}/{row.task}; "
            "name another object."
        )

    def away_m(spot: Spot) -> float:
        return float(np.hypot(spot[0] - target.x, spot[1] - target.y))

    for spot in sorted(spots, key=away_m):
        if _has_room(name, spot, others, radii_m):
            place = replace(target, model=name, x=spot[0], y=spot[1])
            return replace(row, placements=(place, *others))
    raise BadStudy(
        f"--object: {name} is too wide to stand among the objects of {row.suite}/{row.task} "
        f"(episode {row.episode}); import it again with a smaller --height-cm."
    )


def _has_room(
    name: str, spot: Spot, others: Sequence[Placement], radii_m: Mapping[str, float]
) -> bool:
    """Whether the object's disc keeps `APART_M` to every other object's."""
    return all(
        np.hypot(spot[0] - other.x, spot[1] - other.y)
        >= radii_m[name] + radii_m[other.model] + APART_M
        for other in others
    )
