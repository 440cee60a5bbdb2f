"""Expressions that may refer to an object, by grammar: where they are, whose they are, and
the steps of a sentence.

Nothing here knows what objects look like or are for: `implicit` decides which object is meant.
"""

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

from vap_core.base.errors import BadInstruction
from vap_core.base.types import value
from vap_core.instruction.context import MINE, OTHERS, Context, fold
from vap_core.instruction.rule import ARTICLE, category_pattern, possessive, pronoun, spaced

PLACING = "put|place|set|lay|move|drop|push|stack|store|leave|slide|stand|stow"
ACTION = (
    rf"{PLACING}|pick(?: up)?|select|choose|bring|hand|give|pass|get|take|fetch|grab|lift|use|find|"
    "show|need|want|like|ask(?:s|ed)? for|wish for|look(?:ing)? for|have|"
    "picking up|selecting|putting|placing|moving|handing|bringing|picking"
)
DESTINATION = (
    "into|onto|in|on|near|next to|beside|to|towards|toward|under|behind|from|at|over|inside|by|"
    "against|between|above|below|around"
)
TIMES = re.compile(
    r"(?:(?:the|this|last|that|next)\s+)?(?:time|morning|afternoon|evening|night|noon|weekend|"
    r"week|yesterday|today|breakfast|lunch|dinner|\w+day|before|earlier)s?\b",
    re.IGNORECASE,
)
"""What a preposition of time stands before: "in the morning", "from last time"."""
PUNCTUATION = ",;:.!?—–"
GENERIC = frozenset(
    """one ones thing things item items object objects tool tools pick choice stuff what
    whatever whichever something anything which that this those these the my mine his her hers
    their theirs our ours own personal favourite favorite dear old good right wrong proper best
    other same very of is are was were be been being for with to from at when while i me you we
    us he she they it need needs want wants use used uses using normally usually always often
    like likes love loves can could would will meant reserved made helps help lets let takes
    take needed required cannot goes back do does did just really know thanks please so and or
    then belongs belong belonging owned owns by not n't isn't don't has have had who
    whose""".split()
)
"""Words that say nothing about which object is meant."""
_OWNED = r"(?!(?:it|that|what|who|where|here|there|let|how|she|he)['’]s)[\w-]+['’]s"
_RELATIVE = re.compile(
    r"\b(?:that|which|who|whose|what|where|when|I|you|we|he|she|they|for|with|of)\b", re.IGNORECASE
)
"""Words after which "and my cup" may belong to what is said of the object before."""
_JOINED = r"(?:\s*,)?\s+(?:and|as well as|plus|&)\s+"
VERB = r"\s(?:is|are|was|were|goes|go|stays|stay|has|can|cannot|will|would|should|must|comes)\b"
"""A verb whose subject stands before it."""
EXCLUSION = re.compile(
    r"(?:\b(?:but|only|and|just)\s+)?(?:\b(?:not|never)\b|n['’]t\b(?:\s+(?:want|mean|need))?"
    r"|\binstead of\b|\brather than\b|\bother than\b|\bexcept(?: for)?\b|\bapart from\b"
    r"|\banything but\b|\bleave\b)",
    re.IGNORECASE,
)
"""Words after which comes what is not meant."""
IRRELEVANT = re.compile(r"(?:just\s+)?(?:any|matter|care|forget|whose)\b", re.IGNORECASE)
TRAILING = re.compile(
    r"(?:\s+|^)(?:please|now|again|too|then|thanks|first|right away|once more|and|so|but|only)$",
    re.IGNORECASE,
)


@value
class Exclusion:
    """`text[start:stop]` says what is not meant; `said` is that without the words of negation."""

    start: int
    stop: int
    said: str


