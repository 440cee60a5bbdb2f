"""Whose geoms are whose: the objects' and the hand's."""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Bool, Int64


def object_of_geoms(model: mujoco.MjModel, objects: Sequence[str]) -> Int64[np.ndarray, " g"]:
    """Of each geom the index into `objects` of its object, -1 for the rest of the scene."""
    owners = np.full(model.nbody, -1, np.int64)
    for i, name in enumerate(objects):
        owners[model.body(name).id] = i
    return owners[model.body_rootid[model.geom_bodyid]]


def hand_geoms(model: mujoco.MjModel) -> Bool[np.ndarray, " g"]:
    """Whether a geom is of the gripper: of the body that bears the tcp, or of one below it."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "tcp")
    of_hand = np.zeros(model.nbody, bool)
    if site >= 0:
        of_hand[model.site_bodyid[site]] = True
    for body in range(1, model.nbody):  # a parent comes before its children
        of_hand[body] |= of_hand[model.body_parentid[body]]
    return of_hand[model.geom_bodyid]
