"""A question to a model that speaks OpenAI's chat protocol: words and pictures out, words back. What comes back is parsed, never executed.

Any server does: OpenAI's own, or llama.cpp, vLLM or Ollama on this machine.
"""

import base64
import json
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from http.client import HTTPException
from typing import Any
from urllib import request
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit

from vap_core.errors import BadEndpoint
from vap_core.values import Rgb

URL, MODEL, KEY = "OPENAI_BASE_URL", "OPENAI_MODEL", "OPENAI_API_KEY"
"""Environment variables that `endpoint` reads."""
MOST_BYTES = 4_000_000
"""Of an answer."""


@dataclass(frozen=True)
class Chat:
    """Where to ask: `url` as OpenAI's clients take it, for example https://api.openai.com/v1, and the model there."""

    url: str
    model: str
    key: str = field(default="", repr=False)
    timeout_s: float = 60.0

    def __post_init__(self) -> None:
        try:
            parts = urlsplit(self.url)
            known = parts.scheme in ("http", "https") and bool(parts.hostname)
        except ValueError:
            known = False
        if not known:
            raise BadEndpoint(f"chat: {self.url!r} is no address of a chat endpoint; give one like https://api.openai.com/v1.")
        if not self.model:
            raise BadEndpoint(f"chat: no model named for {self.url}; set {MODEL}.")
        if not self.key.isascii() or not (self.key.isprintable() or not self.key):
            raise BadEndpoint(f"chat: the key for {self.url} holds a line break or another character that no key has; set {KEY} again.")


def endpoint(url: str = "", timeout_s: float = 60.0) -> Chat:
    """The endpoint at `url`, or at OPENAI_BASE_URL; model and key from OPENAI_MODEL and OPENAI_API_KEY. Raises: BadEndpoint."""
    return Chat(url or os.environ.get(URL, ""), os.environ.get(MODEL, ""), os.environ.get(KEY, "").strip(), timeout_s)


def ask(chat: Chat, question: str, pictures: Sequence[Rgb] = ()) -> str:
    """The model's answer to one question about some pictures.

    Raises: BadEndpoint: it cannot be reached, takes too long, refuses, or answers anything but the protocol.
    """
    content = [{"type": "text", "text": question}, *({"type": "image_url", "image_url": {"url": data_url(rgb)}} for rgb in pictures)]
    body = {"model": chat.model, "messages": [{"role": "user", "content": content}]}
    headers = {"Content-Type": "application/json", **({"Authorization": f"Bearer {chat.key}"} if chat.key else {})}
    asking = request.Request(f"{chat.url.rstrip('/')}/chat/completions", json.dumps(body).encode(), headers, method="POST")
    try:
        with request.build_opener(_Stay).open(asking, timeout=chat.timeout_s) as answer:
            told = answer.read(MOST_BYTES)
    except HTTPError as error:
        with error:
            raise BadEndpoint(f"chat: {chat.url} refuses ({error.code}: {_reason(error)}); check {URL}, {MODEL} and {KEY}.") from error
    except (URLError, HTTPException, OSError) as error:
        why = error.reason if isinstance(error, URLError) else error
        raise BadEndpoint(f"chat: {chat.url} gives no answer ({str(why) or type(why).__name__}); is the server up, and {URL} right?") from error
    try:
        text = json.loads(told)["choices"][0]["message"]["content"]
        if not isinstance(text, str) or not text.strip():
            raise ValueError("no text")
    except (ValueError, KeyError, IndexError, TypeError, RecursionError) as error:
        raise BadEndpoint(
            f"chat: {chat.url} does not answer as a chat endpoint does ({type(error).__name__}); give the address that ends in /v1, and a model "
            f"that sees pictures in {MODEL}."
        ) from error
    return text


def data_url(rgb: Rgb) -> str:
    """The picture itself as an address, PNG."""
    import cv2

    return "data:image/png;base64," + base64.b64encode(cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes()).decode()


def _reason(error: HTTPError) -> str:
    """The first line of what the server says, in the protocol's form or plainly."""
    said = ""
    with suppress(OSError, HTTPException, ValueError, KeyError, TypeError, RecursionError):
        said = error.read(2000).decode(errors="replace")
        said = str(json.loads(said)["error"]["message"])
    return " ".join(said.split())[:200] or error.reason


class _Stay(request.HTTPRedirectHandler):
    """Goes nowhere else: a redirected request would carry key and pictures along."""

    def redirect_request(self, req: request.Request, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> None:
        return None