@value
class Expression:
    """`text[start:stop]`, which may refer to an object.

    `kind` is the group of `_beginning` that it begins with. `argument` says whether an action's
    verb stands before it, `destination` whether it is where something is put; in a list, before the
    first.
    """

    start: int
    stop: int
    said: str
    kind: str
    argument: bool
    destination: bool
    clause: str
    """The expression and the rest of its clause."""

    @property
    def governed(self) -> bool:
        """Whether it is what something is done with, or where."""
        return self.argument or self.destination


def find_exclusions(text: str) -> tuple[Exclusion, ...]:
    """What an instruction says is not meant, left to right."""
    found: list[Exclusion] = []
    for match in EXCLUSION.finditer(text):
        if found and match.start() < found[-1].stop:
            continue
        stop = _clause_end(text, match.end())
        further = re.search(rf"\s+(?:and|so)\s+(?:{ACTION})\b", text[match.end() : stop])
        if further:
            stop = match.end() + further.start()
        stop = _before_destination(text, match.start(), match.end(), stop)
        said = text[match.end() : stop].strip()
        if said and not IRRELEVANT.match(said):
            found.append(Exclusion(match.start(), stop, said))
    return tuple(found)


def find_expressions(
    text: str, exclusions: Collection[Exclusion], people: str = "me"
) -> Iterator[Expression]:
    """Every expression outside the exclusions, left to right; one can be inside another.

    `people` is a `person_pattern`: "my brother" is a person, "my brother's cup" is not.
    """
    before: Expression | None = None
    for match in _beginning(people).finditer(text):
        start = match.start()
        if any(one.start <= start < one.stop for one in exclusions):
            continue
        person = re.match(rf"(?:{people})\b(?!['’])", text[start:], re.IGNORECASE)
        if person and match.end() <= start + person.end():
            continue
        clause_end = _clause_end(text, match.end())
        stop = _before_verb(text, start, match.end(), clause_end)
        stop = _before_destination(text, start, match.end(), stop)
        if match.lastgroup == "it":
            stop = match.end()
        if match.lastgroup == "owner":
            stop = _before_coordinated(text, match.end(), stop, people)
        for exclusion in exclusions:
            if start < exclusion.start < stop:
                stop = exclusion.start
        stop = _trim(text, start, stop)
        for exclusion in exclusions:
            if not text[stop : exclusion.start].strip(" ,") and exclusion.start >= stop:
                stop = _trim(text, start, exclusion.stop)
        ahead = text[:start].rstrip()
        kind = str(match.lastgroup)
        if kind in ("owner", "definite") and stop <= match.end():
            kind = "alone" if kind == "owner" and match.group().lower() not in MINE else kind
        acted = re.search(rf"\b(?:{ACTION})(?: me| us)?(?: both)?$", ahead, re.IGNORECASE)
        placed = re.search(rf"\b(?:{DESTINATION})$", ahead, re.IGNORECASE)
        first = None
        if before is not None and kind == "owner" and _continues(text, before, start, stop):
            first = before
        before = Expression(
            start=start,
            stop=stop,
            said=text[start:stop],
            kind=kind,
            argument=acted is not None or (first is not None and first.argument),
            destination=placed is not None or (first is not None and first.destination),
            clause=text[start:clause_end],
        )
        yield before


def content(said: str, without: Collection[str] = ()) -> str:
    """The words that say which object is meant, in their order."""
    words = [re.sub(r"['’]s$", "", word) for word in re.findall(r"[\w'’-]+", said.lower())]
    return " ".join(word for word in words if word not in GENERIC and word not in without)


def find_category(said: str, categories: Collection[str]) -> str | None:
    """The longest category that is named; a plural counts."""
    named = (
        category
        for category in sorted(categories, key=len, reverse=True)
        if re.search(rf"\b{category_pattern(category)}", said, re.IGNORECASE)
    )
    return next(named, None)


