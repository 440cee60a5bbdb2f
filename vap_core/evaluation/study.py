"""A study: which tasks, methods and policy, how many episodes; and what a batch of it needs."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from vap_core import __version__
from vap_core.base.errors import BadStudy, one_of
from vap_core.base.extras import require
from vap_core.evaluation.methods import (
    METHODS,
    has_no_command,
    hidden_calls,
    known_methods,
    make_prompter,
    needs_description,
    needs_memory,
    needs_stack,
    needs_token,
    references_needed,
    suits_shared,
    token_space,
)
from vap_core.evaluation.policy_names import (
    MINI,
    POLICIES,
    PRIVILEGED,
    SHIPPED,
    make_policy,
    shipped,
)
from vap_core.memory import load_bank, register, save
from vap_core.perception.describe import AttributeCaptioner, Captioner, with_description
from vap_core.perception.embedded.weights import weights_sha256
from vap_core.perception.protocols import Stack
from vap_core.perception.stacks import check_stack, load_stack
from vap_core.policies.lerobot import checkpoints
from vap_core.policies.mini_pi0 import token_file
from vap_core.policies.mini_pi0.learned_token import WORD
from vap_core.policies.mini_pi0.teach_token import MODEL, teach, teach_own
from vap_core.policies.names import check_policy_name
from vap_core.policies.protocol import Policy, PrivilegedPolicy
from vap_core.rollout.loop import Follow, Trial
from vap_core.simulation import robots, suites
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.cameras import RIGS
from vap_core.simulation.occluder import Occlusion
from vap_core.simulation.scenes import Meshes, Scene
from vap_core.simulation.studio import reference_views
from vap_core.simulation.suites import starts
from vap_core.simulation.suites.open_row import build_scene
from vap_core.simulation.suites.variants import VARIANTS
from vap_core.simulation.types import EpisodeRow

MESHES = ("plain", "menagerie")


HOTTEST = 10.0
"""The largest factor of a policy's sampling noise."""
HIDDEN_FROM = 2
"""The call of the policy, counted from 0, from which an arm of `ablate` hides the target."""


@dataclass(frozen=True)
class Study:
    """The same episodes of every task, once per method and seed.

    `episodes` None takes whole lists. `images_every`, `follow` and `audit` are rollout.Trial's.
    `temperature` scales the sampling noise of a mini-pi0; None leaves it as its checkpoint says.
    `object` names an object that takes the target's place (suites.own_object). `suite_files` are
    the files of own suites; they are executed (suites.own). `split` takes the episodes of one split
    of a suite's list, for example visual matching.

    Raises: UnknownName, BadStudy, when it is built from what does not fit together; MissingPart.
    """

    tasks: tuple[tuple[str, str], ...]
    methods: tuple[str, ...]
    episodes: int | None = None
    seed: int = 0
    seeds: int = 1
    policy: str = "scripted"
    stack: str = "embedded"
    robots: Meshes = "plain"
    images_every: int = 0
    follow: Follow = "step"
    audit: bool = False
    temperature: float | None = None
    object: str = ""
    suite_files: tuple[str, ...] = ()
    split: str = ""

    def __post_init__(self) -> None:
        self.open_suites()
        _check_names(self)
        _check_policy(self)

    def rows(self, suite: str, task: str) -> tuple[EpisodeRow, ...]:
        return suites.listed(
            suite,
            task,
            n=self.episodes,
            seed=self.seed,
            seeds=self.seeds,
            own_target=self.object,
            split=self.split,
        )

    def open_suites(self) -> None:
        """Make its own suites known in this process. Raises: BadSuite."""
        for file in self.suite_files:
            suites.open_file(Path(file))

    def checkpoint(self, suite: str) -> str:
        """The folder or hub id of the policy's weights for a suite; "" where it has none."""
        if self.policy == MINI:
            return str(shipped(suite))
        return "" if self.policy in POLICIES else self.policy

    def configuration(self) -> dict[str, Any]:
        """What the results depend on, as JSON.

        Weights, episode lists, and the world (robots, objects, styles, sensors) enter by checksum.
        """
        digests = {}
        for suite, _ in self.tasks:
            if suites.has_list(suite):
                digests[suite] = suites.digest(suite)
        checkpoints_used = set()
        for suite, _ in self.tasks:
            checkpoints_used.add(self.checkpoint(suite))
        names = sorted(checkpoints_used - {""})
        fingerprints = [checkpoints.fingerprint(name) for name in names]
        about = asdict(self)
        if self.temperature is None:  # digests are those of versions without it
            del about["temperature"]
        for option in ("object", "split"):
            if not about[option]:
                del about[option]
        del about["suite_files"]  # the lists' digests stand for them
        if names == [self.policy]:
            about["checkpoint"] = fingerprints[0]
        elif names:
            about["checkpoints"] = fingerprints
        about |= {"version": __version__, "weights": weights_sha256(), "lists": digests}
        if digests and self.seed + self.seeds > 1:
            about["starts"] = starts.settings()
        return {**about, "world": _world_digest(self)}


