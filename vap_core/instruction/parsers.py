"""The parsers by name, behind one protocol, and the parser that asks a chat model."""

import json
import re
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from vap_core.base.errors import BadEndpoint, NothingPersonal, UnknownName
from vap_core.base.files import parse_json
from vap_core.base.types import Instruction, PersonalObject, Target, value
from vap_core.instruction.context import Context, owners_of, read_uses
from vap_core.instruction.rule import Parser, check_length, is_name, parse
from vap_core.perception.chat import MODEL, ChatEndpoint, request_answer

NAMES = ("rule", "embedding", "chat")
"""What `load_parser` knows; the address of a chat endpoint is one, too."""


def rule_parser(memory: Mapping[str, PersonalObject]) -> Parser:
    """The rule, which knows "Anna's cup" where objects have owners."""
    return partial(parse, owners=tuple(owners_of(memory.values())))


def load_parser(name: str, context: Context, *, fall_back: bool = False) -> Parser:
    """A parser by its name: "rule", "embedding", "chat", or the address of a chat endpoint.

    "chat" is at OPENAI_BASE_URL. With `fall_back` the rule parses what the endpoint does not
    answer, with a note on stderr.

    Raises: UnknownName: no such parser, or nothing is remembered; BadEndpoint.
    """
    if name == "rule":
        return rule_parser(context.objects)
    if not context.objects and (name in NAMES or "://" in name):
        raise UnknownName("parser: the memory is empty; register an object first.")
    if name == "embedding":
        from vap_core.instruction.implicit import EmbeddingParser
        from vap_core.perception.text_encoder import embed_text

        return EmbeddingParser(context, embed_text)
    if name == "chat" or "://" in name:
        from vap_core.perception.chat import endpoint_from_environment

        parser = ChatParser(context, endpoint_from_environment("" if name == "chat" else name))
        if fall_back:
            return FallBack(parser, rule_parser(context.objects), partial(print, file=sys.stderr))
        return parser
    raise UnknownName(
        f"parser: {name!r} is unknown; known: {', '.join(NAMES)}, or the address of a chat "
        "endpoint such as http://127.0.0.1:8080/v1."
    )


def ask_once(parser: Parser) -> Parser:
    """The parser, which is asked once for every text: a clip is grounded several times."""
    answers: dict[str, Instruction] = {}

    def ask(text: str, categories: Collection[str] = ()) -> Instruction:
        if text not in answers:
            answers[text] = parser(text, categories)
        return answers[text]

    return ask


@value
class Parsing:
    """Which parser a command takes, and who speaks ("" where nobody said)."""

    parser: str = "rule"
    speaker: str = ""
    fall_back: bool = False

    def load(self, bank: Path, objects: Mapping[str, PersonalObject]) -> Parser:
        """The parser for the objects of a bank, and for its history.

        Raises: as `load_parser`; BadMemory: a damaged line of the history.
        """
        uses = () if self.parser == "rule" else read_uses(bank)
        context = Context(objects=objects, speaker=self.speaker, uses=uses)
        return ask_once(load_parser(self.parser, context, fall_back=self.fall_back))


@dataclass(frozen=True)
class FallBack:
    """Asks `first`; where its endpoint fails, reports that in one line and asks `second`."""

    first: Parser
    second: Parser
    report: Callable[[str], object]

    def __call__(self, text: str, categories: Collection[str] = ()) -> Instruction:
        try:
            return self.first(text, categories)
        except BadEndpoint as error:
            self.report(f"note: {error} The rule parses instead.")
            return self.second(text, categories)


TASK = (
    "A user tells a robot what to do. Find every expression of the instruction that refers to one "
    "of the user's or another person's remembered objects, and say which object it means. "
    'Expressions can be explicit ("my cup"), about an owner ("Anna\'s cup"), implicit ("the thing '
    'for shaving"), about earlier uses ("the one I used last"), or exclude others ("not the '
    'striped one"). "my" means objects of the speaker. A cup, any cup, and things that are not '
    "remembered are no remembered object: leave them out; if there is none, answer with an empty "
    "list. Leave out pronouns for an object that is named already. Copy each expression letter by "
    "letter from the instruction, with its article or possessive and everything that describes "
    "it, without the verb and the place where it goes. Answer in JSON."
)
MAX_TOKENS = 400
MAX_USES = 20
"""So many of the last uses the model sees."""


