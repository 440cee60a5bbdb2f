"""Questions to a vision-language model that serves OpenAI's chat protocol.

Any server does: OpenAI's own, or llama.cpp, vLLM or Ollama on this machine. Answers are parsed,
never executed.
"""

import base64
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any
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
        try:
            parts = urlsplit(self.url)
            is_address = parts.scheme in ("http", "https") and bool(parts.hostname)
        except ValueError:
            is_address = False
        if not is_address:
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
    content = [{"type": "image_url", "image_url": {"url": data_url(rgb)}} for rgb in images]
    return {"role": "user", "content": [{"type": "text", "text": question}, *content]}


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


def _fetch(endpoint: ChatEndpoint, body: dict[str, Any], doing: str) -> bytes:
    """The server's response, of MAX_ANSWER_BYTES at most; no redirect is followed, which would
    carry the key and the images to another server.

    Raises: BadEndpoint.
    """
    import httpx

    who = f"{doing}: {endpoint.url}"
    headers = {"Authorization": f"Bearer {endpoint.key}"} if endpoint.key else {}
    url = f"{endpoint.url.rstrip('/')}/chat/completions"
    data = b""
    try:
        with httpx.stream(
            "POST", url, json=body, headers=headers, timeout=endpoint.timeout_s
        ) as response:
            for part in response.iter_bytes():
                data += part
                if len(data) > MAX_ANSWER_BYTES:
                    raise BadEndpoint(
                        f"{who} answers with over {MAX_ANSWER_BYTES / 1e6:.0f} MB; is it a chat "
                        f"endpoint, and {URL} right?"
                    )
    except (httpx.HTTPError, httpx.InvalidURL, ValueError, OSError) as error:
        raise BadEndpoint(
            f"{who} gives no answer ({_line(str(error)) or type(error).__name__}); is the server "
            f"up, and {URL} right?"
        ) from error
    if response.is_success:
        return data
    reason = data[:2000].decode(errors="replace")
    with suppress(ValueError, KeyError, TypeError):
        reason = str(parse_json(reason)["error"]["message"])
    if response.has_redirect_location:
        reason = f"it redirects to {response.headers['Location']}, which is not followed"
    reason = _line(reason) or response.reason_phrase
    raise BadEndpoint(
        f"{who} refuses ({response.status_code}: {reason}); check {URL}, {MODEL} and {KEY}."
    )


def _line(text: str) -> str:
    return " ".join(text.split())[:200]
