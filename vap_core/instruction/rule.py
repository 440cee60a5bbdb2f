"""Parsing by rule, and the rewrite (P 3.3, appendix "Instruction Rewriting Logic")."""

import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import cache
from typing import Protocol, runtime_checkable

from vap_core.base.errors import BadInstruction, NothingPersonal
from vap_core.base.types import Colour, Instruction, Target

STOP_WORDS = frozenset(
    """and or to into onto in on near next beside behind under over from with at by off up down left
    right of then before after please that which is it inside toward towards between against above
    below around away out back here there now if while for until so""".split()
)
"""Words that end a category phrase when no known category matches, and that name no person."""
_WORD = rf"(?!(?:{'|'.join(sorted(STOP_WORDS))})\b)[\w-]+"
_OWNING = rf"{_WORD}(?:['’]s|s['’])\s+"
_PERSON = rf"(?:(?:{_WORD}\s+){{0,2}}?{_OWNING}(?:{_OWNING})?)?"
OWNER = re.compile(rf"\b(?P<owner>my\s+{_PERSON})", re.IGNORECASE)
"""A possessive trigger: "my cup", or with an owner beside the speaker, "my brother's cup" and "my
friend's brother's cup"."""
ARTICLE = r"(?:the|an?)\s+"
"""What may stand before a person: "the neighbour's cup" is rewritten with its article."""
DETERMINER = (
    "my|his|her|their|our|mine|hers|theirs|ours|the|an?|this|that|these|those|some|any|one of"
)
"""What an expression begins with that "her" does not belong to."""
NEXT_PHRASE = frozenset("my the a an this these those".split())
"""Determiners that end a category phrase: "show my camera the plate".

Those of other people do not: the published study of parsers is of a rule without them.
"""
_GIVING = re.compile(r"\b(?:give|hand|pass|offer|lend)\s+$", re.IGNORECASE)
_AGAIN = re.compile(r"\s+my(?![\w-])", re.IGNORECASE)

MAX_CHARACTERS = 500
"""The longest instruction that a parser reads: the time of one grows with the square of it."""


@runtime_checkable
class Parser(Protocol):
    """Finds the personalised spans of an instruction."""

    def __call__(self, text: str, categories: Collection[str] = ()) -> Instruction: ...


def parse(text: str, categories: Collection[str] = (), owners: Collection[str] = ()) -> Instruction:
    """Parse by rule, left to right.

    Every "my <category>" or "my <person>'s <category>" becomes a target. The longest of
    `categories` (a plural allowed) that follows the trigger wins; otherwise the words up to
    punctuation, the first stop word or the next determiner are the category, so unseen nouns work
    too. In "give my brother my cup" my brother is who gets it, no target. Where objects have
    `owners`, "Anna's <category>" and "his <category>" of a known category are targets as well; the
    article of "the neighbour's <category>" is part of the span.

    Raises:
        NothingPersonal: the text holds no possessive span; BadInstruction: it is too long.
    """
    check_length(text)
    targets: list[Target] = []
    pattern = _any_owner(tuple(owners)) if owners else OWNER
    trigger = pattern.search(text)
    while trigger is not None:
        start, stop = trigger.span()
        begin = trigger.start("owner")
        stop = begin + _before_category(text[begin:stop], text[begin:], categories)
        category, length = leading_category(text[stop:], categories)
        owner = text[begin:stop].strip()
        receives = (
            category not in categories
            and _GIVING.search(text[:start])
            and _AGAIN.match(text, stop + length)
        )
        is_named = category in categories or owner.lower().startswith("my")
        if category and is_named and not receives:
            stop += length
            targets.append(Target(start=start, stop=stop, owner=owner, category=category))
        trigger = pattern.search(text, stop)
    if not targets:
        raise NothingPersonal(
            f'parse: no personal object in {text!r}; name one as "my <category>", '
            'for example "bring my cup".'
        )
    return Instruction(text, tuple(targets))


def check_length(text: str) -> None:
    """Refuse what no parser reads. Raises: BadInstruction: over `MAX_CHARACTERS`."""
    if len(text) > MAX_CHARACTERS:
        raise BadInstruction(
            f"parse: {text[:40]!r} and what follows are {len(text):,} characters; an instruction "
            f"has at most {MAX_CHARACTERS}. Give it in several."
        )


def _before_category(owner: str, rest: str, categories: Collection[str]) -> int:
    """The length of the owner that `rest` begins with; a category that is named ends it.

    "my cup near Anna's" is about my cup, and so is "my cup's lid".
    """
    for step in re.finditer(r"^[\w'’-]+\s+|['’]s?\s+", owner):
        if leading_category(rest[step.end() :], categories)[0] in categories:
            return step.end()
    return len(owner)


