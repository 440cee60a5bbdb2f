"""Implicit references: which object a description means, by looks and use (P appendix)."""

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from vap_core.base.errors import BadInstruction, UnknownName, VapError
from vap_core.base.types import Instruction, PersonalObject, Target
from vap_core.instruction.context import MINE, OTHERS, Context, belonging, find_owner, fold
from vap_core.instruction.expressions import (
    Exclusion,
    Expression,
    Possession,
    content,
    find_category,
    find_exclusions,
    find_expressions,
    person_pattern,
)
from vap_core.instruction.rule import check_length, is_name

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
    found = NONE.search(words.lower())
    short, long = obj.description.short.lower(), obj.description.long.lower()
    total = _fit(wanted(words), short, long)
    return total - _fit(words.lower()[found.end() :], short, long) if found else total


def wanted(words: str) -> str:
    """The words before "without", "no" or "non-": what follows is not there."""
    return NONE.split(words.lower(), maxsplit=1)[0].strip()


def _fit(words: str, short: str, long: str) -> float:
    main = short.split(" with ")[0].split()
    prominent = short.split()
    minor = re.findall(r"[\w-]+", long)
    total = 0.0
    said = re.findall(r"\w[\w-]*", words)
    for i, word in enumerate(said):
        same = (word, *SYNONYMS.get(word, ()))
        alike = {*same, word.rstrip("s")}
        plural = {*alike, *(f"{each}s" for each in alike), *(f"{each}es" for each in alike)}
        weight = MINOR * bool(plural & set(minor))
        weight = PROMINENT if alike & set(prominent) else weight
        weight = MAIN if alike & set(main) else weight
        total += weight
        if i and weight and any(f"{said[i - 1]} {each}" in short for each in same):
            total += PAIR
    if words.strip() in ("plain", "all black", "plain one"):
        total += float("plain" in minor or " with " not in short)
    return total


EmbedText = Callable[[Sequence[str]], Float32[np.ndarray, "n d"]]
LOOKS = 0.25
"""Weight of the description's words beside the cosine."""


def object_scores(
    words: str, objects: Sequence[PersonalObject], embed: EmbedText, *, looks: bool
) -> Float32[np.ndarray, " n"]:
    """How well words fit every object.

    It is the mean of the two greatest cosines with the object's texts, and the fit of its
    description; among objects of one category, whose `looks` differ, the greatest cosine.
    """
    there = wanted(words) if looks else words
    (query,) = embed([there or words])
    scores = np.zeros(len(objects), np.float32)
    for i, obj in enumerate(objects):
        texts = [obj.category]
        if obj.note:
            texts += [obj.note, f"{obj.category} {obj.note}", f"something {obj.note}"]
        if looks and obj.description is not None:
            texts.append(f"{obj.category}, {obj.description.short}")
        cosines = np.sort(embed(texts) @ query)
        cosine = cosines[-1] if looks else cosines[-2:].mean()
        if not there:
            cosine = 0.0
        scores[i] = float(cosine) + LOOKS * fit(words, obj)
    return scores


PURPOSE = 0.3
"""Least cosine of words without a category with the object that they mean."""
NOUN = 0.55
"""The same where the words are a noun of the speaker's, as in "my mug"."""
MARGIN = 0.01
"""Least lead over the second object."""
EARLIER = re.compile(
    r"\b(?:earlier|last|yesterday|ago|again|previous(?:ly)?|recent(?:ly)?|latest|same|already|"
    r"once more|just now|this (?:morning|afternoon|evening)|today|tonight|"
    r"before(?!\s+(?!(?:in|on|into|onto|near|next|to)\b)\w)|(?:was|were|been) \w+ing)\b",
    re.IGNORECASE,
)
"""Words of time that make a reference one to an earlier use."""
GENERIC_HEAD = re.compile(
    r"\b(?:ones?|things?|items?|objects?|tools?|stuff|pick|choice)\b", re.IGNORECASE
)
LOOSE = re.compile(
    r"^(?:what|whatever|whichever|something|(?:the|that|this)\s+(?:[\w-]+\s+){0,2}?(?:ones?|things?|"
    r"items?|objects?|tools?|stuff))\b|\b(?:I|my|me|we|our)\b",
    re.IGNORECASE,
)
"""Expressions that do not say what kind of thing they mean; "the window" does."""
TIME = frozenset(
    """earlier last yesterday ago again previous previously recent recently latest same already once
    more just now today tonight before moment time most day""".split()
)


