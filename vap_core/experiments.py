"""Every named study: which tasks, methods and policy, how many episodes; and the parts that one batch of it needs."""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from vap_core import __version__, suites
from vap_core.associate import PAIRINGS
from vap_core.attend import STACKS, Attender, Prompting, load_stack
from vap_core.describe import Attributes, Captioner, described
from vap_core.detect import Detector
from vap_core.errors import BadStudy, one_of
from vap_core.hard_prompt import Described, Reworded, hard_prompt
from vap_core.memory import load_bank, register, save
from vap_core.oracle import Oracle, Revealed
from vap_core.policies import Insider, Policy, checkpoints, lerobot
from vap_core.policies.expert import Expert
from vap_core.policies.random import Random
from vap_core.policies.scripted import Scripted
from vap_core.rollout import Follow, Trial
from vap_core.sim import robots
from vap_core.sim.cameras import RIGS
from vap_core.sim.env import Env
from vap_core.sim.objects import extent_m, get
from vap_core.sim.scenes import Scene, build
from vap_core.sim.studio import reference_views
from vap_core.soft_prompt import MODEL, Learned, soft_prompt, teach
from vap_core.suites import SUITES, VARIANTS, Suite, listed, lists, rows
from vap_core.tokens import WORD
from vap_core.tokens import load as load_token
from vap_core.values import EpisodeRow
from vap_core.weights import weights_sha256

type Method = Prompting | Described | Learned | Oracle | None

METHODS: dict[str, Method] = {
    "generic": None,
    "hard-short": Described("short"),
    "hard-long": Described("long"),
    "soft": Learned(),
    "vap": Prompting(),
    "mask-only": Prompting(rewrite=False),
    "rewrite-only": Prompting(highlight=False),
    "vap-associated": Prompting(associate=PAIRINGS["geometry"]),
    "oracle-box": Oracle("box"),
    "oracle-mask": Oracle("mask"),
    "oracle-track": Oracle("track"),
    "wrong-mask": Oracle("track", of="rival"),
}
"""What each method changes in the policy's inputs; None changes nothing (P 5.2). Association is not the paper's, nor are the last four: they read the
simulator, and bound what results can be."""