def rewrite(instruction: Instruction, colours: Sequence[Colour | None]) -> str:
    """Replace each target's spans by "the <colour> <category>".

    There is one colour per target; None leaves its spans as they are. The rest of the text is
    unchanged, character for character.

    Raises: BadInstruction when there are more or fewer colours than targets.
    """
    n = len(instruction.targets)
    if len(colours) != n:
        raise BadInstruction(
            f"rewrite: {len(colours)} colours for {n} targets in {instruction.text!r}; one each."
        )
    spans: dict[int, tuple[Target, Colour]] = {}
    for target, colour in zip(instruction.targets, colours, strict=True):
        if colour is not None:
            spans |= {span.start: (span, colour) for span in (target, *target.again)}
    text = instruction.text
    for start in sorted(spans, reverse=True):
        span, colour = spans[start]
        # A capital begins a sentence; within one it is a name's or a style of writing ("Bring
        # Anna's cup", "Bring My Cup").
        before = instruction.text[:start].rstrip()
        capital = instruction.text[start].isupper() and (not before or before[-1] in ".!?")
        article = "The" if capital else "the"
        text = text[:start] + f"{article} {colour.name} {span.category}" + text[span.stop :]
    return text


def unite(instruction: Instruction, names: Sequence[str]) -> Instruction:
    """The instruction with one target per object; `names` has the object of every target.

    The first span of an object is its target, and the later ones are `again` of it.
    """
    targets: dict[str, Target] = {}
    for target, name in zip(instruction.targets, names, strict=True):
        first = targets.get(name)
        if first is None:
            targets[name] = target
        else:
            targets[name] = replace(first, again=(*first.again, target, *target.again))
    return Instruction(instruction.text, tuple(targets.values()))


def is_name(said: str, category: str) -> bool:
    """Whether words name an object of a category as the rule has it: "my cup", "Anna's red cup".

    Other words for an object that is named already are not rewritten.
    """
    owner = rf"(?:my|his|her|their|our)\s|(?:{ARTICLE})?(?:[\w-]+\s+){{0,2}}[\w-]+['’]"
    named = re.match(rf"(?:{owner}).*?\b{category_pattern(category)}", said, re.IGNORECASE)
    return named is not None


def category_pattern(category: str) -> str:
    """A regular expression for a category that is named; a plural counts, "cup-holder" does not."""
    return rf"{spaced(category)}(?:s|es)?(?![\w-])"


def spaced(phrase: str) -> str:
    """A regular expression for words with any space between them."""
    return r"\s+".join(re.escape(word) for word in phrase.split())


def possessive(people: str) -> str:
    """A regular expression for "Mary Jane's" and "James'", of one for people."""
    return rf"(?:{people})(?:['’]s|(?<=s)['’])"


def pronoun(people: str) -> str:
    """A regular expression for "my" and "her", which begin an object, of one for people.

    In "give her my cup" and "give her Ben's cup" her is who gets it.
    """
    return rf"(?:my|his|their|our|her(?!\s+(?:(?:{DETERMINER})\b|{possessive(people)})))"


@cache
def _any_owner(owners: tuple[str, ...]) -> re.Pattern[str]:
    """As OWNER, and "his cup", "Anna's cup", "Anna's brother's cup"; for one of `owners` also
    "James' cup" and "Mary Jane's cup". An article before them is no part of the owner, unless the
    name has it."""
    longest_first = sorted(owners, key=len, reverse=True)
    names = "|".join(spaced(name).replace("'", "['’]") for name in longest_first)
    return re.compile(
        rf"\b(?:{ARTICLE})??(?P<owner>(?:{pronoun(names)}|{possessive(names)}"
        r"|(?!(?:it|that|what|who|where|here|there|let|how)['’])[\w-]+(?:['’][\w-]+)*['’]s)\s+"
        rf"{_PERSON})",
        re.IGNORECASE,
    )


def leading_category(rest: str, categories: Collection[str] = ()) -> tuple[str, int]:
    """The category phrase that `rest` begins with, lower case, and its length in characters."""
    for known in sorted(categories, key=len, reverse=True):
        match = re.match(category_pattern(known), rest, re.IGNORECASE)
        if match:
            return known, match.end()
    words: list[str] = []
    length = 0
    for word in re.finditer(r"[\w-]+", rest):
        between = rest[length : word.start()].strip()
        if between or word.group().lower() in STOP_WORDS | NEXT_PHRASE:
            break
        words.append(word.group().lower())
        length = word.end()
    return " ".join(words), length