@dataclass(frozen=True)
class Reading:
    """One expression of an instruction, and all that it says."""

    context: Context
    embed: EmbedText
    text: str
    expression: Expression
    expressions: Sequence[Expression]
    exclusions: Sequence[Exclusion]

    def object(self) -> PersonalObject | None:
        """The object that is meant; None where the expression refers to no personal object.

        Raises: BadInstruction, UnknownName.
        """
        expression = self.expression
        if expression.kind == "it":
            return self._it()
        context = self.context
        said = _without(expression.said, self.exclusions, expression.start)
        owner = self._possession.owner(expression, said)
        if expression.kind == "indefinite" and owner is None:
            return None
        rest = _without(expression.clause, self.exclusions, expression.start)
        again = expression.argument and re.search(r"\b(?:again|once more)\b", rest) is not None
        earlier = again or EARLIER.search(said) is not None
        if expression.destination and owner is None and not earlier:
            return None
        every = list(context.objects.values())
        category = self._category(said, owner is not None)
        if owner is None and category is not None and find_category(said, [category]) is None:
            owner = self._possession.elsewhere(expression)
        candidates = [obj for obj in every if category in (None, obj.category)]
        if earlier and category is None and owner is not None and fold(owner) not in MINE:
            return self._used(said, every, owner)
        if owner is not None:
            candidates = belonging(candidates, owner, context.speaker, context.owners)
        excluded = re.search(r"\b(?:other|right)\b", said) is not None
        kept = candidates
        if category is not None or owner is not None:
            kept = self._exclude(candidates)
            excluded |= len(kept) < len(candidates)
        words = content(said, self._known_words(category))
        if earlier:
            return self._used(said, kept)
        if category is None:
            return self._by_meaning(words, kept, owner)
        if owner is None and not excluded and (not words or expression.kind == "pronoun"):
            return None
        return self._only(kept, words, owner, category)

    @property
    def _possession(self) -> Possession:
        return Possession(self.context, self.text, self.expressions)

    def _it(self) -> PersonalObject | None:
        """ "it" is what another expression names, or what was used earlier; alone it is ambiguous.

        Raises: BadInstruction, UnknownName.
        """
        if not self.expression.argument:
            return None
        if EARLIER.search(self.text):
            return self._used(self.text, list(self.context.objects.values()))
        if self.text[: self.expression.start].count(" ") > 3:
            return None
        names = ", ".join(sorted(self.context.objects))
        raise BadInstruction(
            f"parse: 'it' in {self.text[:60]!r} could be any of {names[:150]}; name the object."
        )

    def _categories(self) -> list[str]:
        return sorted({obj.category for obj in self.context.objects.values()})

    def _category(self, said: str, owned: bool) -> str | None:
        """The category that is named; after "mine" or "the striped one" the one named elsewhere."""
        here = find_category(said, self._categories())
        if here is not None:
            return here
        bare = not content(said, self._known_words(None))
        if (bare and owned) or re.search(r"\b(?:other|ones?)\b", said):
            return find_category(self.text, self._categories())
        return None

    def _known_words(self, category: str | None) -> set[str]:
        """Words that name people, time or the category: they do not describe the object."""
        words = set(TIME)
        for name, known_as in self.context.owners.items():
            words.add(name)
            for word in known_as:
                words.update(word.replace("'s", "").split())
        if category is not None:
            for word in category.split():
                words |= {word, f"{word}s", f"{word}es"}
        return words

    def _exclude(self, candidates: list[PersonalObject]) -> list[PersonalObject]:
        """Those of `candidates` that no exclusion means."""
        kept = candidates
        for exclusion in self.exclusions:
            if len(kept) < 2:
                break
            category = find_category(exclusion.said, self._categories())
            if category is not None and category not in {obj.category for obj in kept}:
                continue
            words = content(exclusion.said, self._known_words(category))
            if not words:
                continue
            order, lead = self._ranked(words, kept)
            if lead >= MARGIN:
                kept = [obj for obj in kept if obj is not kept[order[0]]]
        return kept

    def _used(self, said: str, candidates: list[PersonalObject], user: str = "") -> PersonalObject:
        """The one of `candidates` that the person whom the words name used last, on their day."""
        context = self.context
        by = fold(context.speaker) or None
        if user:
            by = find_owner(user, context.speaker, context.owners)
        person = person_pattern(context)
        match = re.search(rf"\b({person}|he|she|they)\s+(?!own)[\w-]+", said, re.IGNORECASE)
        if match and fold(match.group(1)) not in MINE:
            owner = self._possession.antecedent(self.expression, match.group(1))
            known = fold(owner) not in OTHERS
            by = find_owner(owner, context.speaker, context.owners) if known else None
        day = None
        if re.search(r"\byesterday\b", said, re.IGNORECASE):
            day = 1
        elif re.search(r"\b(?:today|this (?:morning|afternoon|evening)|tonight)\b", said, re.I):
            day = 0
        named = {obj.name: obj for obj in candidates}
        for name in context.latest(by, day):
            if name in named:
                return named[name]
        who = f" by {by}" if by else ""
        raise UnknownName(
            f"parse: no earlier use{who} of what {self.expression.said[:60]!r} means is "
            "remembered; name the object."
        )

    def _by_meaning(
        self, words: str, candidates: list[PersonalObject], owner: str | None
    ) -> PersonalObject | None:
        """The object that words without a category mean."""
        if owner is None and not LOOSE.search(self.expression.said):
            return None
        if not words and (self.expression.argument or owner is not None):
            # The text beside the expression and its verb.
            before = self.text[: self.expression.start].rstrip()
            rest = re.sub(r"[\w-]+(?: me| up)?$", "", before) + self.text[self.expression.stop :]
            words = content(rest, self._known_words(None))
        if not words or not candidates:
            return None
        scores = self._scores(words, candidates)
        order = np.argsort(-scores)
        least = PURPOSE
        if owner is not None and not GENERIC_HEAD.search(self.expression.said):
            least = NOUN
        if scores[order[0]] < least:
            if owner is None:
                return None
            raise UnknownName(
                f"parse: nothing like {self.expression.said[:60]!r} is remembered; register it, or "
                "say what kind of thing it is."
            )
        if len(order) > 1 and scores[order[0]] - scores[order[1]] < MARGIN:
            raise _ambiguous(self.expression, [candidates[i] for i in order[:2]])
        return candidates[order[0]]

    def _only(
        self, candidates: list[PersonalObject], words: str, owner: str | None, category: str
    ) -> PersonalObject | None:
        """The one of several objects of a category that the words describe."""
        if not candidates:
            whose = "" if owner is None else f" of {fold(owner)!r}"
            raise UnknownName(
                f"parse: no {category!r}{whose} is remembered; register one with --owner, or name "
                "another owner."
            )
        if len(candidates) == 1:
            return candidates[0]
        if words:
            order, lead = self._ranked(words, candidates)
            if lead >= MARGIN:
                return candidates[order[0]]
        kept = self._contrasted(candidates, category)
        if len(kept) == 1:
            return kept[0]
        raise _ambiguous(self.expression, candidates)

    def _contrasted(self, candidates: list[PersonalObject], category: str) -> list[PersonalObject]:
        """Those of `candidates` that no other expression of the instruction describes.

        "put my cup on the plate; the striped one stays" names the other cup.
        """
        others = [
            content(other.said, self._known_words(category))
            for other in self.expressions
            if other is not self.expression
            and not other.destination
            and find_category(other.said, self._categories()) in (None, category)
        ]
        ranked = [self._ranked(words, candidates) for words in others if words]
        order, lead = max(ranked, key=lambda each: each[1], default=([], 0.0))
        return [obj for i, obj in enumerate(candidates) if lead < MARGIN or i != order[0]]

    def _ranked(self, words: str, candidates: Sequence[PersonalObject]) -> tuple[list[int], float]:
        """The places of at least two candidates, best first, and the lead of the first."""
        scores = self._scores(words, candidates)
        order = np.argsort(-scores)
        return order.tolist(), float(scores[order[0]] - scores[order[1]])

    def _scores(
        self, words: str, candidates: Sequence[PersonalObject]
    ) -> Float32[np.ndarray, " n"]:
        """How well words fit every object: cosine with what is known of it, and its description."""
        one = len({obj.category for obj in candidates}) == 1
        return object_scores(words, candidates, self.embed, looks=one)


