"""A server on this machine that speaks OpenAI's chat protocol, with answers given beforehand."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from tests.local_server import running


class Model(BaseHTTPRequestHandler):
    """Answers from the server's `answers`, in turn, and keeps what it was asked."""

    def do_POST(self) -> None:
        server: Any = self.server
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        server.asked.append((self.path, self.headers.get("Authorization"), body))
        status, said, *headers = server.answers.pop(0)
        data = said if isinstance(said, bytes) else json.dumps(said).encode()
        self.send_response(status)
        for name, text in headers:
            self.send_header(name, text)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *args: Any) -> None:
        pass


def says(text: Any, **message: Any) -> tuple[int, Any]:
    """What the server answers where the model says `text`."""
    said = {"role": "assistant", "content": text} | message
    return 200, {"choices": [{"index": 0, "finish_reason": "stop", "message": said}]}


@contextmanager
def serving(*answers: Any) -> Iterator[Any]:
    """The server; its `url`, and what it was `asked`."""
    with ThreadingHTTPServer(("127.0.0.1", 0), Model) as server:
        server.answers, server.asked = list(answers), []  # type: ignore[attr-defined]
        server.url = f"http://127.0.0.1:{server.server_address[1]}/v1"  # type: ignore[attr-defined]
        with running(server):
            yield server
