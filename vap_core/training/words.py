"""The words of the small models: what they are instructed with, asked and answered in, and what describes an object."""

import re

import numpy as np

from vap_core import describe
from vap_core.prompt import PALETTE
from vap_core.sim.objects import CATEGORIES, CLUTTER
from vap_core.sim.textures import Ink, Texture
from vap_core.suites import BENCHMARKS

DETERMINERS = ("my", "the", "a")
FIRST = ("<pad>", "<unk>", "\n")
RESERVED = tuple(f"<my_{i}>" for i in range(8))
"""Words that nothing is said with yet: a soft prompt learns one."""
QUESTIONS = re.findall(
    r"\w+", "where is there can you recognize in this image what colour yes no left right top bottom middle near far it point to at"
)
"""Words that a vision-language model is asked and answers with."""
PATTERNS = {"plain": "plain", "diagonal": "striped", "waves": "wavy", "speckle": "speckled", "tiles": "tiled", "gradient": "shaded"}
"""Words for motifs of generic objects; every other one is "patterned"."""
DESCRIBING = re.findall(r"\w+", "bright pale checked dotted short narrow small large round square body top base dots marks pattern lid handle some")
"""Words of descriptions beside those of describe.WORDS and PATTERNS."""


def vocabulary() -> tuple[str, ...]:
    """Every word of the benchmarks' instructions, of categories, colours, questions and descriptions; token i is word i."""
    said = [task.instruction for known in BENCHMARKS.values() for task in known.tasks] + [colour.name for colour in PALETTE]
    words = [word for text in (*said, *CATEGORIES, *CLUTTER) for word in re.findall(r"[\w']+", text.lower())]
    looks = [*describe.WORDS, *PATTERNS.values(), "patterned", *DESCRIBING]
    return (*FIRST, *dict.fromkeys([*words, *DETERMINERS, "up", *QUESTIONS, *looks]), *RESERVED)


def described(texture: Texture | np.ndarray) -> set[str]:
    """An object's own colour and pattern, in words."""
    return {colour_word(texture.base), PATTERNS.get(texture.motif, "patterned")} if isinstance(texture, Texture) else set()


def colour_word(rgb: Ink) -> str:
    """What a person calls a colour, sRGB 0..255."""
    return describe.COLOURS[int(describe.colour_names(np.array([[rgb]], np.uint8), np.ones((1, 1), bool))[0, 0])]
