"""Every named study: which tasks, methods and policy, how many episodes; and the parts that one batch of it needs."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from vap_core import __version__
from vap_core.attend import STACKS, Attender, Prompting, Stack, load_stack
from vap_core.errors import one_of
from vap_core.memory import load_bank, register, save
from vap_core.policies import Policy
from vap_core.policies.scripted import Scripted
from vap_core.rollout import Trial
from vap_core.sim.env import Env
from vap_core.sim.objects import extent_m, get
from vap_core.sim.scenes import Scene, build
from vap_core.sim.studio import reference_views
from vap_core.suites import SUITES, rows
from vap_core.values import EpisodeRow
from vap_core.weights import weights_sha256

METHODS: dict[str, Prompting | None] = {
    "generic": None,
    "vap": Prompting(),
    "mask-only": Prompting(rewrite=False),
    "rewrite-only": Prompting(highlight=False),
}
"""What each method changes in the policy's inputs; None changes nothing (P 5.2)."""


@dataclass(frozen=True)
class Study:
    """The same episodes of every task, once per method."""

    tasks: tuple[tuple[str, str], ...]
    methods: tuple[str, ...]
    episodes: int = 20
    seed: int = 0
    policy: str = "scripted"
    stack: str = "embedded"

    def __post_init__(self) -> None:
        for method in self.methods:
            if method not in METHODS:
                raise one_of("Study: method", method, METHODS)
        if self.policy not in POLICIES:
            raise one_of("Study: policy", self.policy, POLICIES)
        if self.stack not in STACKS:
            raise one_of("Study: stack", self.stack, STACKS)
        for suite, task in self.tasks:
            rows(suite, task, n=1)

    def rows(self, suite: str, task: str) -> tuple[EpisodeRow, ...]:
        return rows(suite, task, n=self.episodes, seed=self.seed)

    def configuration(self) -> dict[str, Any]:
        """What the results depend on, as JSON; weights by their checksums."""
        return {**asdict(self), "version": __version__, "weights": weights_sha256()}


def register_personal(study: Study, bank: Path) -> None:
    """Remember the personal object of every task from five rendered reference views; what the bank holds already stays."""
    stack, held = load_stack(study.stack), load_bank(bank)
    for suite, task in study.tasks:
        row = study.rows(suite, task)[0]
        if row.target not in held:
            obj, _ = register(row.target, row.category, reference_views(get(row.target)), stack.detector, stack.encoder)
            save(bank, obj, replace=True)
            held[row.target] = obj


def _scripted(scene: Scene, stack: Stack) -> Policy[Any]:
    fixed = next(camera for camera in Env(scene).cameras() if camera.name == "front")
    return Scripted(stack.detector, fixed, scene.robot.base_world)


POLICIES: dict[str, Callable[[Scene, Stack], Policy[Any]]] = {"scripted": _scripted}
"""Policies by name; each is built for one scene."""


DEMO = Study(tasks=(("widowx-pick", "pick-straw-cup"), ("franka-pick", "pick-cup")), methods=("generic", "vap"))
"""The main job: one task on each robot, generic against VAP."""


def make_trial(study: Study, suite: str, task: str, method: str, bank: Path) -> Trial:
    """Build, or take from this process's cache, the scene, the models and the policy of one task and method."""
    stack, scene = _stack(study.stack), _scene(study, suite, task)
    prompting, memory = METHODS[method], load_bank(bank, _stack(study.stack).encoder.name)
    target = study.rows(suite, task)[0].target
    attender = None if prompting is None else Attender(stack, {target: memory[target]}, prompting)
    sizes: Mapping[str, tuple[float, float, float]] = {name: extent_m(get(name)) for name in scene.objects}
    return Trial(method, scene, POLICIES[study.policy](scene, stack), attender, sizes)


_stack = cache(load_stack)


@cache
def _scene(study: Study, suite: str, task: str) -> Scene:
    names = dict.fromkeys(p.model for row in study.rows(suite, task) for p in row.placements)
    return build(SUITES[suite].robot, tuple(names))
