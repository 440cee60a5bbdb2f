"""A study of episodes, and what its batches need: memory, a scene, models and a policy."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from vap_core import __version__, environments
from vap_core.base.errors import BadStudy, command, one_of, require
from vap_core.base.types import Rgb, value
from vap_core.environments import AnyScene, open_env
from vap_core.memory import load_bank, register, save
from vap_core.perception.describe import AttributeCaptioner, with_description
from vap_core.perception.protocols import Detector, Stack
from vap_core.perception.stacks import check_stack, checksums, load_stack
from vap_core.policies.lerobot import checkpoints
from vap_core.policies.mini_pi0 import learned_token
from vap_core.policies.mini_pi0.learned_token import WORD, file_suffix, model_of, teach, teach_own
from vap_core.policies.names import MINI as MINI
from vap_core.policies.names import POLICIES as POLICIES
from vap_core.policies.names import PRIVILEGED as PRIVILEGED
from vap_core.policies.names import SHIPPED as SHIPPED
from vap_core.policies.names import (
    check_policy_name,
    checkpoint_of,
    is_served,
    label_of,
    shipped_checkpoint,
)
from vap_core.policies.protocol import Policy, PrivilegedPolicy
from vap_core.policies.scripted.expert import Expert
from vap_core.policies.scripted.scripted import PlacedScripted, Random, Scripted, ScriptedExpert
from vap_core.rollout.calls import check_policy
from vap_core.rollout.loop import Follow, Trial, rollout
from vap_core.rollout.prompters import generic
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import ObjectModel, get_object
from vap_core.simulation.occluder import Occlusion
from vap_core.simulation.scenes import Meshes, Scene
from vap_core.simulation.studio import reference_views
from vap_core.simulation.suites import Suite, benchmark_name, starts
from vap_core.simulation.suites.open_row import build_scene, models_of
from vap_core.simulation.types import EpisodeRow
from vap_core.study import world
from vap_core.study.methods import (
    FEWEST_REFERENCES,
    METHODS,
    PUBLISHED,
    describe,
    find,
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


def scripted(detector: Detector, scene: AnyScene, suite: Suite) -> Scripted:
    """The scripted policy, calibrated to the suite's first camera.

    Raises: UnknownName for a camera that the scene lacks, or a robot without a scripted motion.
    """
    (camera,) = open_env(scene, suite.cameras[:1]).cameras()
    if not isinstance(scene, Scene):
        return PlacedScripted(scene.robot, suite.hz, camera, scene.sizes_m)
    return Scripted(
        detector=detector,
        camera=camera,
        robot=scene.robot,
        hz=suite.hz,
        control=suite.control,
    )


def make_policy(
    name: str, scene: AnyScene, suite: Suite, stack: Stack | None
) -> Policy[Any] | PrivilegedPolicy[Any]:
    """One of `POLICIES`; only the scripted one needs a stack. Raises: UnknownName."""
    if suite.environment == "gym" and name != "random":
        raise BadStudy(
            f"Study: {suite.name} has no scripted motion; take --policy random, a checkpoint or a "
            "server."
        )
    match name:
        case "scripted":
            assert stack is not None, "the scripted policy needs a detector"
            return scripted(stack.category_detector, scene, suite)
        case "expert":
            if isinstance(scene, Scene):
                return Expert()
            (camera,) = open_env(scene, suite.cameras[:1]).cameras()
            return ScriptedExpert(scene.robot, suite.hz, camera, scene.sizes_m)
        case "random":
            return Random()
    raise one_of("make_policy: policy", name, POLICIES)


def shipped(suite: str) -> Path:
    """Where the shipped policy of a suite is, if there is one."""
    return shipped_checkpoint(benchmark_name(suite))


def policy_today(policy: str, label: str, suite: str) -> str:
    """How the policy of a run is named here, of which a row of the suite has this label.

    Where the run names no folder that is here, it is the shipped one that the label names: the
    suite's default, or a folder below data/policies. A default of before keeps the folder that it
    had, whether it ships or not: today's is another policy.
    """
    from vap_core.policies.lerobot.checkpoints import is_checkpoint_name

    name = checkpoint_of(label)
    if not name or is_checkpoint_name(policy) or not (policy == MINI or (SHIPPED / name).is_dir()):
        return policy
    default = shipped(suite)
    of_default = name == default.name and label.startswith(label_of(default))
    return MINI if of_default else f"data/policies/{name}"


def default_policy(suites: Iterable[str]) -> str:
    """The shipped frozen policy where every suite has one, else the scripted one."""
    return MINI if all(shipped(suite).is_dir() for suite in suites) else "scripted"


MESHES = ("plain", "menagerie")
HOTTEST = 10.0
"""The largest factor of a policy's sampling noise."""