def person_pattern(context: Context) -> str:
    """A regular expression for anybody whom the memory knows, and for the speaker."""
    words = ["I", "me"]
    for name, known_as in context.owners.items():
        words += [spaced(name), f"{ARTICLE}{spaced(name)}"]
        for word in known_as:
            own = spaced(word.split("'s ")[-1])
            words += [f"my {own}", f"{ARTICLE}{own}"]
            if "'s " in word:
                words.append(spaced(word))
    return "|".join(sorted(words, key=len, reverse=True))


@cache
def _beginning(people: str) -> re.Pattern[str]:
    """What an expression begins with, by kind; `people` is a `person_pattern`."""
    owned = rf"(?:{possessive(people)}|{_OWNED})"
    return re.compile(
        r"\b(?:(?P<several>(?:one|some|any) of (?:my|his|her|their|our))"
        rf"|(?P<owner>{pronoun(people)}\b(?:\s+(?:[\w-]+\s+)?{_OWNED}(?:\s+{_OWNED})?)?"
        rf"|{owned}(?:\s+[\w-]+['’]s){{0,2}})"
        r"|(?P<alone>mine|hers|theirs|ours)"
        r"|(?P<definite>(?:the|that|this|those|these)\b(?!['’])"
        r"(?!\s+(?:time|way|you|I|we|he|she|they)\b))"
        r"|(?P<pronoun>what|whatever|whichever|something)|(?P<it>it)"
        r"|(?P<indefinite>an?|any|some|another|one))(?!\w)",
        re.IGNORECASE,
    )


def _before_coordinated(text: str, begin: int, stop: int, people: str) -> int:
    """Where an owned object ends in "my cup and my bag", which are two; `stop` where it is one.

    A person is no object: "and my brother", but "and my brother's bag".
    """
    owner = rf"(?:my|his|her|their|our)\s|(?:{people})['’]|{_OWNED}"
    joined = re.search(rf"{_JOINED}(?=(?:{owner}))", text[begin:stop], re.IGNORECASE)
    if joined is None or _RELATIVE.search(text[begin : begin + joined.start()]):
        return stop
    if re.match(rf"(?:{people})\b(?!['’])", text[begin + joined.end() :], re.IGNORECASE):
        return stop
    return begin + joined.start()


def _continues(text: str, before: Expression, start: int, stop: int) -> bool:
    """Whether an owned object is one more of a list: "my cup, my bag and my pen"."""
    between = text[before.stop : start]
    if before.kind != "owner" or not re.fullmatch(rf"\s*,\s*|{_JOINED}", between, re.IGNORECASE):
        return False
    return re.match(VERB, text[stop:], re.IGNORECASE) is None


def _clause_end(text: str, start: int) -> int:
    """The next punctuation mark, "but", or " and <action>" after `start`."""
    stop = len(text)
    mark = re.search(rf"[{PUNCTUATION}](?=\s|$)", text[start:])
    if mark:
        stop = start + mark.start()
    further = re.search(
        rf"\s+(?:but\b|(?:and|so|then)\s+(?:{ACTION}|leave)\b)", text[start:stop], re.IGNORECASE
    )
    if further:
        stop = start + further.start()
    return stop


def _before_verb(text: str, start: int, begin: int, stop: int) -> int:
    """Where a noun phrase from `start` ends: before its verb, unless a relative clause has it."""
    verb = re.search(VERB, text[begin:stop], re.IGNORECASE)
    if verb is None:
        return stop
    said = text[start : begin + verb.start()]
    if re.search(
        r"\b(?:that|which|who|what|whatever|whichever|I|you|we|he|she|they)\b", said, re.I
    ):
        return stop
    if re.search(r"\s(?:my|[A-Z])[\w-]*\s+[\w-]+$", said):
        return stop  # a relative clause without its pronoun: "the cup my brother has"
    return begin + verb.start()


