"""A parser behind any OpenAI-compatible chat endpoint.

The model sees the instruction, who speaks, the memory in words (no picture), and earlier uses. It
answers by a JSON schema whose only objects are the remembered ones; the answer is checked, never
executed.
"""

import json
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

from vap_core.base.errors import BadEndpoint, BadInstruction
from vap_core.base.files import parse_json
from vap_core.base.types import Instruction, Target
from vap_core.instruction.context import Context
from vap_core.instruction.rule import check_length, is_name
from vap_core.perception.chat import MODEL, ChatEndpoint, request_answer

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
            malformed; BadInstruction: the model finds no personal object, or the text is too long.
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
            raise BadInstruction(
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
                targets.append(
                    Target(
                        start=place.start(),
                        stop=place.end(),
                        owner=obj.owner,
                        category=obj.category,
                        object=obj.name,
                    )
                )
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
    about: dict[str, Any] = {"object": obj.name, "category": obj.category}
    if obj.owner:
        about["owner"] = obj.owner
    if obj.note:
        about["note"] = obj.note
    if obj.description is not None:
        about["looks"] = obj.description.long
    return about
