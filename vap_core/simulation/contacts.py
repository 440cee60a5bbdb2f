"""Who touches whom: the roles that bodies play in contacts, and what Truth keeps of them."""

from collections.abc import Mapping
from dataclasses import field

import numpy as np
from jaxtyping import Bool, Int64

from vap_core.base.types import value
from vap_core.simulation.cameras import object_of_geoms
from vap_core.simulation.scenes import Scene

ARM = -1
"""The role of the robot's geoms."""
STILL = -2
"""The role of the table, the floor and the walls."""


@value
class Touch:
    """The contacts of the last control step, as Truth reports them."""

    touched: tuple[str, ...] = ()
    pressed_s: Mapping[str, float] = field(default_factory=dict)
    contacts: Mapping[str, frozenset[str]] = field(default_factory=dict)
    running_s: Mapping[str, float] = field(default_factory=dict)
    """The part of `pressed_s` that still goes on."""


class ContactWatch:
    """The robot's contacts over the physics steps of one control step; objects by their index.

    `touched` are the objects that the robot touched, in the order of their first contact;
    `pressed_s` the longest unbroken contact of each with the gripper up to now, and `running_s`
    what of it still goes on, seconds.
    """

    def __init__(
        self,
        geom_roles: Int64[np.ndarray, " g"],
        on_gripper: Bool[np.ndarray, " g"],
        running_s: dict[int, float],
    ) -> None:
        self.touched: dict[int, None] = {}
        self.pressed_s: dict[int, float] = {}
        self.running_s = running_s
        self._geom_roles = geom_roles
        self._on_gripper = on_gripper
        self._pairs: bytes | None = None
        self._by_gripper: set[int] = set()

    def update(self, geoms: np.ndarray, seconds: float) -> None:
        """Add a physics step of `seconds`; `geoms` (c x 2) are the pairs in contact."""
        pairs = geoms.tobytes()
        if pairs != self._pairs:  # else the contacts are those of the step before
            self._pairs = pairs
            self._find_touched(geoms)
        if not self._by_gripper:
            self.running_s = {}
            return
        running_s = {}
        for index in self._by_gripper:
            running_s[index] = self.running_s.get(index, 0.0) + seconds
        for index, pressed in running_s.items():
            self.pressed_s[index] = max(pressed, self.pressed_s.get(index, 0.0))
        self.running_s = running_s

    def _find_touched(self, geoms: np.ndarray) -> None:
        """Note the objects in contact with the robot, and those in contact with its gripper."""
        pairs = self._geom_roles[geoms]
        objects = pairs.max(axis=1)
        by_robot = (pairs.min(axis=1) == ARM) & (objects >= 0)
        by_gripper = by_robot & self._on_gripper[geoms].any(axis=1)
        self.touched.update(dict.fromkeys(objects[by_robot].tolist()))
        self._by_gripper = set(objects[by_gripper].tolist())


def geom_roles(scene: Scene) -> Int64[np.ndarray, " g"]:
    """Of each geom: the index of its object, or ARM, or STILL."""
    model = scene.model
    owners = object_of_geoms(model, tuple(scene.objects))
    roles = np.where(owners >= 0, owners, STILL)
    base = int(model.body(scene.robot.links[0]).rootid[0])
    roles[model.body_rootid[model.geom_bodyid] == base] = ARM
    return roles


def contact_partners(pairs: Int64[np.ndarray, "c 2"]) -> dict[int, set[int]]:
    """Of every object that touches anything: the roles of what it touches."""
    partners: dict[int, set[int]] = {}
    for first, second in pairs.tolist():
        if first == second:
            continue
        if first >= 0:
            partners.setdefault(first, set()).add(second)
        if second >= 0:
            partners.setdefault(second, set()).add(first)
    return partners
