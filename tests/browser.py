"""A real Chromium without a window, driven through the W3C WebDriver protocol.

Debian's `chromium` and `chromium-driver` are needed, and nothing of Python's beyond httpx. No page
reaches further than this machine: other names do not resolve.
"""

import base64
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx

MISSING = (
    "no Chromium here; run: apt-get install -y --no-install-recommends chromium chromium-driver"
)
"""Why a test that needs a browser is skipped."""
SIZE = (1920, 1080)
DOWNLOADS = "downloads"
"""The folder in a browser's scratch folder that takes what is downloaded."""
ELEMENT = "element-6066-11e4-a52e-4f735466cecf"
"""The key of an element's id, fixed by the protocol."""
ARGUMENTS = [
    "--headless=new",
    f"--window-size={SIZE[0]},{SIZE[1]}",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
    "--enable-unsafe-swiftshader",
    "--use-angle=swiftshader",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE localhost, EXCLUDE 127.0.0.1",
]


def available() -> bool:
    """Whether a Chromium and its driver are installed."""
    return bool(shutil.which("chromium") and shutil.which("chromedriver"))


class Page:
    """One tab of the browser."""

    def __init__(self, session: str) -> None:
        self._session = session

    def open(self, url: str) -> None:
        """Load an address."""
        self._call("POST", "/url", {"url": url})

    def resize(self, width: int, height: int) -> None:
        """Make the page itself that large, without the window's frame."""
        frame = self.script(
            "return [window.outerWidth - window.innerWidth, window.outerHeight - window.innerHeight]"
        )
        size = {"width": width + frame[0], "height": height + frame[1]}
        self._call("POST", "/window/rect", size)

    def script(self, code: str, *arguments: Any) -> Any:
        """What a function body of JavaScript returns; it reads `arguments`."""
        return self._call("POST", "/execute/sync", {"script": code, "args": list(arguments)})

    def find(self, css: str) -> list[str]:
        """The elements that match, in the page's order."""
        found = self._call("POST", "/elements", {"using": "css selector", "value": css})
        return [each[ELEMENT] for each in found]

    def click(self, element: str) -> None:
        """Click an element as a person does: it must be in view and uncovered."""
        self._call("POST", f"/element/{element}/click", {})

    def type(self, element: str, text: str) -> None:
        """Type into an element; \\ue00X are the protocol's keys."""
        self._call("POST", f"/element/{element}/value", {"text": text})

    def press(self, *keys: str) -> None:
        """Hold the keys down one after the other, then let go."""
        actions = [{"type": "keyDown", "value": key} for key in keys]
        actions += [{"type": "keyUp", "value": key} for key in reversed(keys)]
        source = {"type": "key", "id": "keyboard", "actions": actions}
        self._call("POST", "/actions", {"actions": [source]})

    def text(self) -> str:
        """The words that the page shows."""
        return str(self.script("return document.body.innerText"))

    def screenshot(self, element: str | None = None) -> bytes:
        """What the window, or one element, shows, as a PNG."""
        part = "" if element is None else f"/element/{element}"
        return base64.b64decode(self._call("GET", f"{part}/screenshot"))

    def wait(self, condition: Callable[[], Any], what: str, limit_s: float = 60.0) -> Any:
        """Ask again until the condition holds, and return what it gave."""
        deadline = time.monotonic() + limit_s
        while True:
            found = condition()
            if found:
                return found
            assert time.monotonic() < deadline, f"{what} did not come within {limit_s:g} s"
            time.sleep(0.3)

    def errors(self) -> list[str]:
        """What the page has written to the console as an error since it was asked last."""
        logged = self._call("POST", "/se/log", {"type": "browser"})
        return [each["message"] for each in logged if each["level"] == "SEVERE"]

    def close(self) -> None:
        """End the browser."""
        self._call("DELETE", "")

    def _call(self, verb: str, path: str, body: dict[str, Any] | None = None) -> Any:
        reply = httpx.request(verb, f"{self._session}{path}", json=body, timeout=120)
        value = reply.json()["value"]
        assert reply.status_code == 200, value
        return value


@contextmanager
def browser(scratch: Path) -> Iterator[Page]:
    """A Chromium that is gone at the end of the block; `scratch` holds its profile."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {**os.environ, "HOME": str(scratch)}
    with subprocess.Popen(
        ["chromedriver", f"--port={port}"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment,
    ) as driver:
        try:
            page = Page(_session(f"http://127.0.0.1:{port}", scratch / "profile"))
            page.resize(*SIZE)
            try:
                yield page
            finally:
                page.close()
        finally:
            driver.terminate()


def _session(address: str, profile: Path) -> str:
    """Start the browser; returns the address of its session."""
    deadline = time.monotonic() + 30
    while True:
        try:
            httpx.get(f"{address}/status", timeout=5)
            break
        except httpx.HTTPError:
            assert time.monotonic() < deadline, "chromedriver does not answer"
            time.sleep(0.1)
    arguments = [*ARGUMENTS, f"--user-data-dir={profile}"]
    if os.geteuid() == 0:
        arguments.append("--no-sandbox")
    wanted = {
        "browserName": "chrome",
        "goog:chromeOptions": {
            "args": arguments,
            "binary": shutil.which("chromium"),
            "prefs": {"download.default_directory": str(profile.parent / DOWNLOADS)},
        },
        "goog:loggingPrefs": {"browser": "ALL"},
    }
    reply = httpx.post(
        f"{address}/session", json={"capabilities": {"alwaysMatch": wanted}}, timeout=120
    )
    value = reply.json()["value"]
    assert "sessionId" in value, value
    return f"{address}/session/{value['sessionId']}"
