"""Questions about training views, and their answers in words: what a mini-PaliGemma learns before it is anybody's policy (P 5.1, SPEC section 4).

*Where is the red cup*: top left. *Is there a red cup in this image*, *can you recognize the striped cup in this image*: yes or no, as often; the
hard no's name a colour that no cup has. *What colour is the cup*: red. *Pick up the red cup*, *pick up my cup. My cup is white with blue spots*: no
words; only the patches that show it are asked for. Colours are a tint, paint, or an object's own; an object is named by its colour or pattern where
that tells it from its kind, and by its kind where it is the only one.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import UInt8

from vap_core.base.types import value
from vap_core.prompt import PALETTE
from vap_core.simulation.assets import objects
from vap_core.simulation.suites import BENCHMARKS
from vap_core.training.policy.commands import ALPHA, COAT, painted, tinted
from vap_core.training.words import DETERMINERS, PAINTS, akin, free, looks, phrases

COLOURED, TINTED = 0.45, 0.5
"""How often a view's object is coloured, and how often that is a tint rather than paint."""
LEAST_PX = 20
"""Visible pixels of an object that is asked about."""
TASKS = tuple(task for suite in BENCHMARKS.values() for task in suite.tasks)


@value
class Question:
    """What is asked of one view, the answer's words (none where only patches are asked for), and the index of the object meant, or -1."""

    text: str
    answer: tuple[str, ...]
    target: int


@value
class Asked:
    """One view, coloured, and questions about it."""

    image: UInt8[np.ndarray, "s s 3"]
    questions: tuple[Question, ...]


@value
class Thing:
    """An object in view: its kind, the words that name it, all that it shows (a tint hides no pattern), and the colour it was given, or ""."""

    name: str
    kind: str
    said: frozenset[str]
    shows: frozenset[str]
    given: str


Things = Mapping[int, Thing]


def ask(
    image: UInt8[np.ndarray, "s s 3"],
    ids: UInt8[np.ndarray, "s s"],
    names: Sequence[str],
    n: int,
    rng: np.random.Generator,
) -> Asked:
    """Colour some objects of a view, where `ids` is i + 1 at names[i], and ask `n` questions about it."""
    seen = [i for i in range(len(names)) if (ids == i + 1).sum() >= LEAST_PX]
    things = {
        i: Thing(
            names[i], objects.get_object(names[i]).category, looks(names[i]), looks(names[i]), ""
        )
        for i in seen
    }
    images, left = image[None], set(PAINTS)
    for i in seen:
        tint = rng.random() < TINTED
        pool = [colour for colour in (PALETTE if tint else PAINTS) if colour in left]
        if pool and rng.random() < COLOURED:
            colour, mask = pool[int(rng.integers(len(pool)))], (ids == i + 1)[None]
            left.discard(colour)
            change, span = (tinted, ALPHA) if tint else (painted, COAT)
            images = change(images, mask, colour, float(rng.uniform(*span)))
            things[i] = Thing(
                names[i],
                things[i].kind,
                frozenset({colour.name}),
                things[i].shows | {colour.name},
                colour.name,
            )
    gain = rng.uniform(0.9, 1.1) * rng.uniform(0.96, 1.04, 3)
    shown = np.clip(images[0] * gain, 0, 255).astype(np.uint8)
    return Asked(shown, tuple(_question(ids, things, rng) for _ in range(n)))


def _question(ids: UInt8[np.ndarray, "s s"], things: Things, rng: np.random.Generator) -> Question:
    named = {i: phrase for i in things if (phrase := _phrase(i, things, rng))}
    way = rng.random()
    if not named:
        return _absent(things, rng)
    target = int(rng.choice(list(named)))
    phrase, kind = named[target], things[target].kind
    if way < 0.28:
        return Question(f"where is the {phrase}", place(ids == target + 1), target)
    if way < 0.46:
        return Question(_recognise(phrase, rng), ("yes",), target)
    if way < 0.64:
        return _wrong(kind, things, rng) if rng.random() < 0.7 else _absent(things, rng)
    if (
        way < 0.74
        and things[target].given
        and [thing.kind for thing in things.values()].count(kind) == 1
    ):
        return Question(f"what colour is the {kind}", (things[target].given,), target)
    told = str(
        rng.choice(
            [task.instruction for task in TASKS if task.category == kind] or [f"pick up my {kind}"]
        )
    )
    if not things[target].given and phrase != kind and rng.random() < 0.5:
        return Question(
            f"{told}. My {kind} is {rng.choice(phrases(things[target].name))}.", (), target
        )
    return Question(
        told.replace(f"my {kind}", f"{rng.choice(DETERMINERS[1:])} {phrase}"), (), target
    )


def _phrase(i: int, things: Things, rng: np.random.Generator) -> str | None:
    """What tells object i from its kind: "red cup", or "cup" when there is one only; None when nothing does."""
    others = [thing for j, thing in things.items() if j != i and _alike(thing.kind, things[i].kind)]
    telling = sorted(
        word for word in things[i].said if not any(akin(word) & thing.shows for thing in others)
    )
    if telling and (others or rng.random() < 0.7):
        return f"{rng.choice(telling)} {things[i].kind}"
    return None if others else things[i].kind


def _recognise(phrase: str, rng: np.random.Generator) -> str:
    return (
        f"is there a {phrase} in this image"
        if rng.random() < 0.5
        else f"can you recognize the {phrase} in this image"
    )


def _wrong(kind: str, things: Things, rng: np.random.Generator) -> Question:
    """A kind that is there, in a colour or pattern that none of it has."""
    has = {word for thing in things.values() if _alike(thing.kind, kind) for word in thing.shows}
    foreign = sorted(
        {word for thing in things.values() for word in thing.said if not akin(word) & has}
    )
    pool = (
        foreign
        if foreign and rng.random() < 0.5
        else [colour.name for colour in free(has) if colour.name not in has]
    )
    return (
        Question(_recognise(f"{rng.choice(pool)} {kind}", rng), ("no",), -1)
        if pool
        else _absent(things, rng)
    )


def _absent(things: Things, rng: np.random.Generator) -> Question:
    """A kind that is not there, by a word that something wears or may wear."""
    pool = sorted(
        kind
        for kind in objects.CATEGORIES
        if not any(_alike(kind, thing.kind) for thing in things.values())
    )
    worn = sorted(
        {word for thing in things.values() for word in thing.said}
        | {colour.name for colour in PALETTE}
    )
    kind = str(rng.choice(pool))
    return Question(
        _recognise(f"{rng.choice(worn)} {kind}" if rng.random() < 0.7 else kind, rng), ("no",), -1
    )


def _alike(one: str, other: str) -> bool:
    """A straw cup is a cup."""
    return one == other or one.endswith(f" {other}") or other.endswith(f" {one}")


def place(mask: np.ndarray) -> tuple[str, str]:
    """Which of nine parts of the view holds the middle of a mask: its row, then its column."""
    ys, xs = np.nonzero(mask)
    thirds = (3 * np.array([ys.mean(), xs.mean()]) / mask.shape[0]).astype(int)
    return ("top", "middle", "bottom")[thirds[0]], ("left", "middle", "right")[thirds[1]]