def register_personal(study: Study, bank: Path, captioner: Captioner | None = None) -> None:
    """Remember the personal object of every task from five rendered reference views.

    An object that is in memory stays. Where a method needs its description, it is described too, by
    `captioner`, or offline; for the soft prompt its token is learned. A study that prompts nothing
    needs no memory.
    """
    if not _any_method(study, needs_memory):
        return
    stack = load_stack(study.stack)
    known = load_bank(bank)
    for suite, task, target in _remembered(study):
        rows = study.rows(suite, task)
        obj = known.get(target)
        if obj is None:
            model = get_object(target)
            views = reference_views(model, max(map(references_needed, study.methods)))
            obj, _ = register(target, model.category, views, stack.detector, stack.encoder)
        if _any_method(study, needs_description) and obj.description is None:
            obj = with_description(obj, captioner or AttributeCaptioner(stack.segmenter))
        spaces = {token_space(method) for method in study.methods}
        if spaces & {"copied", "aligned"}:
            initialised_from = checkpoints.config_field(study.checkpoint(suite), "vlm")
            teach(rows, bank, initialised_from, MODEL)
        if "own" in spaces:
            teach_own(rows, bank, checkpoints.locate(study.checkpoint(suite)))
        if obj is not known.get(target):
            save(bank, obj, replace=True)
            known[target] = obj


def _remembered(study: Study) -> list[tuple[str, str, str]]:
    """Suite, task and object of all that a study remembers; in shared scenes what is owned."""
    found = []
    for suite, task in study.tasks:
        row = study.rows(suite, task)[0]
        models = [owned.model for owned in row.owned] or [row.target]
        found += [(suite, task, model) for model in models]
    return found


def make_trial(study: Study, rows: Sequence[EpisodeRow], method: str, bank: Path) -> Trial:
    """The scene, models and policy of some rows of one task and variant, built or cached.

    The scene holds only what the rows place. It is closed when the next one is built.
    """
    first = rows[0]
    suite = suites.suite(first.suite)
    scene = _scene(study, rows)
    stack = _stack(study.stack) if needs_stack(method) or study.policy == "scripted" else None
    policy = _policy(study=study, method=method, row=first, bank=bank, scene=scene, stack=stack)
    return Trial(
        method=method,
        scene=scene,
        policy=policy,
        prompter=make_prompter(method, first, bank=bank, scene=scene, stack=stack),
        control=suite.control,
        sensor=suite.sensor,
        occlusion=_occlusion(method, policy.execute),
        images_every=study.images_every,
        follow=study.follow,
        audit=study.audit,
    )


def _occlusion(method: str, execute: int) -> Occlusion | None:
    """When the method's target is hidden: from the policy's HIDDEN_FROM-th call on."""
    calls = hidden_calls(method)
    if not calls:
        return None
    return Occlusion(start=HIDDEN_FROM * execute, frames=calls * execute)


def _check_names(study: Study) -> None:
    for method in study.methods:
        if method not in known_methods():
            raise one_of("Study: method (or an arm of `ablate`)", method, METHODS)
    check_policy_name(study.policy)
    if study.robots not in MESHES:
        raise one_of("Study: robots", study.robots, MESHES)
    check_stack(study.stack, "Study")
    for suite, task in study.tasks:
        if not study.rows(suite, task):
            raise _no_such_split(study.split, suite, task)
        for method in study.methods:
            if suite in suites.SHARED and not suits_shared(method):
                raise BadStudy(
                    f"Study: {method} knows one object, and {suite} has several; take generic, or "
                    "vap and its variants."
                )


def _no_such_split(split: str, suite: str, task: str) -> BadStudy:
    there = sorted({row.split for row in suites.rows(suite, task)} - {""})
    known = f"it has {' and '.join(there)}" if there else "its list has no splits"
    return BadStudy(f"Study: {suite}/{task} has no split {split!r}; {known}.")


def _check_policy(study: Study) -> None:
    policy = study.policy
    if policy not in POLICIES:
        require("policy", f"the policy {policy}")
    for suite, _ in study.tasks:
        if policy == MINI and not shipped(suite).is_dir():
            names = sorted(path.name for path in SHIPPED.glob(f"{MINI}-*"))
            there = ", ".join(names) or "none"
            raise BadStudy(
                f"Study: no {MINI} for {suite} ships (there is {there}); run: python -m vap_core "
                f"train policy --suite {suites.benchmark_name(suite)}"
            )
    if study.temperature is not None:
        if policy in POLICIES:
            raise BadStudy(
                f"Study: policy {policy!r} samples nothing; leave --temperature out, or take "
                f"--policy {MINI}."
            )
        if not 0 <= study.temperature <= HOTTEST:
            raise BadStudy(
                f"Study: temperature {study.temperature:g}; say a number from 0, no noise, to "
                f"{HOTTEST:g}."
            )
    if policy in PRIVILEGED and study.audit:
        raise BadStudy(
            f"Study: policy {policy!r} consumes no prompt; there is nothing to audit. Leave "
            "--audit out."
        )
    if policy in PRIVILEGED and study.methods != ("generic",):
        raise BadStudy(
            f"Study: policy {policy!r} reads the simulator, not pictures; no method can prompt "
            "it. Use --method generic."
        )
    absent = [suite for suite, _ in study.tasks if suite.endswith(suites.ABSENT)]
    if policy == "expert" and absent:
        raise BadStudy(
            f"Study: {absent[0]} leaves the target out, which the expert would go for; leave that "
            "suite or the expert out."
        )
    if policy == "scripted" and _any_method(study, has_no_command):
        raise BadStudy(
            f"Study: policy {policy!r} parses its command, and blank-text gives it none; leave "
            f"blank-text out, or take --policy {MINI}."
        )
    if policy in POLICIES and _any_method(study, needs_token):
        raise BadStudy(
            f"Study: policy {policy!r} has no words that could be learned; leave soft out, or take "
            f"--policy {MINI}."
        )


