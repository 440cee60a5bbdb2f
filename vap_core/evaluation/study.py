"""A study: which tasks, methods and policy, and how many episodes."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vap_core import __version__
from vap_core.base.commands import command
from vap_core.base.errors import BadStudy, one_of
from vap_core.base.extras import require
from vap_core.evaluation import world
from vap_core.evaluation.methods import (
    METHODS,
    PUBLISHED,
    describe,
    find,
    has_no_command,
    known_methods,
    needs_memory,
    needs_token,
    suits_shared,
)
from vap_core.evaluation.policy_names import MINI, POLICIES, PRIVILEGED, SHIPPED, shipped
from vap_core.perception.stacks import check_stack, checksums
from vap_core.policies.lerobot import checkpoints
from vap_core.policies.names import check_policy_name, label_of
from vap_core.rollout.loop import Follow
from vap_core.simulation import suites
from vap_core.simulation.scenes import Meshes
from vap_core.simulation.suites import starts
from vap_core.simulation.types import EpisodeRow

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
        return "" if self.policy in POLICIES else self.policy

    def policy_label(self, suite: str) -> str:
        """What the rows of a suite call the policy. Raises: BadPolicy."""
        checkpoint = self.checkpoint(suite)
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
        own = sorted(set(self.methods) - PUBLISHED)
        if own:
            about["arms"] = {method: describe(find(method)) for method in own}
        about |= {"version": __version__, "lists": digests}
        about |= checksums(self.stack if self.uses_stack() else "embedded")
        if digests and self.seed + self.seeds > 1:
            about["starts"] = starts.settings()
        own_motions = {}
        if self.policy == "scripted":
            own_motions = world.own_motions(suite for suite, _ in self.tasks)
        if own_motions:
            about["motions"] = own_motions
        listed = [(suite, self.rows(suite, task)) for suite, task in self.tasks]
        return {**about, "world": world.digest(listed)}


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
    if policy == "scripted" and study.any_method(has_no_command):
        raise BadStudy(
            f"Study: policy {policy!r} parses its command, and blank-text gives it none; leave "
            f"blank-text out, or take --policy {MINI}."
        )
    if policy in POLICIES and study.any_method(needs_token):
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