def _before_destination(text: str, begin: int, start: int, stop: int) -> int:
    """Where an expression ends that begins at `begin` and whose clause ends at `stop`.

    In a relative clause a preposition belongs to it, but for the last phrase after a verb of
    placing.
    """
    rest = text[start:stop]
    phrase = rf"\s(?:{DESTINATION})(?=\s+\w)"
    places = []
    for match in re.finditer(phrase, rest, re.IGNORECASE):
        follows = rest[match.end() :].lstrip()
        if re.match(rf"(?:{DESTINATION})\b", follows, re.IGNORECASE):
            continue  # a stranded preposition: "the thing I put flowers in on the plate"
        if re.search(
            r"\b(?:belong\w*|lent|owned|suited|used)$", rest[: match.start()], re.IGNORECASE
        ):
            continue
        if TIMES.match(follows):
            continue
        places.append(start + match.start())
    if not places:
        return stop
    verbs = re.findall(rf"\b(?:{ACTION})\b", text[:begin], re.IGNORECASE)
    placing = bool(verbs) and re.fullmatch(
        rf"(?:{PLACING}|putting|placing|moving)", verbs[-1], re.I
    )
    relative = re.search(
        r"^(?:what|whatever|something)\b|\b(?:I|you|we|he|she|they|that|which|for|when|[\w-]+ing|"
        r"is|are|was|meant|reserved)\b",
        text[begin : places[-1]],
        re.IGNORECASE,
    )
    if relative is None:
        return places[0]
    stranded = re.search(rf"\b(?:{DESTINATION}|with)$", rest.rstrip(), re.IGNORECASE)
    if placing and not stranded:
        return places[-1]
    return stop


def _trim(text: str, start: int, stop: int) -> int:
    """The end of an expression without spaces, commas, and words that belong to the sentence."""
    while True:
        said = text[start:stop].rstrip(" ,")
        shorter = TRAILING.sub("", said)
        stop = start + len(shorter)
        if shorter == text[start:stop] and shorter == said:
            return stop


@dataclass(frozen=True)
class Possession:
    """Who owns, or did, what the expressions of one instruction say."""

    context: Context
    text: str
    expressions: Sequence[Expression]

    def owner(self, expression: Expression, said: str) -> str | None:
        """The owner that an expression names; `said` is it without what it excludes."""
        person = person_pattern(self.context)
        categories = {obj.category for obj in self.context.objects.values()}
        # "it's Ben's" and "the cup's Ben's", but not the two of "Anna's brother's"
        subjects = ["it", "that", "this", "which", "who", "one", *map(spaced, categories)]
        for pattern in (
            rf"\bof (mine|his|hers|theirs|ours|(?:{person})|[\w-]+['’]s)(?:['’]s)?(?:\W|$)",
            rf"\b(?:belong\w*|owned) (?:to|by) (my [\w-]+|{person}|us|him|her|them|[\w-]+)\b",
            rf"\b({person}|my [\w-]+|he|she|they|we|[A-Z][\w-]+) (?:owns?\b|has\W*$)",
            r"(?:\bis|\bare|['’]s) (mine|his|hers|theirs|ours|my [\w-]+['’]s)(?:\W|$)",
            rf"(?:\bis|\bare|\b(?:{'|'.join(subjects)})['’]s) ([\w-]+['’]s)(?:\W|$)",
        ):
            match = re.search(pattern, said, re.IGNORECASE)
            if match:
                return self.antecedent(expression, match.group(1))
        if expression.kind == "several":
            return said.split()[2]
        if expression.kind in ("owner", "alone"):
            beginning = self._beginning(said)
            return beginning and self.antecedent(expression, beginning)
        if find_category(said, categories) is not None:
            for other in self.expressions:
                if other.kind == "alone" and other is not expression:
                    return fold(other.said)
        return None

    def elsewhere(self, expression: Expression) -> str | None:
        """The only owner that another expression names: "Ben's cup is there: take that one"."""
        others = [
            self._beginning(other.said)
            for other in self.expressions
            if other.kind in ("owner", "alone") and other is not expression
        ]
        owners = {fold(beginning) for beginning in others if beginning}
        return owners.pop() if len(owners) == 1 else None

    def _beginning(self, said: str) -> str | None:
        """The owner that an expression begins with: "my", "Anna's", "James'"."""
        people = person_pattern(self.context)
        known = possessive(people)
        things = "|".join({spaced(obj.category) for obj in self.context.objects.values()})
        one = rf"(?!(?:{things})['’])[\w-]+['’]s"  # no person: "my brother's cup's lid"
        pattern = (
            rf"{pronoun(people)}(?:\s+(?:[\w-]+\s+)?{one}(?:\s+{one})?)?(?=\W|$)"
            rf"|mine|hers|theirs|ours|(?:{known}|[\w-]+['’]s)(?:\s+{one}){{0,2}}"
        )
        match = re.match(pattern, said, re.IGNORECASE)
        return match and match.group()

    def antecedent(self, expression: Expression, owner: str) -> str:
        """The person that "his" refers to, where one is named before; else the words themselves."""
        if fold(owner) not in OTHERS:
            return owner
        people = re.compile(rf"\b(?:{person_pattern(self.context)})\b", re.IGNORECASE)
        named = [
            match.group()
            for match in people.finditer(self.text[: expression.start])
            if fold(match.group()) not in MINE
        ]
        return named[-1] if named else owner


