"""Who touches whom: the roles that bodies play in contacts, and what Truth keeps of them."""

from collections.abc import Mapping
from dataclasses import field

import numpy as np
from jaxtyping import Bool, Int64

from vap_core.base.types import value
from vap_core.simulation.scenes import Scene


@value
class Touch:
    """The contacts of the last control step, as Truth reports them."""

    touched: tuple[str, ...] = ()
    pressed_s: Mapping[str, float] = field(default_factory=dict)
    contacts: Mapping[str, frozenset[str]] = field(default_factory=dict)
    running_s: Mapping[str, float] = field(default_factory=dict)
    """Of `pressed_s`, what is not over yet."""


ARM, STILL = -1, -2


def roles(scene: Scene) -> Int64[np.ndarray, " g"]:
    """Of each geom: the index of its object, or ARM, or STILL (table, floor, walls)."""
    model = scene.model
    base = int(model.body(scene.robot.links[0]).rootid[0])
    owner = {int(model.body(name).id): i for i, name in enumerate(scene.objects)} | {base: ARM}
    return np.array(
        [owner.get(int(model.body_rootid[body]), STILL) for body in model.geom_bodyid], np.int64
    )


def hand(scene: Scene) -> Bool[np.ndarray, " g"]:
    """Of each geom: whether it belongs to the gripper, that is to the tcp's body or to a body below it."""
    model = scene.model
    palm = int(model.site("tcp").bodyid[0])
    below = {palm}
    for body in range(palm + 1, model.nbody):  # children come after their parents
        if int(model.body_parentid[body]) in below:
            below.add(body)
    return np.isin(model.geom_bodyid, list(below))


def partners(pairs: Int64[np.ndarray, "c 2"]) -> dict[int, set[int]]:
    """Of every object that touches anything: the roles of what it touches."""
    found: dict[int, set[int]] = {}
    for a, b in pairs.tolist():
        for one, other in ((a, b), (b, a)):
            if one >= 0 and one != other:
                found.setdefault(one, set()).add(other)
    return found