@dataclass(frozen=True)
class Study:
    """The same episodes of every task, once per method and seed.

    `episodes` None takes whole lists. `images_every`, `follow` and `audit` are rollout.Trial's.
    `temperature` scales the sampling noise of a mini-pi0; None leaves it as its checkpoint says.
    `object` names an object that takes the target's place (suites.own_object). `suite_files` are
    the files of own suites; they are executed (suites.own). `split` takes the episodes of one split
    of a suite's list, for example visual matching.

    Raises: UnknownName, BadStudy, when it is built from what does not fit together; BadSuite for a
        file or a list of a suite that is damaged; MissingPart.
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
        return "" if self.policy in POLICIES or is_served(self.policy) else self.policy

    def policy_label(self, suite: str) -> str:
        """What the rows of a suite call the policy. Raises: BadPolicy."""
        checkpoint = self.checkpoint(suite)
        if is_served(self.policy):
            from vap_core.policies.served import parse_address

            return parse_address(self.policy).label
        return label_of(checkpoint, self.temperature) if checkpoint else self.policy

    def any_method(self, holds: Callable[[str], bool]) -> bool:
        """Whether something holds for any of its methods."""
        return any(holds(method) for method in self.methods)

    def uses_stack(self) -> bool:
        """Whether anything of it loads the stack."""
        return self.policy == "scripted" or self.any_method(needs_memory)

    def next_command(self, *words: str | Path) -> str:
        """A command to print, to be run next; it finds the study's own suites."""
        return command(*words, environment=suites.own.environment(self.suite_files))

    def configuration(self) -> dict[str, Any]:
        """What the results depend on, as JSON.

        Weights, episode lists, and the world (robots, objects, styles, sensors) enter by checksum,
        methods by name, and those that are not published by what they change, too. With the
        scripted policy the motions that do not ship enter as well; of a stack whose parts are not
        all embedded, its models' files and the thresholds kept on this machine; of a caller's own
        stack what its parts are.

        Raises: BadPolicy for a checkpoint that is not on this machine; MissingWeights when the
            backbone's package is not installed or the stack's models are not here; BadSuite for a
            list without a checksum; BadObject for a damaged scan; BadStudy for an arm that
            `describe` refuses.
        """
        named = [suite for suite, _ in self.tasks]
        digests = {suite: suites.digest(suite) for suite in named if suites.has_list(suite)}
        names = sorted(set(map(self.checkpoint, named)) - {""})
        fingerprints = [checkpoints.fingerprint(name) for name in names]
        about = asdict(self)
        if self.temperature is None:  # digests are those of versions without it
            del about["temperature"]
        for option in ("object", "split"):
            if not about[option]:
                del about[option]
        del about["suite_files"]  # the lists' digests stand for them
        if is_served(self.policy):
            about["served"] = self.policy_label("")
        if names == [self.policy]:
            about["checkpoint"] = fingerprints[0]
        elif names:
            about["checkpoints"] = fingerprints
        own = sorted(set(self.methods) - PUBLISHED)
        if own:
            about["arms"] = {method: describe(find(method)) for method in own}
        about |= {"version": __version__, "lists": digests}
        about |= checksums(self.stack if self.uses_stack() else "embedded")
        if digests and self.seed + self.seeds > 1:
            about["starts"] = starts.settings()
        own_motions = world.own_motions(named) if self.policy == "scripted" else {}
        if own_motions:
            about["motions"] = own_motions
        listed = [(suite, self.rows(suite, task)) for suite, task in self.tasks]
        return {**about, "world": world.digest(listed, world.EDITION)}


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
            there = sorted({row.split for row in suites.rows(suite, task)} - {""})
            known = f"it has {' and '.join(there)}" if there else "its list has no splits"
            raise BadStudy(f"Study: {suite}/{task} has no split {study.split!r}; {known}.")
        for method in study.methods:
            if suite in suites.SHARED and not suits_shared(method):
                raise BadStudy(
                    f"Study: {method} knows one object, and {suite} has several; take generic, or "
                    "vap and its variants."
                )


