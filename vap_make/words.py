"""The words of the small models: of instructions, questions and answers, and of appearance."""

import re
from collections.abc import Iterable
from functools import cache

from vap_core.base.types import Colour
from vap_core.perception import describe
from vap_core.prompt import PALETTE
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.objects import CATEGORIES, CLUTTER
from vap_core.simulation.assets.shapes import Texture
from vap_core.simulation.suites import BENCHMARKS

DETERMINERS = ("my", "the", "a")
FIRST = ("<pad>", "<unk>", "\n")
RESERVED = tuple(f"<my_{i}>" for i in range(8))
"""Words without a meaning: a soft prompt learns one."""
QUESTIONS = re.findall(
    r"\w+",
    "where is there can you recognize in this image what colour yes no "
    "left right top bottom middle near far it point to at",
)
"""Words that a vision-language model is asked and answers with."""
PATTERNS = {
    "plain": "plain",
    "diagonal": "striped",
    "waves": "wavy",
    "speckle": "speckled",
    "tiles": "tiled",
    "gradient": "shaded",
}
"""Words for motifs of generic objects; every other one is "patterned"."""
PAINTS = (
    *PALETTE,
    Colour("orange", (255, 140, 0)),
    Colour("purple", (130, 30, 170)),
    Colour("pink", (255, 150, 180)),
    Colour("teal", (0, 128, 128)),
    Colour("brown", (120, 72, 32)),
    Colour("white", (250, 250, 250)),
    Colour("black", (15, 15, 15)),
)
"""Colours that something may have by nature; a tint has one of the palette's."""
NEAR = {
    "red": {"pink", "orange", "brown"},
    "blue": {"teal", "purple", "cyan"},
    "green": {"teal", "cyan", "yellow"},
    "magenta": {"pink", "purple"},
    "cyan": {"teal", "blue", "green"},
    "yellow": {"orange", "beige", "green"},
}
"""Colours that a tint or a paint may be confused with."""


def vocabulary() -> tuple[str, ...]:
    """Every word that is known to the small models; token i is word i.

    They are the words of the benchmarks' instructions, of categories, colours, questions and
    descriptions.
    """
    texts = []
    for benchmark in BENCHMARKS.values():
        for task in benchmark.tasks:
            texts.append(task.instruction)
    for colour in PALETTE:
        texts.append(colour.name)
    words = []
    for text in (*texts, *CATEGORIES, *CLUTTER):
        words += re.findall(r"[\w']+", text.lower())
    appearance = [*describe.WORDS, *PATTERNS.values(), "patterned"]
    known = dict.fromkeys([*words, *DETERMINERS, "up", *QUESTIONS, *appearance])
    return (*FIRST, *known, *RESERVED)


@cache
def pattern_words(name: str) -> frozenset[str]:
    """The word for an object's motif; nothing for one without a texture.

    Raises: UnknownName, BadObject, as `objects.get_object`.
    """
    texture = objects.get_object(name).texture
    if not isinstance(texture, Texture):
        return frozenset()
    return frozenset({PATTERNS.get(texture.motif, "patterned")})


@cache
def similar_colours(word: str) -> frozenset[str]:
    """The word, and colours that it may be taken for."""
    similar = {word} | NEAR.get(word, set())
    for colour, near in NEAR.items():
        if word in near:
            similar.add(colour)
    return frozenset(similar)


def distinct_colours(taken: Iterable[str]) -> list[Colour]:
    """The palette's colours that nobody takes for one of these words; all when none is left."""
    words = set(taken)
    distinct = [colour for colour in PALETTE if not similar_colours(colour.name) & words]
    return distinct or list(PALETTE)