def _any_method(study: Study, needs: Callable[[str], bool]) -> bool:
    return any(needs(method) for method in study.methods)


def _world_digest(study: Study) -> str:
    found = hashlib.sha256(_canonical((RIGS, VARIANTS)))
    for suite, task in study.tasks:
        known = suites.suite(suite)
        robot = robots.get(known.robot)
        placed = set()
        for row in study.rows(suite, task):
            for place in row.placements:
                placed.add(place.model)
        models = [get_object(name) for name in sorted(placed)]
        found.update(_canonical((known, robot, models)) + robot.xml.read_bytes())
    return found.hexdigest()[:16]


def _canonical(value: Any) -> bytes:
    """Every number in a value, whatever NumPy's print options are; of files their names."""

    def plain(part: Any) -> Any:
        if is_dataclass(part) and not isinstance(part, type):
            parts = {"kind": type(part).__name__}
            for field in fields(part):
                parts[field.name] = getattr(part, field.name)
            return parts
        if isinstance(part, np.ndarray | np.generic):
            return part.tolist()
        if isinstance(part, Path):
            return part.name
        raise TypeError(
            f"Study: {type(part).__name__} cannot be hashed; give it fields, or add its kind here."
        )

    return json.dumps(value, default=plain, sort_keys=True).encode()


_stack = cache(load_stack)


def _policy(
    study: Study, method: str, row: EpisodeRow, bank: Path, scene: Scene, stack: Stack | None
) -> Policy[Any] | PrivilegedPolicy[Any]:
    """The frozen policy of the study; for the soft prompt with the learned token's embedding."""
    suite = suites.suite(row.suite)
    if study.policy in POLICIES:
        return make_policy(study.policy, scene, suite, stack)
    from vap_core.policies.lerobot import adapter  # and torch

    policy = adapter.load_for_suite(
        study.checkpoint(row.suite), scene, suite, temperature=study.temperature
    )
    if not needs_token(method):
        return policy
    embedding = _token_embedding(study.checkpoint(row.suite), method, row.target, bank)
    return policy.with_tokens({WORD: embedding})


def _token_embedding(
    checkpoint: str, method: str, target: str, bank: Path
) -> Float32[np.ndarray, " d"]:
    """The embedding that the target's word has under a method with a soft prompt."""
    from vap_core.policies.mini_pi0.token_alignment import align
    from vap_core.policies.mini_pi0.vlm import load_from_policy

    folder = checkpoints.locate(checkpoint)
    space = token_space(method)
    if space == "own":
        own = load_from_policy(folder).sha256()
        return token_file.load(bank, target, own, token_file.OWN_SUFFIX).embedding
    token = token_file.load(bank, target, checkpoints.config_field(folder, "vlm"))
    if space == "aligned":
        return align(token.embedding, MODEL, folder)
    return token.embedding


def _scene(study: Study, rows: Sequence[EpisodeRow]) -> Scene:
    """The scene of what some rows of one task and variant place; the last one is kept.

    Objects are in the order of the variant's whole list, so that the physics of an episode does not
    depend on the rows beside it. Physics among 100 parked objects takes 2.6 times as long as among
    6.
    """
    first = rows[0]
    listed = []
    for row in study.rows(first.suite, first.task):
        if row.variant == first.variant:
            listed.append(row)
    placed = _models(rows)
    names = [name for name in _models([*listed, *rows]) if name in placed]
    key = (first.suite, tuple(names), first.variant, study.robots)
    if key not in _last_scene:
        for scene in _last_scene.values():
            scene.close()
        _last_scene.clear()
        _last_scene[key] = build_scene(*key)
    return _last_scene[key]


def _models(rows: Sequence[EpisodeRow]) -> dict[str, None]:
    """The objects that rows place, in order of first appearance."""
    names: dict[str, None] = {}
    for row in rows:
        for place in row.placements:
            names[place.model] = None
    return names


_last_scene: dict[tuple[str, tuple[str, ...], str, Meshes], Scene] = {}
"""The scene that was built last, by suite, objects, variant and meshes."""

DEMO = Study(
    tasks=(("widowx-pick", "pick-straw-cup"), ("franka-pick", "pick-cup")),
    methods=("generic", "vap"),
    episodes=20,
)
"""The main job: one task on each of two robots, generic against VAP."""