_NEXT = r"(?:and\s+)?(?:then|after that|afterwards)\b"
STEP = re.compile(
    rf"\s*(?:[,;.!?]+\s*{_NEXT}|\s{_NEXT}"
    r"|(?:[;!?]+|(?<!\bDr)(?<!\bMr)(?<!\bMrs)(?<!\bMs)(?<!\bSt)\.)(?=\s+\S)"
    r"|[\r\n]+)\s*,?\s*",
    re.IGNORECASE,
)
"""What stands between two steps: "then", "and then", "after that", the end of a sentence, of which
"!" and "?" are one, too, or of a line."""
_NOTHING = re.compile(rf"(?:and|{_NEXT})?\W*", re.IGNORECASE)
"""What is no command: "then" or "and" alone, or no word at all."""
_BEFORE = r"(?:(?:first|now|please|(?:could|can|would|will) you)\s*,?\s+)*"
STEP_VERB = re.compile(rf"{_BEFORE}(?P<verb>{ACTION})\b", re.IGNORECASE)
PLACE = re.compile(rf"{_BEFORE}(?:{PLACING})\b", re.IGNORECASE)
STEP_DESTINATION = re.compile(
    r"\s(?:into|onto|in|on|near|next to|beside|to|at|inside|under)\s.*", re.IGNORECASE
)
IT = re.compile(r"\b(?:it|them)\b", re.IGNORECASE)


def decompose(text: str) -> tuple[str, ...]:
    """The commands of an instruction, in order: one for each step, at least one.

    A step without a verb repeats the one before it, and where that places something, its place,
    unless it names one of its own.

    Raises: BadInstruction: no step, or "it" in a later step, which could be several objects.
    """
    steps: list[str] = []
    for part in STEP.split(text.strip().rstrip(".!?")):
        step = " ".join(part.split())
        if _NOTHING.fullmatch(step):
            continue
        if steps and IT.search(step):
            raise BadInstruction(
                f"decompose: 'it' in {step!r} could be any object of {steps[-1]!r} or before; name "
                "the object."
            )
        verb = STEP_VERB.match(steps[-1]) if steps and not STEP_VERB.match(step) else None
        if verb is not None:
            place = None
            if PLACE.match(steps[-1]) and not STEP_DESTINATION.search(step):
                place = STEP_DESTINATION.search(steps[-1])
            step = f"{verb['verb']} {step}{place.group() if place else ''}"
        steps.append(step)
    if not steps:
        raise BadInstruction(
            f'decompose: no command in {text!r}; say one, for example "bring my cup, then my mug".'
        )
    return tuple(steps)