@dataclass(frozen=True)
class ChatParser:
    """Asks a chat model which remembered objects an instruction means."""

    context: Context
    endpoint: ChatEndpoint

    def __call__(self, text: str, categories: Collection[str] = ()) -> Instruction:
        """Parse one instruction; every target names its object.

        Raises: BadEndpoint: the server cannot be reached, takes too long, refuses, or its answer is
            malformed; NothingPersonal: the model finds no personal object; BadInstruction: the text
            is too long.
        """
        check_length(text)
        answer = request_answer(
            self.endpoint,
            self._messages(text),
            doing="parse",
            instead="--parser rule",
            max_tokens=MAX_TOKENS,
            temperature=0.0,
            response_format=self._response_format(),
        )
        targets = self._targets(text, answer)
        if not targets:
            raise NothingPersonal(
                f"parse: {self.endpoint.model} finds no personal object in {text[:80]!r}; name one "
                'as "my <category>".'
            )
        return Instruction(text, targets)

    def _messages(self, text: str) -> list[dict[str, str]]:
        about = {
            "instruction": text,
            "speaker": self.context.speaker or "unknown",
            "people": self.context.owners,
            "objects": [_in_words(self.context, name) for name in self.context.objects],
            "earlier uses, last one last": [
                {"object": use.object, "by": use.by, "at": use.at}
                for use in self.context.uses[-MAX_USES:]
            ],
        }
        if self.context.now is not None:
            about["now"] = self.context.now.isoformat(timespec="minutes")
        return [
            {"role": "system", "content": TASK},
            {"role": "user", "content": json.dumps(about, ensure_ascii=False)},
        ]

    def _response_format(self) -> dict[str, Any]:
        """The form of an answer, as OpenAI's structured output takes it."""
        fields = {
            "expression": {"type": "string"},
            "object": {"type": "string", "enum": sorted(self.context.objects)},
        }
        target = {
            "type": "object",
            "properties": fields,
            "required": list(fields),
            "additionalProperties": False,
        }
        schema = {
            "type": "object",
            "properties": {"targets": {"type": "array", "items": target}},
            "required": ["targets"],
            "additionalProperties": False,
        }
        return {
            "type": "json_schema",
            "json_schema": {"name": "targets", "strict": True, "schema": schema},
        }

    def _targets(self, text: str, answer: str) -> tuple[Target, ...]:
        """The checked targets, left to right, one of each object. Raises: BadEndpoint.

        An expression that comes again is the next place where the instruction has it.
        """
        targets: list[Target] = []
        places: dict[str, Iterator[re.Match[str]]] = {}
        try:
            for row in parse_json(answer)["targets"]:
                obj = self.context.objects[row["object"]]
                said = row["expression"]
                if said not in places:
                    whole = rf"(?<!\w){re.escape(said)}(?!\w)"
                    places[said] = re.finditer(whole, text, re.IGNORECASE)
                place = next(places[said], None)
                if place is None or not said.strip():
                    raise ValueError("no part of the instruction")
                targets.append(Target(*place.span(), obj.owner, obj.category, object=obj.name))
            targets.sort(key=lambda target: target.start)
            for one, other in pairwise(targets):
                if other.start < one.stop:
                    raise ValueError("overlapping expressions")
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise BadEndpoint(
                f"parse: {self.endpoint.model} at {self.endpoint.url} answers outside the form "
                f"that was asked for ({type(error).__name__}: {str(error)[:60]!r}); try "
                f"another model in {MODEL}, or --parser rule."
            ) from error
        kept: dict[str | None, Target] = {}
        for target in targets:
            first = kept.setdefault(target.object, target)
            said = text[target.start : target.stop]
            if target is not first and is_name(said, target.category):
                kept[target.object] = replace(first, again=(*first.again, target))
        return tuple(kept.values())


def _in_words(context: Context, name: str) -> dict[str, Any]:
    obj = context.objects[name]
    about = {"object": obj.name, "category": obj.category}
    if obj.owner:
        about["owner"] = obj.owner
    if obj.note:
        about["note"] = obj.note
    if obj.description is not None:
        about["looks"] = obj.description.long
    return about
