"""Questions about training views, and their answers in words (P 5.1, SPEC section 4).

A mini-PaliGemma learns to answer them before any policy grows from it.

*Where is the red cup*: top left. *Is there a red cup in this image*, *can you recognize the striped
cup in this image*: yes or no, equally often; the hard no's name a colour that no cup has. *What
colour is the cup*: red. *Pick up the red cup*, *pick up my cup. My cup is white with blue spots*:
no words; only the patches that show it are asked for. Colours are those of an object's materials,
as the view's pixels show them; an object is named by its colour or pattern where that distinguishes
it from others of its kind, and by its kind where it is the only one. *Can you recognize <my_0> in
this image*: each object of a crew of look-alikes has a word of its own while the model is trained,
so that it learns to tell instances apart by a word's embedding, as a learned word does it.
"""

from collections.abc import Collection, Mapping, Sequence
from itertools import chain

import numpy as np
from jaxtyping import UInt8

from vap_core.base.types import Description, value
from vap_core.policies.mini_pi0.learned_token import QUESTION
from vap_core.simulation.assets import objects
from vap_core.simulation.suites import BENCHMARKS
from vap_make.colours import HUES_DEG, seen, similar, stands_out
from vap_make.words import DETERMINERS, pattern_words

MIN_ASKED_PX = 20
"""Visible pixels of an object that is asked about."""
TASKS = tuple(chain.from_iterable(suite.tasks for suite in BENCHMARKS.values()))


@value
class Question:
    """A question about one view, the answer's words, and the index of the object meant, or -1.

    There is no answer where only patches are asked for. `instance` is the index of the object whose
    own word is in the text, or -1.
    """

    text: str
    answer: tuple[str, ...]
    target: int
    instance: int = -1


@value
class QuestionedView:
    """One view, and questions about it."""

    image: UInt8[np.ndarray, "s s 3"]
    questions: tuple[Question, ...]


@value
class VisibleObject:
    """An object in view.

    `words` may name it; `appearance` is all that it shows; `colour` is its main one, or "".
    """

    look: Description
    kind: str
    words: frozenset[str]
    appearance: frozenset[str]
    colour: str


VisibleObjects = Mapping[int, VisibleObject]
"""By their index among the view's names."""


def ask(
    image: UInt8[np.ndarray, "s s 3"],
    ids: UInt8[np.ndarray, "s s"],
    names: Sequence[str],
    looks: Sequence[Description],
    n: int,
    rng: np.random.Generator,
    own: float = 0.0,
) -> QuestionedView:
    """Ask `n` questions about a view, in which `ids` is i + 1 at names[i].

    `looks` are the captioner's descriptions of the objects; `own` is the share of questions about
    one of the look-alikes by its own word.

    Raises: UnknownName, BadObject, as `get_object`.
    """
    visible = _visible_objects(image, ids, names, looks)
    kinds = [objects.get_object(name).category for name in names]
    crew = [i for i, kind in enumerate(kinds) if kind == kinds[0]]
    gain = rng.uniform(0.9, 1.1) * rng.uniform(0.96, 1.04, 3)
    shown = np.clip(image * gain, 0, 255).astype(np.uint8)
    questions = []
    for _ in range(n):
        asks_own = rng.random() < own
        questions.append(
            _ask_for_instance(crew, visible, rng) if asks_own else _question(ids, visible, rng)
        )
    return QuestionedView(shown, tuple(questions))


def place(mask: np.ndarray) -> tuple[str, str]:
    """Which of nine parts of the view holds the middle of a mask: its row, then its column."""
    ys, xs = np.nonzero(mask)
    middle = np.array([ys.mean(), xs.mean()])
    row, column = (3 * middle / mask.shape[0]).astype(int)
    return ("top", "middle", "bottom")[row], ("left", "middle", "right")[column]


def _visible_objects(
    image: UInt8[np.ndarray, "s s 3"],
    ids: UInt8[np.ndarray, "s s"],
    names: Sequence[str],
    looks: Sequence[Description],
) -> dict[int, VisibleObject]:
    """The objects with enough visible pixels."""
    visible = {}
    for i, name in enumerate(names):
        mask = ids == i + 1
        if mask.sum() >= MIN_ASKED_PX:
            colour, shown = seen([image], [mask])
            pattern = pattern_words(name)
            visible[i] = VisibleObject(
                look=looks[i],
                kind=objects.get_object(name).category,
                words=frozenset({colour, *pattern} - {""}),
                appearance=shown | pattern,
                colour=colour,
            )
    return visible


def _question(
    ids: UInt8[np.ndarray, "s s"], visible: VisibleObjects, rng: np.random.Generator
) -> Question:
    """A question of any type about one of the objects that a phrase distinguishes, if any."""
    named = {}
    for i in visible:
        phrase = _phrase(i, visible, rng)
        if phrase:
            named[i] = phrase
    drawn = rng.random()
    if not named:
        return _ask_absent(visible, rng)
    target = int(rng.choice(list(named)))
    phrase = named[target]
    kind = visible[target].kind
    if drawn < 0.28:
        return Question(f"where is the {phrase}", place(ids == target + 1), target)
    if drawn < 0.46:
        return Question(_recognition_text(phrase, rng), ("yes",), target)
    if drawn < 0.64:
        if rng.random() < 0.7:
            return _ask_wrong_colour(kind, visible, rng)
        return _ask_absent(visible, rng)
    colour = visible[target].colour
    if drawn < 0.74 and colour and _is_only(kind, visible):
        return Question(f"what colour is the {kind}", (colour,), target)
    return _ask_for_patches(target, phrase, visible[target], rng)


