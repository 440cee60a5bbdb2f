"""The methods that the paper compares, the arms of every ablation, and their prompters (P 5.2).

A new arm is a line in `ABLATIONS`: its name is a method that `eval --methods` takes, too.
"""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from vap_core.attend import Attender, Prompting
from vap_core.base.errors import BadInstruction, BadStudy, UnknownName
from vap_core.base.files import source_digest
from vap_core.base.types import Colour, Instruction
from vap_core.environments import AnyScene
from vap_core.memory import load_bank
from vap_core.perception.protocols import Stack
from vap_core.policies.mini_pi0.learned_token import WORD
from vap_core.prompt import PALETTE, Tint
from vap_core.rollout.prompters import (
    HardPrompt,
    Oracle,
    OraclePrompter,
    OtherCommand,
    Prompter,
    SoftPrompt,
    Switch,
    SwitchPrompter,
    TintPrompter,
    generic,
    hard_prompt,
    say,
    soft_prompt,
)
from vap_core.simulation import robots
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.suites import suite
from vap_core.simulation.types import EpisodeRow
from vap_core.study.forms import (
    Arrow,
    ArrowPrompter,
    Circle,
    Contour,
    DimmedBackground,
    FilledBox,
    NumberedMarker,
    OthersErased,
    Point,
)

DEFAULT = "vap"
"""The arm that every other is compared with."""


@dataclass(frozen=True)
class Hidden:
    """The method, while the target is hidden from all cameras for some calls of the policy."""

    calls: int
    prompting: Prompting = field(default_factory=Prompting)


@dataclass(frozen=True)
class Implicit(Prompting):
    """The method, told what the object is for, or when it was used, instead of "my cup"."""


type Arm = Prompting | Oracle | Hidden | Switch | OtherCommand | Arrow


@dataclass(frozen=True)
class Ablation:
    """One ablation: a question, and its arms by method name.

    `paper` is the paper's table (data/paper_tables.csv), `rows` its row for each arm that it has.
    Arms named in `methods` are methods already, or arms of another ablation.
    `suites` are those that it runs on where none is named. `retired` counts arms
    that were tried on the same lists and are no longer here: Holm's correction counts them.
    """

    question: str
    arms: Mapping[str, Arm]
    methods: tuple[str, ...] = (DEFAULT,)
    suites: tuple[str, ...] = ("simpler-bridge",)
    paper: str = ""
    rows: Mapping[str, str] = field(default_factory=dict)
    retired: int = 0

    @property
    def names(self) -> tuple[str, ...]:
        """All its methods, the default first."""
        return (*self.methods, *self.arms)


UNTRAINED = (Colour("orange", (255, 128, 0)), Colour("purple", (128, 0, 255)))
"""Colours that no shipped policy was trained with as tints; in their films things were painted in
them, and commands named them."""


def _tints() -> dict[str, Arm]:
    arms: dict[str, Arm] = {}
    for colour in (*PALETTE, *UNTRAINED):
        arms[f"only-{colour.name}"] = Prompting(palette=(colour,))
    return arms


