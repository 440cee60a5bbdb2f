"""How well words fit an object's description, in the vocabulary of the offline captioner."""

import re

from vap_core.base.types import PersonalObject

SYNONYMS = {
    "striped": ("stripes", "bands"),
    "stripe": ("stripes", "bands"),
    "banded": ("bands", "stripes"),
    "band": ("bands", "stripes"),
    "spotted": ("spots",),
    "dotted": ("spots",),
    "dot": ("spots",),
    "dots": ("spots",),
    "speckled": ("spots",),
    "patched": ("patches",),
    "light": ("light", "white", "beige"),
    "lighter": ("light", "white", "beige"),
    "darker": ("dark",),
    "gray": ("grey",),
}
"""Words for patterns and shades, in the captioner's vocabulary."""
MAIN = 1.0
"""Weight of a word of the main colour, of the other prominent parts, and of the rest."""
PROMINENT = 0.6
MINOR = 0.2
PAIR = 1.0
"""Weight of two neighbouring words that are neighbours in the description: "black bands"."""
NONE = re.compile(r"\b(?:without|no|nothing|non)\b")


def fit(words: str, obj: PersonalObject) -> float:
    """How well words such as "striped" or "with black bands" fit an object; 0 where none does.

    What follows "without" or "no" counts against it.
    """
    if obj.description is None:
        return 0.0
    there, _, absent = _split_none(words.lower())
    total = 0.0
    for part, sign in ((there, 1.0), (absent, -1.0)):
        total += sign * _fit(part, obj.description.short.lower(), obj.description.long.lower())
    return total


def wanted(words: str) -> str:
    """The words before "without", "no" or "non-": what follows is not there."""
    return _split_none(words.lower())[0].strip()


def _split_none(words: str) -> tuple[str, str, str]:
    match = NONE.search(words)
    if match is None:
        return words, "", ""
    return words[: match.start()], match.group(), words[match.end() :]


def _fit(words: str, short: str, long: str) -> float:
    main = short.split(" with ")[0].split()
    prominent = short.split()
    minor = re.findall(r"[\w-]+", long)
    total = 0.0
    said = re.findall(r"\w[\w-]*", words)
    for i, word in enumerate(said):
        weights = [0.0]
        for same in (word, *SYNONYMS.get(word, ()), word.rstrip("s")):
            if same in main:
                weights.append(MAIN)
            if same in prominent:
                weights.append(PROMINENT)
            if same in minor or f"{same}es" in minor or f"{same}s" in minor:
                weights.append(MINOR)
        total += max(weights)
        if i and weights[1:]:
            for same in (word, *SYNONYMS.get(word, ())):
                if f"{said[i - 1]} {same}" in short:
                    total += PAIR
                    break
    if words.strip() in ("plain", "all black", "plain one"):
        total += float("plain" in minor or " with " not in short)
    return total
