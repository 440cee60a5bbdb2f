"""Colour words of what is seen: judged on an object's rendered pixels, by hue in CIE Lab.

    word, shown = seen([rgb], [mask])

It is no test of a tint, which goes by HSV (`prompt.has_colour`).
"""

from collections.abc import Iterable, Sequence
from functools import cache

import numpy as np

from vap_core.base.types import Mask, Rgb
from vap_core.perception.describe import COLOURS, NEUTRALS, colour_indices

HUES_DEG = {
    "pink": 15.0,
    "red": 52.0,
    "orange": 78.0,
    "yellow": 112.0,
    "green": 172.0,
    "cyan": 225.0,
    "blue": 309.0,
    "purple": 320.0,
    "magenta": 345.0,
}
"""The hue angles that end at each number have that word; what is beyond the last is pink again."""
WORDS = (*NEUTRALS, *HUES_DEG)
"""Every word that an object may be called by."""
CHROMA = 14.0
"""Chroma from which a pixel's hue names it, if it is no brown or beige."""
RED_CHROMA, RED_DEG = 22.0, 42.0
"""A dull colour is red, and no brown, from this chroma and below this hue angle on."""
MAIN, SHOWN = 0.4, 0.1
"""Shares of an object's pixels from which a word is what it is called, or is seen on it."""
NEAR = {
    "red": {"pink", "orange", "brown"},
    "blue": {"purple", "cyan"},
    "green": {"cyan", "yellow"},
    "magenta": {"pink", "purple"},
    "orange": {"yellow", "brown", "beige"},
    "yellow": {"beige"},
    "white": {"beige", "grey"},
    "black": {"grey", "brown"},
    "brown": {"beige"},
}
"""Words that may be taken for each other."""


def shares(rgb: Rgb, mask: Mask) -> dict[str, float]:
    """The share of the object's pixels that have each of `WORDS`; the mask has one."""
    rows, columns = mask.any(axis=1), mask.any(axis=0)
    box = np.ix_(rows, columns)
    rgb, mask = rgb[box], mask[box]
    index, angle, chroma = (part[mask] for part in colour_indices(rgb, mask))
    hue = len(NEUTRALS) + np.digitize(angle, list(HUES_DEG.values())) % len(HUES_DEG)
    earthy = np.isin(index, [COLOURS.index("brown"), COLOURS.index("beige")])
    earthy &= (chroma < RED_CHROMA) | ((angle > RED_DEG) & (angle < HUES_DEG["yellow"]))
    vivid = (chroma >= CHROMA) & ~earthy
    # What describe calls pink or purple below that chroma is nearest to grey.
    pale = np.where(index < len(NEUTRALS), index, NEUTRALS.index("grey"))
    counts = np.bincount(np.where(vivid, hue, pale), minlength=len(WORDS))
    return dict(zip(WORDS, (counts / len(index)).tolist(), strict=True))


def seen(views: Sequence[Rgb], masks: Sequence[Mask]) -> tuple[str, frozenset[str]]:
    """What an object is called by its colour, "" where none is its main one, and all that it shows.

    Its pixels of all views count together.
    """
    total = dict.fromkeys(WORDS, 0.0)
    pixels = sum(mask.sum() for mask in masks)
    for rgb, mask in zip(views, masks, strict=True):
        if mask.any():
            for word, share in shares(rgb, mask).items():
                total[word] += share * mask.sum() / pixels
    main = max(total, key=total.__getitem__)
    shown = frozenset(word for word, share in total.items() if share >= SHOWN)
    return main if total[main] >= MAIN else "", shown


@cache
def similar(word: str) -> frozenset[str]:
    """The word, and those that it may be taken for."""
    backwards = {colour for colour, near in NEAR.items() if word in near}
    return frozenset({word, *NEAR.get(word, ()), *backwards})


def stands_out(word: str, others: Iterable[frozenset[str]]) -> bool:
    """Whether nobody takes the colour for one that another object shows."""
    return bool(word) and all(similar(word).isdisjoint(shown) for shown in others)