ABLATIONS: dict[str, Ablation] = {
    "rewrite": Ablation(
        question="Are both halves of the prompt needed, the tint and the rewritten words?",
        arms={},
        methods=(DEFAULT, "mask-only", "rewrite-only"),
        paper="ablation_rewrite",
        rows={
            DEFAULT: "VAP (mask + rewrite)",
            "mask-only": "mask-only",
            "rewrite-only": "rewrite-only",
        },
    ),
    "selection": Ablation(
        question="Does it matter how references elect the candidate?",
        arms={
            "average-rule": Prompting(rule="average"),
            "best-rule": Prompting(rule="best"),
        },
        paper="ablation_vote",
        rows={DEFAULT: "voting (VAP)", "average-rule": "averaging"},
    ),
    "references": Ablation(
        question="How many references are needed?",
        arms={
            "references-1": Prompting(references=1),
            "references-3": Prompting(references=3),
            "references-7": Prompting(references=7),
        },
        paper="ablation_k",
        rows={DEFAULT: "K = 5", **{f"references-{k}": f"K = {k}" for k in (1, 3, 7)}},
    ),
    "form": Ablation(
        question="Is the tint better than other forms of a prompt?",
        arms={
            "opaque": Prompting(form=Tint(1.0)),
            "contour": Prompting(form=Contour()),
            "box": Prompting(form=FilledBox()),
            "point": Prompting(form=Point()),
            "circle": Prompting(form=Circle()),
            "arrow": Arrow(),
            "marker": Prompting(form=NumberedMarker()),
            "dimmed": Prompting(form=DimmedBackground(), rewrite=False),
            "others-erased": Prompting(form=OthersErased(), rewrite=False),
        },
        paper="ablation_prompt",
        rows={
            DEFAULT: "mask, alpha 0.5 (VAP)",
            "opaque": "mask, alpha 1.0",
            "box": "box, alpha 0.5",
            "point": "point",
            "circle": "circle",
            "arrow": "trajectory arrow",
            "marker": "numbered marker",
        },
    ),
    "opacity": Ablation(
        question="How strong must the tint be?",
        arms={f"opacity-{alpha}": Prompting(form=Tint(alpha)) for alpha in (0.1, 0.3, 0.7)},
        methods=(DEFAULT, "opaque"),
        paper="ablation_prompt",
        rows={
            DEFAULT: "mask, alpha 0.5 (VAP)",
            "opaque": "mask, alpha 1.0",
            **{f"opacity-{alpha}": f"mask, alpha {alpha}" for alpha in (0.1, 0.3, 0.7)},
        },
    ),
    "colour": Ablation(
        question="Does it matter which colour the tint has?",
        arms=_tints(),
    ),
    "red-lookalike": Ablation(
        question="Where a look-alike is red by nature, is a tint chosen for the scene better than "
        "always red?",
        arms={},
        methods=(DEFAULT, "only-red", "generic"),
        suites=("simpler-bridge-red",),
    ),
    "occlusion": Ablation(
        question="How long may the target be hidden?",
        arms={f"hidden-{n}": Hidden(n) for n in range(1, 7)},
        paper="occlusion_sweep",
        rows={DEFAULT: "0 frames", **{f"hidden-{n}": f"{n} frames" for n in range(1, 7)}},
    ),
    "language": Ablation(
        question="Does the policy listen to its command at all?",
        arms={
            "blank-text": OtherCommand("blank"),
            "other-text": OtherCommand("next task"),
        },
        methods=("generic",),
    ),
    "mask": Ablation(
        question="How exact must the mask be?",
        arms={
            **{f"mask-area-{r}": Oracle("track", area=r) for r in (0.25, 0.5, 1.5, 2.0)},
            "mask-shifted": Oracle("track", shift=0.5),
        },
        methods=("oracle-track",),
        paper="mask_quality",
        rows={
            "oracle-track": "ratio 1.0",
            **{f"mask-area-{r}": f"ratio {r}" for r in (0.25, 0.5, 1.5, 2.0)},
        },
    ),
    "association": Ablation(
        question="Should views agree on one candidate, and look again where none was found?",
        arms={"vap-relook": Prompting(associate=True, relook=True)},
        methods=(DEFAULT, "vap-associated"),
        suites=("vlabench", "tabletop"),
        retired=7,
    ),
    "implicit": Ablation(
        question='Does an instruction that does not say "my" do as well?',
        arms={"vap-implicit": Implicit()},
    ),
    "switch": Ablation(
        question="Does the policy follow the tint to a look-alike in mid-episode?",
        arms={"switched-early": Switch("early"), "switched-moved": Switch("moved")},
        methods=("oracle-track",),
    ),
    "truth": Ablation(
        question="What would a perfect stage bring?",
        arms={},
        methods=(DEFAULT, "oracle-box", "oracle-mask", "oracle-track", "wrong-mask"),
    ),
    "obedience": Ablation(
        question="Does the policy obey the mask that it is shown, however it is drawn?",
        arms={
            **{
                f"obeys-tint-{alpha}": Oracle("mask", prompting=Prompting(form=Tint(alpha)))
                for alpha in (0.3, 0.8)
            },
            "obeys-contour": Oracle("mask", prompting=Prompting(form=Contour())),
        },
        methods=("generic", "rewrite-only", "oracle-mask", "wrong-mask"),
    ),
}
"""Every ablation by name; the first method of each is what the others are compared with."""

ARMS: dict[str, Arm] = {
    name: arm for ablation in ABLATIONS.values() for name, arm in ablation.arms.items()
}
"""Every arm that is no method of the main tables, by name."""


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
    "vap-associated": Prompting(associate=True),
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
    method: str, row: EpisodeRow, bank: Path, scene: AnyScene, stack: Stack | None
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
        case Implicit() as how:
            from vap_core.study.parsers import implicit_instruction, read_implicit

            try:
                read = read_implicit(row)
            except (
                BadInstruction,
                UnknownName,
            ):  # It abstains, and the policy reads that.
                return say(implicit_instruction(row)[0])
            return TintPrompter(_attender(how, row, bank, stack, read))
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


def _alike(scene: AnyScene, row: EpisodeRow) -> frozenset[str]:
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


def _attender(
    how: Prompting,
    row: EpisodeRow,
    bank: Path,
    stack: Stack | None,
    read: Instruction | None = None,
) -> Attender:
    """The method with the row's target in memory; in a shared scene with every owned object, and
    with everything that is remembered for an instruction that was `read` already."""
    assert stack is not None, "a method that prompts needs a stack"
    known = load_bank(bank, stack.encoder.name)
    # Other methods of the run may have wanted more photos.
    n_references = how.references or FEWEST_REFERENCES
    if read is not None:
        remembered = {name: obj.first(n_references) for name, obj in known.items()}
        return Attender(stack, remembered, how, lambda *_: read)
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
    return how is None or (isinstance(how, Prompting) and not isinstance(how, Implicit))
