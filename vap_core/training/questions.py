"""Questions about training views, and their answers in words: what a mini-PaliGemma learns before it is anybody's policy (P 5.1, SPEC section 4).

*Where is the red cup*: top left. *Is there a red cup in this image*, *can you recognize the striped cup in this image*: yes or no; the hard
no's name a colour that no cup has. *What colour is the cup*: red. *Pick up the red cup*: no words; only the patches that show it are asked for.
Colours are a tint, paint, or an object's own; an object is named by its colour or pattern where that tells it from its kind, and by its kind
where it is the only one.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from vap_core.prompt import PALETTE
from vap_core.sim import objects
from vap_core.suites import BENCHMARKS
from vap_core.training.commands import ALPHA, COAT, painted, tinted
from vap_core.training.words import DETERMINERS, described
from vap_core.values import value

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


def ask(image: UInt8[np.ndarray, "s s 3"], ids: UInt8[np.ndarray, "s s"], names: Sequence[str], n: int, rng: np.random.Generator) -> Asked:
    """Colour some objects of a view, where `ids` is i + 1 at names[i], and ask `n` questions about it."""
    seen = [i for i in range(len(names)) if (ids == i + 1).sum() >= LEAST_PX]
    models = {i: objects.get(names[i]) for i in seen}
    words: dict[int, set[str]] = {i: described(models[i].texture) for i in seen}
    given: dict[int, str] = {}
    palette = [PALETTE[k] for k in rng.permutation(len(PALETTE))]
    images = image[None]
    for i in seen:
        if palette and rng.random() < COLOURED:
            colour = palette.pop()
            if rng.random() < TINTED:
                images = tinted(images, (ids == i + 1)[None], colour, float(rng.uniform(*ALPHA)))
            else:
                images = painted(images, (ids == i + 1)[None], colour, float(rng.uniform(*COAT)))
            words[i], given[i] = {colour.name}, colour.name
    kinds = {i: models[i].category for i in seen}
    gain = rng.uniform(0.9, 1.1) * rng.uniform(0.96, 1.04, 3)
    shown = np.clip(images[0] * gain, 0, 255).astype(np.uint8)
    return Asked(shown, tuple(_question(ids, kinds, words, given, rng) for _ in range(n)))


def _question(
    ids: UInt8[np.ndarray, "s s"], kinds: dict[int, str], words: dict[int, set[str]], given: dict[int, str], rng: np.random.Generator
) -> Question:
    named = {i: phrase for i in kinds if (phrase := _phrase(i, kinds, words, rng))}
    way = rng.random()
    if not named or way < 0.15:
        return _absent(kinds, words, rng)
    target = int(rng.choice(list(named)))
    phrase, kind = named[target], kinds[target]
    if way < 0.4:
        return Question(f"where is the {phrase}", place(ids == target + 1), target)
    if way < 0.7:
        if rng.random() < 0.5:
            return Question(_recognise(phrase, rng), ("yes",), target)
        return _wrong(kind, kinds, words, rng)
    if way < 0.8 and target in given and list(kinds.values()).count(kind) == 1:
        return Question(f"what colour is the {kind}", (given[target],), target)
    told = [task.instruction for task in TASKS if task.category == kind] or [f"pick up my {kind}"]
    return Question(str(rng.choice(told)).replace(f"my {kind}", f"{rng.choice(DETERMINERS[1:])} {phrase}"), (), target)


def _phrase(i: int, kinds: dict[int, str], words: dict[int, set[str]], rng: np.random.Generator) -> str | None:
    """What tells object i from its kind: "red cup", or "cup" when there is one only; None when nothing does."""
    others = [j for j in kinds if j != i and kinds[j] == kinds[i]]
    telling = sorted(words[i] - {word for j in others for word in words[j]})
    if telling and (others or rng.random() < 0.7):
        return f"{rng.choice(telling)} {kinds[i]}"
    return None if others else kinds[i]


def _recognise(phrase: str, rng: np.random.Generator) -> str:
    return f"is there a {phrase} in this image" if rng.random() < 0.5 else f"can you recognize the {phrase} in this image"


def _wrong(kind: str, kinds: dict[int, str], words: dict[int, set[str]], rng: np.random.Generator) -> Question:
    """A kind that is there, in a colour or pattern that none of it has."""
    has = {word for i in kinds if kinds[i] == kind for word in words[i]}
    foreign = {word for i in kinds for word in words[i]} - has  # worn by something else in view: the hardest
    pool = sorted(foreign) if foreign and rng.random() < 0.5 else sorted({colour.name for colour in PALETTE} - has)
    return Question(_recognise(f"{rng.choice(pool)} {kind}", rng), ("no",), -1)


def _absent(kinds: dict[int, str], words: dict[int, set[str]], rng: np.random.Generator) -> Question:
    """A kind that is not there, by a word that something wears or may wear."""
    pool = sorted({kind for kind in objects.CATEGORIES if kind not in kinds.values()})
    worn = sorted({word for i in kinds for word in words[i]} | {colour.name for colour in PALETTE})
    kind = str(rng.choice(pool))
    return Question(_recognise(f"{rng.choice(worn)} {kind}" if rng.random() < 0.7 else kind, rng), ("no",), -1)


def place(mask: np.ndarray) -> tuple[str, str]:
    """Which of nine parts of the view holds the middle of a mask: its row, then its column."""
    ys, xs = np.nonzero(mask)
    thirds = (3 * np.array([ys.mean(), xs.mean()]) / mask.shape[0]).astype(int)
    return ("top", "middle", "bottom")[thirds[0]], ("left", "middle", "right")[thirds[1]]
