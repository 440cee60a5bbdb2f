"""The lists on LIBERO's scenes: every official initial state, with each target in turn.

`python -m vap_make.lists.libero` writes them anew; it needs `make libero`.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from vap_core.environments import libero, open_world
from vap_core.simulation import suites
from vap_core.simulation.suites import lists
from vap_core.simulation.types import EpisodeRow, Placement


def rows(name: str) -> tuple[EpisodeRow, ...]:
    """The whole list of a suite; places are where objects stand once they have settled."""
    suite = suites.suite(name)
    listed = []
    for task, personal in zip(suite.tasks, libero.PERSONAL[name], strict=True):
        first = suite.row(task, 0, (Placement(personal.target, 0.0, 0.0, 0.0),))
        world = open_world([first])
        env = world.open(16, ())
        for i in range(libero.STATES):
            env.reset(suite.row(task, i, first.placements))
            placed = [_placement(*each) for each in env.truth().objects_world.items()]
            placed.sort(key=lambda each: each.model != personal.target)
            listed.append(suite.row(task, i, tuple(placed)))
        world.close()
    return tuple(listed)


def _placement(model: str, pose: np.ndarray) -> Placement:
    x, y = pose[:2].round(4).tolist()
    yaw = Rotation.from_quat(pose[3:], scalar_first=True).as_euler("ZYX")[0]
    return Placement(model, x, y, round(float(yaw), 4))


if __name__ == "__main__":
    for name in libero.SUITES:
        print(name, lists.write(name, rows(name)))
