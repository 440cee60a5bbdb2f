"""An episode of the scripted expert, step by step, to film or measure it."""

from collections.abc import Callable, Iterator

import numpy as np

from vap_core.policies.scripted.expert import Expert, ExpertState
from vap_core.simulation.env import Env
from vap_core.simulation.suites.rules import Judge
from vap_core.simulation.types import Action, EpisodeRow


def expert_steps(
    env: Env,
    row: EpisodeRow,
    expert: Expert,
    state: ExpertState,
    disturb: Callable[[Action], Action] | None = None,
) -> Iterator[tuple[Judge, Action | None]]:
    """Yield the judge and the planned action before every step, and last the final judge with None.

    `env` stands at the start of `row`. The action is executed, changed by `disturb` if there is
    one, when the next step is asked for.

    Raises: OutOfReach.
    """
    sizes = {}
    for place in row.placements:
        sizes[place.model] = env.scene.sizes_m[place.model]
    judge = Judge.start(row, sizes, env.truth())
    while not judge.done and judge.steps < row.max_steps:
        (state,), (chunk,) = expert.plan_from_simulation([state], [env])
        action = chunk[0].astype(np.float32)
        yield judge, action
        env.step(action if disturb is None else disturb(action))
        judge = judge.step(env.truth())
    yield judge, None
