"""The parsers by name, behind one protocol."""

import sys
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from vap_core.base.errors import BadEndpoint, UnknownName
from vap_core.base.types import Instruction, PersonalObject, value
from vap_core.instruction.context import Context
from vap_core.instruction.history import read_uses
from vap_core.instruction.owners import owners_of
from vap_core.instruction.rule import Parser, parse

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
        from vap_core.instruction.embedding import EmbeddingParser
        from vap_core.perception.text_encoder import embed_text

        return EmbeddingParser(context, embed_text)
    if name == "chat" or "://" in name:
        from vap_core.instruction.chat import ChatParser
        from vap_core.perception.chat import endpoint_from_environment

        endpoint = endpoint_from_environment("" if name == "chat" else name)
        parser = ChatParser(context, endpoint)
        if fall_back:
            return FallBack(parser, rule_parser(context.objects), _print_error)
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


def _print_error(line: str) -> None:
    print(line, file=sys.stderr)
