"""The words of the small models: of instructions, questions and answers, and of appearance."""

import re
from functools import cache

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


def vocabulary() -> tuple[str, ...]:
    """Every word that is known to the small models; token i is word i.

    They are the words of the benchmarks' instructions, of categories, colours, questions and
    descriptions.
    """
    texts = []
    for benchmark in BENCHMARKS.values():
        for task in benchmark.tasks:
            texts.append(task.instruction)
    texts += [colour.name for colour in PALETTE]
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