def _without(said: str, exclusions: Sequence[Exclusion], start: int) -> str:
    """An expression without the exclusions inside it; `start` is its place in the text."""
    for exclusion in reversed(exclusions):
        first, last = exclusion.start - start, exclusion.stop - start
        if 0 <= first < len(said):
            said = said[:first] + said[max(last, 0) :]
    return said.strip(" ,")


def _ambiguous(expression: Expression, objects: Sequence[PersonalObject]) -> BadInstruction:
    names = " or ".join(obj.name for obj in objects[:4])[:150]
    return BadInstruction(
        f"parse: {expression.said[:60]!r} could be {names}; say whose it is, what it looks like or "
        "what it is for."
    )


@dataclass(frozen=True)
class EmbeddingParser:
    """Finds the object that every expression means, by its name in the memory."""

    context: Context
    embed: EmbedText

    def __call__(self, text: str, categories: Collection[str] = ()) -> Instruction:
        """Parse one instruction; every target names its object.

        Raises: BadInstruction: no personal object, or several fit, or the text is too long;
            UnknownName: none is remembered; MissingWeights: `embed` has no weights here.
        """
        check_length(text)
        exclusions = find_exclusions(text)
        found: list[tuple[Expression, PersonalObject]] = []
        problem: VapError | None = None
        unmet: VapError | None = None
        people = person_pattern(self.context)
        known = {obj.category for obj in self.context.objects.values()}
        expressions = list(find_expressions(text, exclusions, people))
        last = 0
        for expression in expressions:
            if expression.start < last or (found and expression.kind == "it"):
                continue  # "it" is what was named before
            try:
                obj = Reading(
                    self.context, self.embed, text, expression, expressions, exclusions
                ).object()
            except VapError as error:
                if problem is None or expression.governed:
                    problem = error
                # Without such an object the instruction cannot be followed.
                named = find_category(expression.said, known) is not None
                wanted = expression.argument or (expression.destination and named)
                if expression.kind == "owner" and wanted:
                    unmet = unmet or error
                continue
            if obj is not None:
                found.append((expression, obj))
                last = max(last, expression.stop)
        targets = _targets(found)
        if targets and unmet is None:
            return Instruction(text, targets)
        nothing = BadInstruction(
            f'parse: no personal object in {text[:80]!r}; name one as "my <category>", or say what '
            "it is for."
        )
        raise unmet or problem or nothing


def _targets(found: Sequence[tuple[Expression, PersonalObject]]) -> tuple[Target, ...]:
    """One target per object: where a verb of action or a place is, only those that stand there.

    Wherever else the object is named again, as "my cup", that is a span of its target, too.
    """
    governed = [pair for pair in found if pair[0].governed]
    targets: dict[str, Target] = {}
    for expression, obj in governed or found:
        targets.setdefault(obj.name, _target(expression, obj))
    for expression, obj in found:
        target = targets.get(obj.name)
        if target is None or target.start == expression.start:
            continue
        if is_name(expression.said, obj.category):
            again = (*target.again, _target(expression, obj))
            targets[obj.name] = replace(target, again=again)
    return tuple(targets.values())


def _target(expression: Expression, obj: PersonalObject) -> Target:
    return Target(expression.start, expression.stop, obj.owner, obj.category, object=obj.name)