def _check_policy(study: Study) -> None:
    policy = study.policy
    if is_served(policy):
        from vap_core.policies.served import parse_address

        parse_address(policy)
    elif policy not in POLICIES:
        require("policy", f"the policy {policy}")
    for suite, _ in study.tasks:
        if policy == MINI and not shipped(suite).is_dir():
            there = ", ".join(sorted(path.name for path in SHIPPED.glob(f"{MINI}-*"))) or "none"
            raise BadStudy(
                f"Study: no {MINI} for {suite} ships (there is {there}); run: ./vap "
                f"train policy --suite {suites.benchmark_name(suite)}"
            )
    if study.temperature is not None:
        if policy in POLICIES or is_served(policy):
            raise BadStudy(
                f"Study: policy {policy!r} samples nothing that is set from here; leave "
                f"--temperature out, or take --policy {MINI}."
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
    if policy == "scripted" and study.any_method(has_no_command):
        raise BadStudy(
            f"Study: policy {policy!r} parses its command, and blank-text gives it none; leave "
            f"blank-text out, or take --policy {MINI}."
        )
    if (policy in POLICIES or is_served(policy)) and study.any_method(needs_token):
        raise BadStudy(
            f"Study: policy {policy!r} has no words that could be learned; leave soft out, or take "
            f"--policy {MINI}."
        )


DEMO = Study(
    tasks=(("widowx-pick", "pick-straw-cup"), ("franka-pick", "pick-cup")),
    methods=("generic", "vap"),
    episodes=20,
)
"""The main job: one task on each of two robots, generic against VAP."""


HIDDEN_FROM = 2
"""The call of the policy, counted from 0, from which an arm of `ablate` hides the target."""
_stack = cache(load_stack)
_last_scene: dict[tuple[str, tuple[str, ...], str, Meshes, str], AnyScene] = {}
"""The scene that was built last, by suite, objects, variant, meshes and another library's task."""


def register_personal(study: Study, bank: Path) -> None:
    """Remember the personal object of every task from five rendered reference views, or more where
    a method wants them.

    An object that is in memory with enough of them stays. Where a method needs its description, it
    is described too, offline; for the soft prompt its token is learned. A study that prompts
    nothing needs no memory.

    Raises: as `load_stack`; BadMemory for a damaged memory; BadObject for a damaged scan;
        BadPolicy, BadStudy, as `teach` and `teach_own`; BadOutput when `bank` cannot be written.
    """
    if not study.any_method(needs_memory):
        return
    stack = load_stack(study.stack)
    known = load_bank(bank)
    n_references = max(map(references_needed, study.methods))
    for suite, task in study.tasks:
        rows = study.rows(suite, task)
        owned = [owned.model for owned in rows[0].owned]  # in shared scenes
        for target in owned or [rows[0].target]:
            obj = known.get(target)
            if obj is None or len(obj.crops) < n_references:
                model = get_object(target)
                photos = _photos(model, n_references)
                obj, _ = register(target, model.category, photos, stack.detector, stack.encoder)
            if study.any_method(needs_description) and obj.description is None:
                seen = obj.first(FEWEST_REFERENCES)
                described = with_description(seen, AttributeCaptioner(stack.segmenter))
                obj = replace(obj, description=described.description)
            spaces = {token_space(method) for method in study.methods}
            if spaces & {"copied", "aligned"}:
                teach(rows, bank, checkpoints.config_field(study.checkpoint(suite), "vlm"))
            if "own" in spaces:
                teach_own(rows, bank, checkpoints.locate(study.checkpoint(suite)))
            if obj is not known.get(target):
                save(bank, obj, replace=True)
                known[target] = obj


def _photos(model: ObjectModel, n: int) -> list[Rgb]:
    """The reference photos of which each method takes as many as it wants, the first of them.

    The first five do not depend on `n`: methods differ in nothing else, whatever else is run.
    """
    photos = reference_views(model, FEWEST_REFERENCES)
    if n > FEWEST_REFERENCES:
        photos += reference_views(model, n - FEWEST_REFERENCES, seed=1)
    return photos


def make_trial(
    study: Study,
    rows: Sequence[EpisodeRow],
    method: str,
    bank: Path,
    policy: Policy[Any] | PrivilegedPolicy[Any] | None = None,
) -> Trial:
    """The scene, models and policy of some rows of one task and variant, built or cached.

    The scene holds only what the rows place. It is closed when the next one is built. `policy`
    takes the place of the study's; an arm of `ablate` then hides the target for that one's calls.

    Raises: UnknownName for a suite that no registry holds; BadPolicy when the checkpoint is not on
        this machine or does not fit the suite, or `policy` lacks what the loop needs; BadMemory
        when a description or a token that the method needs is not in `bank`; MissingMeshes for a
        robot whose meshes are not here.
    """
    first = rows[0]
    suite = suites.suite(first.suite)
    scene = _scene(study, rows)
    scripted = policy is None and study.policy == "scripted"
    stack = _stack(study.stack) if needs_stack(method) or scripted else None
    if policy is None:
        policy = _policy(study=study, method=method, row=first, bank=bank, scene=scene, stack=stack)
    check_policy(policy)
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


def _policy(
    study: Study,
    method: str,
    row: EpisodeRow,
    bank: Path,
    scene: AnyScene,
    stack: Stack | None,
) -> Policy[Any] | PrivilegedPolicy[Any]:
    """The frozen policy of the study; for the soft prompt with the learned token's embedding."""
    suite = suites.suite(row.suite)
    if study.policy in POLICIES:
        return make_policy(study.policy, scene, suite, stack)
    if is_served(study.policy):
        from vap_core.policies.served import served_for_suite

        return served_for_suite(study.policy, scene, suite)
    from vap_core.policies.lerobot import adapter  # and torch

    policy = adapter.load_for_suite(
        study.checkpoint(row.suite), scene, suite, temperature=study.temperature
    )
    if not needs_token(method):
        return policy
    return policy.with_tokens({WORD: _token_embedding(study, method, row, bank)})


def _token_embedding(
    study: Study, method: str, row: EpisodeRow, bank: Path
) -> Float32[np.ndarray, " d"]:
    """The embedding that the target's word has under a method with a soft prompt."""
    from vap_core.policies.mini_pi0.learned_token import align
    from vap_core.policies.mini_pi0.vlm import load_from_policy

    folder = checkpoints.locate(study.checkpoint(row.suite))
    rows = study.rows(row.suite, row.task)
    space = token_space(method)
    if space == "own":
        own = load_from_policy(folder).sha256()
        suffix = file_suffix(rows, own, learned_token.OWN_SUFFIX)
        return learned_token.load(bank, row.target, own, suffix).embedding
    initialised_from = checkpoints.config_field(folder, "vlm")
    token = learned_token.load(
        bank, row.target, initialised_from, file_suffix(rows, initialised_from)
    )
    if space == "aligned":
        return align(token.embedding, model_of(initialised_from), folder)
    return token.embedding


def _scene(study: Study, rows: Sequence[EpisodeRow]) -> AnyScene:
    """The scene of what some rows of one task and variant place; the last one is kept."""
    first = rows[0]
    elsewhere = first.task if suites.suite(first.suite).environment else ""
    key = (first.suite, tuple(models_of(rows)), first.variant, study.robots, elsewhere)
    if key not in _last_scene:
        for scene in _last_scene.values():
            scene.close()
        _last_scene.clear()
        _last_scene[key] = environments.open_world(rows) if elsewhere else build_scene(*key[:-1])
    return _last_scene[key]


@value
class Tried:
    """How often the expert succeeds in a task, and the episodes in which it does not."""

    where: str
    n: int
    failed: tuple[str, ...]

    def __str__(self) -> str:
        succeeded = self.n - len(self.failed)
        text = f"{self.where}: the expert succeeds in {succeeded} of {self.n} episodes"
        if self.failed:
            text += f"; not in {', '.join(self.failed)}"
        return text


def feasible(rows: Sequence[EpisodeRow]) -> tuple[bool, ...]:
    """Whether the expert succeeds in each row; rows of one suite. About a second a row.

    Raises: UnknownName for a suite or an object that no registry holds.
    """
    succeeded: dict[int, bool] = {}
    for variant in dict.fromkeys(row.variant for row in rows):
        part = {i: row for i, row in enumerate(rows) if row.variant == variant}
        succeeded |= zip(part, _try_rows([*part.values()]), strict=True)
    return tuple(succeeded[i] for i in range(len(rows)))


def _try_rows(rows: Sequence[EpisodeRow]) -> list[bool]:
    """`feasible` for rows of one suite and variant."""
    suite = suites.suite(rows[0].suite)
    scene: AnyScene
    if suite.environment:
        scene = environments.open_world(rows)
    else:
        scene = build_scene(suite.name, models_of(rows), rows[0].variant)
    with closing(scene):
        trial = Trial(
            method="generic",
            scene=scene,
            policy=make_policy("expert", scene, suite, None),
            prompter=generic(),
            control=suite.control,
            sensor=suite.sensor,
            follow="call",
        )
        return [episode.outcome.success for episode in rollout(trial, rows)]


def check_feasible(study: Study) -> tuple[Tried, ...]:
    """The expert's successes in every task of a study.

    Raises: BadStudy where it succeeds in no episode of a task: then no policy can be blamed.
    """
    found = []
    for suite, task in study.tasks:
        rows = study.rows(suite, task)
        failed = [row for row, good in zip(rows, feasible(rows), strict=True) if not good]
        names = tuple(f"{r.episode} (seed {r.seed})" if r.seed else str(r.episode) for r in failed)
        tried = Tried(where=f"{suite}/{task}", n=len(rows), failed=names)
        if len(failed) == len(rows):
            raise BadStudy(f"{tried}. {_remedy(study)}")
        found.append(tried)
    return tuple(found)


def _remedy(study: Study) -> str:
    if study.object:
        return (
            f"{study.object} may be too wide or too low for the robot: import it with another "
            "--height-cm, or take a task that asks for a touch."
        )
    return "Leave the task out, or move its objects within the robot's reach."
