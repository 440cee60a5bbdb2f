"""The words of the small models: what they are instructed with, asked and answered in, and what describes an object."""

import re
from collections.abc import Iterable, Sequence
from functools import cache

import cv2
import numpy as np

from vap_core.base.types import Colour
from vap_core.perception import describe
from vap_core.perception.colours import COLOURS, add_shade, colour_indices
from vap_core.prompt import PALETTE
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.objects import CATEGORIES, CLUTTER
from vap_core.simulation.assets.textures import Srgb, Texture
from vap_core.simulation.suites import BENCHMARKS

DETERMINERS = ("my", "the", "a")
FIRST = ("<pad>", "<unk>", "\n")
RESERVED = tuple(f"<my_{i}>" for i in range(8))
"""Words that nothing is said with yet: a soft prompt learns one."""
QUESTIONS = re.findall(
    r"\w+",
    "where is there can you recognize in this image what colour yes no left right top bottom middle near far it point to at",
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
    *PALETTE, Colour("orange", (255, 140, 0)), Colour("purple", (130, 30, 170)), Colour("pink", (255, 150, 180)), Colour("teal", (0, 128, 128)),
    Colour("brown", (120, 72, 32)), Colour("white", (250, 250, 250)), Colour("black", (15, 15, 15)),
)  # fmt: skip
"""Colours that something may have by nature; a tint has one of the palette's."""
SPREAD = {
    "plain": "",
    "diagonal": "stripes",
    "waves": "bands",
    "speckle": "spots",
    "tiles": "patches",
    "gradient": "parts",
}
"""How a motif lies on an object, in the captioner's words; every other one is spots or, in the middle or a column, patches."""
NEAR = {
    "red": {"pink", "orange", "brown"}, "blue": {"teal", "purple", "cyan"}, "green": {"teal", "cyan", "yellow"},
    "magenta": {"pink", "purple"}, "cyan": {"teal", "blue", "green"}, "yellow": {"orange", "beige", "green"},
}  # fmt: skip
"""Colours that something tinted or painted may be taken for, or be taken for it."""


def vocabulary() -> tuple[str, ...]:
    """Every word of the benchmarks' instructions, of categories, colours, questions and descriptions; token i is word i."""
    said = [task.instruction for known in BENCHMARKS.values() for task in known.tasks] + [
        colour.name for colour in PALETTE
    ]
    words = [
        word
        for text in (*said, *CATEGORIES, *CLUTTER)
        for word in re.findall(r"[\w']+", text.lower())
    ]
    looks = [*describe.WORDS, *PATTERNS.values(), "patterned"]
    return (*FIRST, *dict.fromkeys([*words, *DETERMINERS, "up", *QUESTIONS, *looks]), *RESERVED)


@cache
def looks(name: str) -> frozenset[str]:
    """An object's own colour and pattern, a word each."""
    texture = objects.get_object(name).texture
    return (
        frozenset({colour_word(texture.base), PATTERNS.get(texture.motif, "patterned")})
        if isinstance(texture, Texture)
        else frozenset()
    )


@cache
def phrases(name: str) -> tuple[str, str]:
    """What the captioner would say of it at its best, short and long: what hard prompts are made of is heard in training, too."""
    model = objects.get_object(name)
    texture = model.texture
    assert isinstance(texture, Texture)
    main = add_shade(colour_word(texture.base), _lightness(texture.base))
    kind = SPREAD.get(
        texture.motif, "patches" if texture.layout in ("middle", "column") else "spots"
    )
    told = f"{colour_word(texture.ink)} {kind}" if kind else ""
    x, y, z = objects.extent_m(model)
    shape = "tall" if z > 1.6 * max(x, y) else "wide" if z < 0.9 * max(x, y) else "compact"
    ending = (
        f" with {told} and a little {colour_word(texture.accent)}"
        if told
        else f" with a little {colour_word(texture.accent)}"
    )
    busy = (
        ", patterned all over"
        if texture.layout in ("grid", "scatter", "whole") and told
        else ""
        if told
        else ", plain"
    )
    return (
        f"{main} with {told}" if told else main,
        f"a {shape} {model.category}, mostly {main}{ending}{busy}",
    )


def akin(word: str) -> set[str]:
    """The word, and colours that it may be taken for."""
    return {word} | NEAR.get(word, set()) | {other for other, near in NEAR.items() if word in near}


def free(taken: Iterable[str], colours: Sequence[Colour] = PALETTE) -> list[Colour]:
    """The colours that nobody takes for one of these words; all of them when none is left."""
    words = set(taken)
    return [colour for colour in colours if not akin(colour.name) & words] or list(colours)


def colour_word(rgb: Srgb) -> str:
    """What a person calls a colour, sRGB 0..255."""
    return COLOURS[int(colour_indices(np.array([[rgb]], np.uint8), np.ones((1, 1), bool))[0, 0])]


def _lightness(rgb: Srgb) -> float:
    return float(cv2.cvtColor(np.array([[rgb]], np.float32) / 255, cv2.COLOR_RGB2LAB)[0, 0, 0])