def _ask_for_instance(
    crew: Sequence[int], visible: VisibleObjects, rng: np.random.Generator
) -> Question:
    """Is this very one of the look-alikes there? Yes and no are as frequent where both are true."""
    there = [i for i in crew if i in visible]
    absent = [i for i in crew if i not in visible]
    pool = there if there and (not absent or rng.random() < 0.5) else absent
    i = int(rng.choice(pool))
    return (
        Question(QUESTION, ("yes",), i, i) if i in visible else Question(QUESTION, ("no",), -1, i)
    )


def _phrase(i: int, visible: VisibleObjects, rng: np.random.Generator) -> str | None:
    """What distinguishes object i from others of its kind; None when nothing does.

    It is "red cup", or "cup" when there is one only.
    """
    kind = visible[i].kind
    others = 0
    distinctive = set(visible[i].words)
    for j, rival in visible.items():
        if j != i and _is_same_kind(rival.kind, kind):
            others += 1
            distinctive = _without_akin(distinctive, rival.appearance)
    if distinctive and (others or rng.random() < 0.7):
        return f"{rng.choice(sorted(distinctive))} {kind}"
    return None if others else kind


def _ask_wrong_colour(kind: str, visible: VisibleObjects, rng: np.random.Generator) -> Question:
    """Is there a kind that is there, in a colour or pattern that none of it has?"""
    own: set[str] = set()
    all_words: set[str] = set()
    for rival in visible.values():
        all_words |= rival.words
        if _is_same_kind(rival.kind, kind):
            own |= rival.appearance
    pool = sorted(_without_akin(all_words, own))
    if not pool or rng.random() >= 0.5:
        pool = [word for word in HUES_DEG if stands_out(word, [frozenset(own)])]
    if not pool:
        return _ask_absent(visible, rng)
    text = _recognition_text(f"{rng.choice(pool)} {kind}", rng)
    return Question(text, ("no",), -1)


def _ask_absent(visible: VisibleObjects, rng: np.random.Generator) -> Question:
    """Is there a kind that is not there, mostly with a colour or pattern of something?"""
    words = set(HUES_DEG)
    for other in visible.values():
        words |= other.words
    phrase = str(rng.choice(_absent_kinds(visible)))
    if rng.random() < 0.7:
        phrase = f"{rng.choice(sorted(words))} {phrase}"
    return Question(_recognition_text(phrase, rng), ("no",), -1)


def _ask_for_patches(
    target: int, phrase: str, meant: VisibleObject, rng: np.random.Generator
) -> Question:
    """An instruction about an object; only the patches that show it answer."""
    kind = meant.kind
    text = str(rng.choice(_instructions(kind)))
    if phrase != kind and rng.random() < 0.3:
        description = rng.choice([meant.look.short, meant.look.long])
        return Question(f"{text}. My {kind} is {description}.", (), target)
    determiner = rng.choice(DETERMINERS[1:])
    return Question(text.replace(f"my {kind}", f"{determiner} {phrase}"), (), target)


def _recognition_text(phrase: str, rng: np.random.Generator) -> str:
    """A question that yes or no answers."""
    if rng.random() < 0.5:
        return f"is there a {phrase} in this image"
    return f"can you recognize the {phrase} in this image"


def _instructions(kind: str) -> list[str]:
    """What the benchmarks' tasks tell a robot to do with a kind, or to pick it up."""
    instructions = []
    for task in TASKS:
        if task.category == kind:
            instructions.append(task.instruction)
    return instructions or [f"pick up my {kind}"]


def _absent_kinds(visible: VisibleObjects) -> list[str]:
    """The kinds that nothing in view is of, in alphabetical order."""
    absent = set(objects.CATEGORIES)
    for kind in objects.CATEGORIES:
        for other in visible.values():
            if _is_same_kind(kind, other.kind):
                absent.discard(kind)
    return sorted(absent)


def _is_same_kind(kind: str, other: str) -> bool:
    """Whether one kind is the other; a straw cup is a cup."""
    return kind == other or kind.endswith(f" {other}") or other.endswith(f" {kind}")


def _is_only(kind: str, visible: VisibleObjects) -> bool:
    """Whether exactly one object of this very kind is in view."""
    count = 0
    for other in visible.values():
        count += other.kind == kind
    return count == 1


def _without_akin(words: set[str], appearance: Collection[str]) -> set[str]:
    """The words that cannot be taken for one of an appearance's."""
    kept = set()
    for word in words:
        if similar(word).isdisjoint(appearance):
            kept.add(word)
    return kept
