"""The methods that the paper compares, by name, and the prompter of each (P 5.2)."""

import inspect
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from vap_core.associate import PAIRINGS
from vap_core.attend import Attender, Prompting
from vap_core.base.errors import BadStudy
from vap_core.base.version import source_digest
from vap_core.evaluation.ablations.arms import ARMS, Hidden
from vap_core.evaluation.ablations.arrow import Arrow, ArrowPrompter
from vap_core.memory import load_bank
from vap_core.perception.protocols import Stack
from vap_core.policies.mini_pi0.learned_token import WORD
from vap_core.rollout.prompters.oracle import Oracle, OraclePrompter
from vap_core.rollout.prompters.protocol import Prompter
from vap_core.rollout.prompters.switch import Switch, SwitchPrompter
from vap_core.rollout.prompters.text import (
    HardPrompt,
    OtherCommand,
    SoftPrompt,
    generic,
    hard_prompt,
    say,
    soft_prompt,
)
from vap_core.rollout.prompters.tint import TintPrompter
from vap_core.simulation import robots
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.scenes import Scene
from vap_core.simulation.suites import suite
from vap_core.simulation.types import EpisodeRow

type Method = (
    Prompting | HardPrompt | SoftPrompt | Oracle | Hidden | Switch | OtherCommand | Arrow | None
)

METHODS: dict[str, Method] = {
    "generic": None,
    "hard-short": HardPrompt("short"),
    "hard-long": HardPrompt("long"),
    "soft": SoftPrompt(),
    "soft-aligned": SoftPrompt("aligned"),
    "soft-own": SoftPrompt("own"),
    "vap": Prompting(),
    "vap-always-tint": Prompting(always_tint=True),
    "mask-only": Prompting(rewrite=False),
    "rewrite-only": Prompting(highlight=False),
    "vap-associated": Prompting(associate=PAIRINGS["geometry"]),
    "oracle-box": Oracle("box"),
    "oracle-mask": Oracle("mask"),
    "oracle-track": Oracle("track"),
    "wrong-mask": Oracle("track", of="look-alike"),
}
"""What each method changes in the policy's inputs; None changes nothing. Association is not the
paper's, nor are soft-aligned and soft-own, nor the last four: they read the simulator, and bound
what results can be."""
FEWEST_REFERENCES = 5
"""Reference photos of an object, unless a method needs more."""

PUBLISHED = frozenset(
    """
    generic hard-short hard-long soft soft-aligned soft-own vap vap-always-tint mask-only
    rewrite-only vap-associated oracle-box oracle-mask oracle-track wrong-mask
    average-rule best-rule references-1 references-3 references-7
    opaque contour box point circle arrow marker dimmed others-erased
    opacity-0.1 opacity-0.3 opacity-0.7 only-red only-blue only-green only-magenta only-cyan
    only-yellow only-orange only-purple hidden-1 hidden-2 hidden-3 hidden-4 hidden-5 hidden-6
    blank-text other-text mask-area-0.25 mask-area-0.5 mask-area-1.5 mask-area-2.0 mask-shifted
    associated-objects
    switched-early switched-moved
""".split()
)
"""Methods whose runs are published: their names alone are in the digests of these. Every other one
enters by its description, so that another definition of it is another run."""

_ALL: dict[str, Method] = {**METHODS, **ARMS}


def known_methods() -> tuple[str, ...]:
    """The names of METHODS, and of the arms of every ablation."""
    return tuple(_ALL)


def find(method: str) -> Method:
    """What a method, or an arm of an ablation, changes. Raises: KeyError."""
    return _ALL[method]


def describe(how: Any) -> Any:
    """What a method changes, as JSON: kinds and numbers, and a digest of the code of its form.

    Where a function has no source, its name stands for it.

    Raises: BadStudy for what has numbers that are found neither in fields nor in the source of a
        module: a closure, a partial, a bound method, an array, an object of another class.
    """
    if how is None or isinstance(how, str | int | float):
        return how
    if type(how) in (list, tuple):
        return [describe(part) for part in how]
    if isinstance(how, Mapping):
        return {str(key): describe(part) for key, part in how.items()}
    about: dict[str, Any] = {"kind": type(how).__qualname__}
    if is_dataclass(how) and not isinstance(how, type) and _is_of_a_module(type(how)):
        for field in fields(how):
            about[field.name] = describe(getattr(how, field.name))
    elif inspect.isfunction(how) and _is_of_a_module(how) and how.__closure__ is None:
        about = {"kind": f"<function {how.__qualname__}>"}
        about |= describe(how.__dict__)
    else:
        name = getattr(how, "__qualname__", type(how).__qualname__)
        raise BadStudy(
            f"Study: an arm uses {name}, and another one with other numbers would look the same; "
            "take a dataclass or a function of a module, with its numbers in fields or in its own "
            "source."
        )
    if callable(how):
        about["code"] = source_digest(how)
    return about


