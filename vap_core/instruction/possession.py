"""Whose object an expression says that it means, in words: "Anna's", "my brother's", "his"."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from vap_core.instruction.context import Context
from vap_core.instruction.expressions import Expression, find_category, person_pattern
from vap_core.instruction.owners import MINE, OTHERS, fold
from vap_core.instruction.rule import possessive, pronoun, spaced


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
        owners = set()
        for other in self.expressions:
            if other.kind in ("owner", "alone") and other is not expression:
                beginning = self._beginning(other.said)
                if beginning:
                    owners.add(fold(beginning))
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
        named = []
        for match in people.finditer(self.text[: expression.start]):
            if fold(match.group()) not in MINE:
                named.append(match.group())
        return named[-1] if named else owner
