"""A parser behind any OpenAI-compatible chat endpoint, through huggingface_hub's InferenceClient.

The model sees the instruction, who speaks, the memory in words (no picture), and earlier uses. It
answers by a JSON schema whose only objects are the remembered ones; the answer is checked, never
executed.
"""

import json
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from threading import Lock, get_ident
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import BadEndpoint, BadInstruction
from vap_core.base.files import parse_json
from vap_core.base.types import Instruction, Target
from vap_core.instruction.context import Context
from vap_core.perception.chat import (
    KEY,
    MAX_ANSWER_BYTES,
    MODEL,
    URL,
    ChatEndpoint,
    answer_in_time,
)

if TYPE_CHECKING:
    from httpx import Response

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
NO_KEY = "none"
"""Sent where the endpoint has no key: without one the client would send Hugging Face's."""
MAX_TOKENS = 400
MAX_USES = 20
"""So many of the last uses the model sees."""
_HOOKS = Lock()
"""Of the shared client's hooks, while they change."""


@dataclass(frozen=True)
class ChatParser:
    """Asks a chat model which remembered objects an instruction means."""

    context: Context
    endpoint: ChatEndpoint

    def __call__(self, text: str, categories: Collection[str] = ()) -> Instruction:
        """Parse one instruction; every target names its object.

        Raises: BadEndpoint: the server cannot be reached, takes too long, refuses, or its answer is
            malformed; BadInstruction: the model finds no personal object.
        """
        messages, schema = self._messages(text), self._schema()
        answer = answer_in_time(
            self.endpoint,
            lambda: _ask(self.endpoint, messages, schema),
            doing="parse",
            instead="--parser rule",
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

    def _schema(self) -> dict[str, Any]:
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
        return {
            "type": "object",
            "properties": {"targets": {"type": "array", "items": target}},
            "required": ["targets"],
            "additionalProperties": False,
        }

    def _targets(self, text: str, answer: str) -> tuple[Target, ...]:
        """The checked targets, left to right, the first of each object. Raises: BadEndpoint."""
        targets: list[Target] = []
        try:
            for row in parse_json(answer)["targets"]:
                obj = self.context.objects[row["object"]]
                said = row["expression"]
                place = re.search(rf"(?<!\w){re.escape(said)}(?!\w)", text, re.IGNORECASE)
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
                f"that was asked for ({type(error).__name__}: {_line(str(error))[:60]!r}); try "
                f"another model in {MODEL}, or --parser rule."
            ) from error
        first: dict[str | None, Target] = {}
        for target in targets:
            first.setdefault(target.object, target)
        return tuple(first.values())


class _Verbatim(str):
    """Text that equals no other: the client turns the format "json_schema" into one of its own,
    which OpenAI's protocol does not have."""

    __hash__ = str.__hash__

    def __eq__(self, other: object) -> bool:
        return self is other


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


def _ask(endpoint: ChatEndpoint, messages: list[dict[str, str]], schema: dict[str, Any]) -> str:
    """The model's answer. Raises: BadEndpoint."""
    import httpx
    from huggingface_hub import InferenceClient
    from huggingface_hub.errors import (
        HfHubHTTPError,
        InferenceTimeoutError,
        OfflineModeIsEnabled,
    )

    form = {
        "type": _Verbatim("json_schema"),
        "json_schema": {"name": "targets", "strict": True, "schema": schema},
    }
    client = InferenceClient(
        base_url=endpoint.url, api_key=endpoint.key or NO_KEY, timeout=endpoint.timeout_s
    )
    try:
        with client, _refusing_redirects(endpoint):
            answer = client.chat_completion(
                messages=list[Any](messages),
                model=endpoint.model,
                max_tokens=MAX_TOKENS,
                temperature=0.0,
                extra_body={"response_format": form},
            )
        message = answer.choices[0].message
        refusal = getattr(message, "refusal", None)
        if refusal:
            raise BadEndpoint(
                f"parse: {endpoint.model} at {endpoint.url} refuses: {_line(refusal)!r}; say it "
                "otherwise, or take --parser rule."
            )
        if not isinstance(message.content, str) or not message.content.strip():
            raise ValueError("no text")
        return message.content[:MAX_ANSWER_BYTES]
    except HfHubHTTPError as error:
        raise BadEndpoint(
            f"parse: {endpoint.url} refuses ({error.response.status_code}: "
            f"{_line(error.response.text or error.response.reason_phrase)}); check {URL}, {MODEL} "
            f"and {KEY}."
        ) from error
    except (InferenceTimeoutError, httpx.TimeoutException) as error:
        raise BadEndpoint(
            f"parse: {endpoint.url} is silent for {endpoint.timeout_s:g} s; is the server up, and "
            f"{URL} right?"
        ) from error
    except OfflineModeIsEnabled as error:
        raise BadEndpoint("parse: HF_HUB_OFFLINE forbids requests; unset it for chat.") from error
    except (httpx.HTTPError, httpx.InvalidURL, OSError) as error:
        raise BadEndpoint(
            f"parse: {endpoint.url} gives no answer ({_line(str(error)) or type(error).__name__}); "
            f"is the server up, and {URL} right?"
        ) from error
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError) as error:
        raise BadEndpoint(
            f"parse: {endpoint.url} does not answer as a chat endpoint does "
            f"({type(error).__name__}); give the address that ends in /v1."
        ) from error


@contextmanager
def _refusing_redirects(endpoint: ChatEndpoint) -> Iterator[None]:
    """What this thread asks goes to no other server: it would get the instruction and the people.

    All requests of huggingface_hub share one client, which follows redirects. Its hooks see a
    response before that. Raises: BadEndpoint: the server redirects.
    """
    from huggingface_hub import get_session

    shared = get_session()
    asking = get_ident()

    def refuse(response: "Response") -> None:
        if response.has_redirect_location and get_ident() == asking:
            raise BadEndpoint(
                f"parse: {endpoint.url} refuses ({response.status_code}: it redirects to "
                f"{_line(response.headers['location'])}, which is not followed); check {URL}."
            )

    with _HOOKS:
        hooks = shared.event_hooks
        shared.event_hooks = {**hooks, "response": [*hooks["response"], refuse]}
    try:
        yield
    finally:
        with _HOOKS:
            hooks = shared.event_hooks
            others = [hook for hook in hooks["response"] if hook is not refuse]
            shared.event_hooks = {**hooks, "response": others}


def _line(text: str) -> str:
    return " ".join(str(text).split())[:120]