@dataclass(frozen=True)
class Study:
    """The same episodes of every task, once per method and seed. `episodes` None takes whole lists; `images_every`, `follow` and `audit` are
    rollout.Trial's."""

    tasks: tuple[tuple[str, str], ...]
    methods: tuple[str, ...]
    episodes: int | None = None
    seed: int = 0
    seeds: int = 1
    policy: str = "scripted"
    stack: str = "embedded"
    robots: str = "plain"
    images_every: int = 0
    follow: Follow = "step"
    audit: bool = False

    def __post_init__(self) -> None:
        for method in self.methods:
            if method not in METHODS:
                raise one_of("Study: method", method, METHODS)
        if self.policy not in (*POLICIES, MINI) and not checkpoints.named(self.policy):
            raise one_of("Study: policy (or a lerobot checkpoint's folder or hub id)", self.policy, [*POLICIES, MINI])
        for suite, _ in self.tasks:
            if self.policy == MINI and not shipped(suite).is_dir():
                there = ", ".join(sorted(folder.name for folder in SHIPPED.glob(f"{MINI}-*"))) or "none"
                raise BadStudy(f"Study: no {MINI} for {suite} ships (there is {there}); run: python -m vap_core train policy --suite {suite}")
        if self.robots not in ("plain", "menagerie"):
            raise one_of("Study: robots", self.robots, ("plain", "menagerie"))
        if self.stack not in STACKS:
            raise one_of("Study: stack", self.stack, STACKS)
        for suite, task in self.tasks:
            rows(suite, task, n=1)
        if self.policy in INSIDERS and self.audit:
            raise BadStudy(f"Study: policy {self.policy!r} consumes no prompt; there is nothing to audit. Leave --audit out.")
        if self.policy in INSIDERS and self.methods != ("generic",):
            raise BadStudy(f"Study: policy {self.policy!r} reads the simulator, not pictures; no method can prompt it. Use --method generic.")
        if self.policy in POLICIES and any(isinstance(METHODS[method], Learned) for method in self.methods):
            raise BadStudy(f"Study: policy {self.policy!r} has no words that could be learned; leave soft out, or take --policy {MINI}.")

    def rows(self, suite: str, task: str) -> tuple[EpisodeRow, ...]:
        return listed(suite, task, n=self.episodes, seed=self.seed, seeds=self.seeds)

    def checkpoint(self, suite: str) -> str:
        """The folder or hub id of the policy's weights for a suite; "" for a policy that has none."""
        return str(shipped(suite)) if self.policy == MINI else "" if self.policy in POLICIES else self.policy

    def configuration(self) -> dict[str, Any]:
        """What the results depend on, as JSON; weights, episode lists, and the world (robots, objects, looks, sensors) by their checksums."""
        listed = {suite: lists.digest(suite) for suite, _ in self.tasks if suite in suites.BENCHMARKS}
        held = {name: checkpoints.fingerprint(name) for name in sorted({self.checkpoint(suite) for suite, _ in self.tasks} - {""})}
        checkpoint = {"checkpoint": held[self.policy]} if self.policy in held else {"checkpoints": list(held.values())} if held else {}
        return {**asdict(self), **checkpoint, "version": __version__, "weights": weights_sha256(), "lists": listed, "world": self._world()}

    def _world(self) -> str:
        found = hashlib.sha256(_exactly((RIGS, VARIANTS)))
        for suite, task in self.tasks:
            known = suites.suite(suite)
            arm, placed = robots.get(known.robot), {place.model for row in self.rows(suite, task) for place in row.placements}
            found.update(_exactly((known, arm, [get(name) for name in sorted(placed)])) + arm.xml.read_bytes())
        return found.hexdigest()[:16]


def _exactly(thing: Any) -> bytes:
    """Every number in it, whatever numpy's print options are; of files their names."""

    def plain(part: Any) -> Any:
        if is_dataclass(part) and not isinstance(part, type):
            return {"kind": type(part).__name__, **{each.name: getattr(part, each.name) for each in fields(part)}}
        if isinstance(part, np.ndarray | np.generic):
            return part.tolist()
        if isinstance(part, Path):
            return part.name
        raise TypeError(f"Study: {type(part).__name__} cannot be hashed; give it fields, or add its kind here.")

    return json.dumps(thing, default=plain, sort_keys=True).encode()


def register_personal(study: Study, bank: Path, captioner: Captioner | None = None) -> None:
    """Remember the personal object of every task from five rendered reference views; what the bank holds already stays.

    Where a method tells what it looks like, it is described too, by `captioner`, or offline; for the soft prompt a word of its own is learned.
    A study that prompts nothing needs no memory.
    """
    if all(METHODS[method] is None for method in study.methods):
        return
    stack, held = load_stack(study.stack), load_bank(bank)
    telling = any(isinstance(METHODS[method], Described) for method in study.methods)
    for suite, task in study.tasks:
        row = study.rows(suite, task)[0]
        obj = held.get(row.target)
        if obj is None:
            obj, _ = register(row.target, row.category, reference_views(get(row.target)), stack.detector, stack.encoder)
        if telling and obj.description is None:
            obj = described(obj, captioner or Attributes(stack.segmenter))
        if any(isinstance(METHODS[method], Learned) for method in study.methods):
            teach(study.rows(suite, task), bank, checkpoints.setting(study.checkpoint(suite), "vlm"), MODEL)
        if obj is not held.get(row.target):
            save(bank, obj, replace=True)
            held[row.target] = obj


_stack = cache(load_stack)