def _is_of_a_module(code: Any) -> bool:
    """Whether a function or class is defined at the top of a module, under a name."""
    return "<" not in code.__qualname__


def hidden_calls(method: str) -> int:
    """For how many calls of the policy the target is hidden."""
    how = find(method)
    return how.calls if isinstance(how, Hidden) else 0


def references_needed(method: str) -> int:
    """How many reference photos of an object the method wants."""
    how = find(method)
    wanted = how.references if isinstance(how, Prompting) else None
    return max(FEWEST_REFERENCES, wanted or 0)


def needs_memory(method: str) -> bool:
    """Whether the method refers to remembered objects."""
    how = find(method)
    return how is not None and not isinstance(how, OtherCommand)


def needs_description(method: str) -> bool:
    return isinstance(find(method), HardPrompt)


def needs_token(method: str) -> bool:
    return isinstance(find(method), SoftPrompt)


def has_no_command(method: str) -> bool:
    """Whether the policy reads nothing, so that one that parses its commands cannot run."""
    return find(method) == OtherCommand("blank")


def token_space(method: str) -> str:
    """Where the method's token is learned: copied, aligned or own; "" where there is none."""
    how = find(method)
    return how.space if isinstance(how, SoftPrompt) else ""


def needs_stack(method: str) -> bool:
    return isinstance(find(method), Prompting | Oracle | Hidden | Switch | Arrow)


def make_prompter(
    method: str, row: EpisodeRow, bank: Path, scene: Scene, stack: Stack | None
) -> Prompter:
    """The prompter of a method for the row's target; `stack` is there where `needs_stack`.

    Raises: BadMemory.
    """
    match find(method):
        case None:
            return generic()
        case HardPrompt() as how:
            return hard_prompt(load_bank(bank)[row.target], how)
        case SoftPrompt():
            return soft_prompt(WORD, _categories(row))
        case OtherCommand(command="blank"):
            return say("")
        case OtherCommand():
            return say(_next_command(row))
        case Prompting() as how:
            return TintPrompter(_attender(how, row, bank, stack))
        case Hidden(prompting=how):
            return TintPrompter(_attender(how, row, bank, stack))
        case Arrow():
            attender = _attender(Prompting(highlight=False), row, bank, stack)
            return ArrowPrompter(attender, robots.get(suite(row.suite).robot).base_world)
        case Oracle() as oracle:
            attender = _attender(oracle.prompting, row, bank, stack)
            return OraclePrompter(attender, oracle, _alike(scene, row))
        case Switch() as switch:
            return SwitchPrompter(
                _attender(Prompting(), row, bank, stack), switch, _alike(scene, row)
            )


def _alike(scene: Scene, row: EpisodeRow) -> frozenset[str]:
    """The scene's objects of the target's category, or of every sub-goal's."""
    categories = _categories(row)
    return frozenset(name for name in scene.objects if get_object(name).category in categories)


def _categories(row: EpisodeRow) -> set[str]:
    """The target's category, or those of every sub-goal."""
    return {row.category, *(subgoal.category for subgoal in row.subgoals)}


def _next_command(row: EpisodeRow) -> str:
    """The command of the suite's next task with another one. Raises: BadStudy."""
    tasks = suite(row.suite).tasks
    names = [task.name for task in tasks]
    start = names.index(row.task) + 1
    for task in (*tasks[start:], *tasks[:start]):
        if task.instruction != row.instruction:
            return task.instruction
    raise BadStudy(f"other-text: {row.suite} has one command only; leave other-text out.")


def _attender(how: Prompting, row: EpisodeRow, bank: Path, stack: Stack | None) -> Attender:
    """The method with the row's target in memory; in a shared scene with every owned object."""
    assert stack is not None, "a method that prompts needs a stack"
    known = load_bank(bank, stack.encoder.name)
    # Other methods of the run may have wanted more photos.
    n_references = how.references or FEWEST_REFERENCES
    if not row.owned:
        return Attender(stack, {row.target: known[row.target].first(n_references)}, how)
    memory = {}
    for owned in row.owned:
        obj = known[owned.model].first(n_references)
        memory[owned.model] = replace(obj, owner=owned.owner, known_as=owned.known_as)
    return Attender(stack, memory, how, speaker=row.speaker)


def suits_shared(method: str) -> bool:
    """Whether a method can be used where several objects are remembered: text for one cannot."""
    how = find(method)
    return how is None or isinstance(how, Prompting)
