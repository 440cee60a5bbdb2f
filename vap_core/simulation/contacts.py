"""Who touches whom: the roles that bodies play in contacts, and what Truth keeps of them."""

from collections.abc import Mapping
from dataclasses import field

import numpy as np
from jaxtyping import Bool

from vap_core.base.types import value
from vap_core.simulation.cameras import object_of_geoms
from vap_core.simulation.scenes import Scene
from vap_core.simulation.types import REST, ROBOT


@value
class Touch:
    """The contacts of the last control step, as Truth reports them."""

    touched: tuple[str, ...] = ()
    pressed_s: Mapping[str, float] = field(default_factory=dict)
    contacts: Mapping[str, frozenset[str]] = field(default_factory=dict)
    running_s: Mapping[str, float] = field(default_factory=dict)
    """The part of `pressed_s` that still goes on."""


class ContactWatch:
    """The robot's contacts over the physics steps of one control step.

    `touched` are the objects that the robot touched, in the order of their first contact;
    `pressed_s` the longest unbroken contact of each with the gripper up to now, and `running_s`
    what of it still goes on, seconds.
    """

    def __init__(
        self, roles: np.ndarray, on_gripper: Bool[np.ndarray, " g"], running_s: Mapping[str, float]
    ) -> None:
        self.touched: dict[str, None] = {}
        self.pressed_s: dict[str, float] = {}
        self.running_s = running_s
        self._roles = roles
        self._on_gripper = on_gripper
        self._pairs: bytes | None = None
        self._by_gripper: dict[str, None] = {}

    def update(self, geoms: np.ndarray, seconds: float) -> None:
        """Add a physics step of `seconds`; `geoms` (c x 2) are the pairs in contact."""
        pairs = geoms.tobytes()
        if pairs != self._pairs:  # else the contacts are those of the step before
            self._pairs = pairs
            self._by_gripper = {}
            on_gripper = self._on_gripper[geoms].any(axis=1)
            for roles, by_gripper in zip(self._roles[geoms].tolist(), on_gripper, strict=True):
                for name in roles if ROBOT in roles else ():
                    if name not in (ROBOT, REST):
                        self.touched[name] = None
                        if by_gripper:
                            self._by_gripper[name] = None
        self.running_s = {
            name: self.running_s.get(name, 0.0) + seconds for name in self._by_gripper
        }
        for name, pressed in self.running_s.items():
            self.pressed_s[name] = max(pressed, self.pressed_s.get(name, 0.0))


def geom_roles(scene: Scene) -> np.ndarray:
    """Of each geom the name of its object, or ROBOT, or REST: the table, floor and walls."""
    model = scene.model
    roles = np.array([*scene.objects, REST], object)[object_of_geoms(model, scene.objects)]
    base = int(model.body(scene.robot.links[0]).rootid[0])
    roles[model.body_rootid[model.geom_bodyid] == base] = ROBOT
    return roles


def contact_partners(roles: np.ndarray) -> dict[str, frozenset[str]]:
    """What every object that touches anything touches; `roles` are those of pairs in contact."""
    partners: dict[str, set[str]] = {}
    for pair in roles.tolist():
        for one, other in (pair, pair[::-1]):
            if one != other and one not in (ROBOT, REST):
                partners.setdefault(one, set()).add(other)
    return {name: frozenset(of) for name, of in partners.items()}