def scripted(detector: Detector, scene: Scene, suite: Suite) -> Scripted:
    """The scripted policy, calibrated to the suite's first camera."""
    camera = next(camera for camera in Env(scene).cameras() if camera.name == suite.cameras[0])
    return Scripted(detector, camera, scene.robot, suite.hz, suite.control)


POLICIES: dict[str, Callable[[Study, Scene, Suite], Policy[Any] | Insider[Any]]] = {
    "scripted": lambda study, scene, suite: scripted(_stack(study.stack).detector, scene, suite),
    "expert": lambda study, scene, suite: Expert(),
    "random": lambda study, scene, suite: Random(),
}
"""Policies by name; each is built for one scene."""
INSIDERS = ("expert", "random")
"""Policies that read the simulator, or nothing at all: bounds on what a task allows, never results."""
MINI, SHIPPED = "mini-pi0", MODEL.parent
"""The shipped frozen policy, one checkpoint a suite, and where they lie."""


def shipped(suite: str) -> Path:
    """Where the shipped policy of a suite lies, if there is one."""
    return SHIPPED / f"{MINI}-{suite}"


def usual(names: Iterable[str]) -> str:
    """The policy for suites of which nobody named one: the shipped frozen one, or the scripted one when some suite has none."""
    return MINI if all(shipped(suite).is_dir() for suite in names) else "scripted"


DEMO = Study(tasks=(("widowx-pick", "pick-straw-cup"), ("franka-pick", "pick-cup")), methods=("generic", "vap"), episodes=20)
"""The main job: one task on each robot, generic against VAP."""


def make_trial(study: Study, rows: Sequence[EpisodeRow], method: str, bank: Path) -> Trial:
    """Build, or take from this process's cache, what some rows of one task and one variant need: scene, models, policy."""
    first = rows[0]
    suite = suites.suite(first.suite)
    scene = _scene(study, first.suite, first.task, first.variant)
    sizes: Mapping[str, tuple[float, float, float]] = {name: extent_m(get(name)) for name in scene.objects}
    return Trial(
        method,
        scene,
        _policy(METHODS[method], study, first, bank, scene),
        _attender(METHODS[method], study, first, bank, scene),
        sizes,
        suite.control,
        suite.sensor,
        study.images_every,
        follow=study.follow,
        audit=study.audit,
    )


def _policy(how: Method, study: Study, row: EpisodeRow, bank: Path, scene: Scene) -> Policy[Any] | Insider[Any]:
    """The one frozen policy of the study; to the soft prompt it listens with one word more."""
    known = suites.suite(row.suite)
    if study.policy in POLICIES:
        return POLICIES[study.policy](study, scene, known)
    policy = lerobot.fitted(study.checkpoint(row.suite), scene, known)
    if not isinstance(how, Learned):
        return policy
    return policy.saying({WORD: load_token(bank, row.target, getattr(policy.policy.config, "vlm", "")).embedding})


def _attender(how: Method, study: Study, row: EpisodeRow, bank: Path, scene: Scene) -> Attender | Reworded | Revealed | None:
    """What stands between the cameras and the policy under one method."""
    match how:
        case None:
            return None
        case Described():
            return hard_prompt(load_bank(bank)[row.target], how)
        case Learned():
            return soft_prompt()
    stack = _stack(study.stack)
    mine = {row.target: load_bank(bank, stack.encoder.name)[row.target]}
    match how:
        case Oracle():
            return Revealed(Attender(stack, mine, how.prompting), how, frozenset(n for n in scene.objects if get(n).category == row.category))
        case Prompting():
            return Attender(stack, mine, how)


@lru_cache(maxsize=4)
def _scene(study: Study, suite: str, task: str, variant: str) -> Scene:
    names = dict.fromkeys(p.model for row in study.rows(suite, task) if row.variant == variant for p in row.placements)
    return build(SUITES[suite].robot, tuple(names), look=VARIANTS[variant].look, meshes="menagerie" if study.robots == "menagerie" else "plain")
