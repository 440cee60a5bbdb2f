"""Questions to a vision-language model that serves OpenAI's chat protocol.

Any server does: OpenAI's own, or llama.cpp, vLLM or Ollama on this machine. Answers are parsed,
never executed.
"""

import base64
import json
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from http.client import HTTPException
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any
from urllib import request
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit

from vap_core.base.errors import BadEndpoint
from vap_core.base.files import parse_json
from vap_core.base.types import Rgb

URL = "OPENAI_BASE_URL"
MODEL = "OPENAI_MODEL"
KEY = "OPENAI_API_KEY"
"""Environment variables that `endpoint_from_environment` reads."""
MAX_ANSWER_BYTES = 4_000_000


@dataclass(frozen=True)
class ChatEndpoint:
    """A server and a model on it.

    `url` is as OpenAI's clients take it, for example https://api.openai.com/v1.

    Raises: BadEndpoint: the address, the model or the key cannot be right.
    """

    url: str
    model: str
    key: str = field(default="", repr=False)
    timeout_s: float = 60.0
    """A server that is silent for so long is given up."""
    total_s: float = 600.0
    """An answer that is not complete by then is given up."""

    def __post_init__(self) -> None:
        if not _is_web_address(self.url):
            raise BadEndpoint(
                f"chat: {self.url!r} is no address of a chat endpoint; give one like "
                f"https://api.openai.com/v1, or set {URL}."
            )
        if not self.model:
            raise BadEndpoint(f"chat: no model named for {self.url}; set {MODEL}.")
        if self.key and not (self.key.isascii() and self.key.isprintable()):
            raise BadEndpoint(
                f"chat: the key for {self.url} holds a line break or another character "
                f"that no key has; set {KEY} again."
            )


def endpoint_from_environment(url: str = "") -> ChatEndpoint:
    """The endpoint at `url`, or at OPENAI_BASE_URL; model and key from the environment.

    Raises: BadEndpoint.
    """
    return ChatEndpoint(
        url=url or os.environ.get(URL, ""),
        model=os.environ.get(MODEL, ""),
        key=os.environ.get(KEY, "").strip(),
    )


def request_answer(
    endpoint: ChatEndpoint,
    messages: Sequence[dict[str, Any]],
    *,
    doing: str,
    instead: str,
    **fields: Any,
) -> str:
    """The model's answer to some messages; `fields` are further ones of the request.

    Errors name what was being done, and what to take instead.

    Raises: BadEndpoint: the server cannot be reached, takes too long, refuses, or answers something
        other than the protocol says.
    """
    body = {"model": endpoint.model, "messages": list(messages), **fields}
    data = answer_in_time(
        endpoint, lambda: _fetch(endpoint, body, doing), doing=doing, instead=instead
    )
    try:
        message = parse_json(data)["choices"][0]["message"]
        refusal = message.get("refusal")
        text = message.get("content")
        if not refusal and not (isinstance(text, str) and text.strip()):
            raise ValueError("no text")
    except (ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise BadEndpoint(
            f"{doing}: {endpoint.url} does not answer as a chat endpoint does "
            f"({type(error).__name__}); give the address that ends in /v1, or take {instead}."
        ) from error
    if refusal:
        raise BadEndpoint(
            f"{doing}: {endpoint.model} at {endpoint.url} refuses: {_line(str(refusal))!r}; ask "
            f"otherwise, or take {instead}."
        )
    return str(text)


def question_message(question: str, images: Sequence[Rgb] = ()) -> dict[str, Any]:
    """One user message: the question, then the images."""
    content: list[dict[str, Any]] = [{"type": "text", "text": question}]
    for rgb in images:
        content.append({"type": "image_url", "image_url": {"url": data_url(rgb)}})
    return {"role": "user", "content": content}


def answer_in_time[T](
    endpoint: ChatEndpoint, ask: Callable[[], T], *, doing: str, instead: str
) -> T:
    """What `ask` returns, within the endpoint's `total_s`.

    A server that sends a byte now and then passes every limit on silence, so that another thread
    asks and this one waits. The error names what was being done, and what to take instead.

    Raises: BadEndpoint: `ask`'s, or that of an answer that is not complete in time.
    """
    answers: SimpleQueue[T | Exception] = SimpleQueue()

    def run() -> None:
        try:
            answers.put(ask())
        except Exception as error:
            answers.put(error)

    Thread(target=run, daemon=True).start()
    try:
        answer = answers.get(timeout=endpoint.total_s)
    except Empty:
        raise BadEndpoint(
            f"{doing}: {endpoint.url} gives no whole answer within {endpoint.total_s:g} s; take a "
            f"smaller model, or {instead}."
        ) from None
    if isinstance(answer, Exception):
        raise answer
    return answer


def data_url(rgb: Rgb) -> str:
    """The image as a PNG data URL."""
    import cv2

    png = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes()
    return "data:image/png;base64," + base64.b64encode(png).decode()


def _is_web_address(url: str) -> bool:
    try:
        parts = urlsplit(url)
        return parts.scheme in ("http", "https") and bool(parts.hostname)
    except ValueError:
        return False


def _fetch(endpoint: ChatEndpoint, body: dict[str, Any], doing: str) -> bytes:
    """The server's response, of MAX_ANSWER_BYTES at most. Raises: BadEndpoint."""
    headers = {"Content-Type": "application/json"}
    if endpoint.key:
        headers["Authorization"] = f"Bearer {endpoint.key}"
    post = request.Request(
        url=f"{endpoint.url.rstrip('/')}/chat/completions",
        data=json.dumps(body).encode(),
        headers=headers,
        method="POST",
    )
    try:
        opener = request.build_opener(_NoRedirects)
        with opener.open(post, timeout=endpoint.timeout_s) as response:
            data = response.read(MAX_ANSWER_BYTES + 1)
        if len(data) <= MAX_ANSWER_BYTES:
            return data
        raise BadEndpoint(
            f"{doing}: {endpoint.url} answers with over {MAX_ANSWER_BYTES / 1e6:.0f} MB; "
            f"is it a chat endpoint, and {URL} right?"
        )
    except HTTPError as error:
        with error:
            raise BadEndpoint(
                f"{doing}: {endpoint.url} refuses ({error.code}: {_refusal_reason(error)}); "
                f"check {URL}, {MODEL} and {KEY}."
            ) from error
    except (URLError, HTTPException, OSError, ValueError) as error:  # ValueError: of an address
        cause: object = error
        if isinstance(error, URLError):
            cause = error.reason
        raise BadEndpoint(
            f"{doing}: {endpoint.url} gives no answer ({str(cause) or type(cause).__name__}); "
            f"is the server up, and {URL} right?"
        ) from error


def _refusal_reason(error: HTTPError) -> str:
    """What the server says, as one line: a redirect, the protocol's error, or plain text."""
    if 300 <= error.code < 400 and "Location" in error.headers:
        return f"it redirects to {_line(error.headers['Location'])}, which is not followed"
    text = ""
    with suppress(OSError, HTTPException, ValueError, KeyError, TypeError):
        text = error.read(2000).decode(errors="replace")
        text = str(parse_json(text)["error"]["message"])
    return _line(text) or error.reason


def _line(text: str) -> str:
    return " ".join(text.split())[:200]


class _NoRedirects(request.HTTPRedirectHandler):
    """Follows no redirect: the request would carry the key and the images to another server."""

    def redirect_request(
        self, req: request.Request, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> None:
        return None
