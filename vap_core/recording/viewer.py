"""Rerun's viewer: a still picture without a display, a window, a notebook widget."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

import rerun as rr
from rerun.experimental import ViewerClient

from vap_core.base.errors import BadOutput, BadRecording, MissingGL
from vap_core.base.extras import require
from vap_core.recording.file import rerun_command, rerun_environment
from vap_core.recording.reading import read_summary

if TYPE_CHECKING:
    from rerun.notebook import Viewer

DRIVER = "mesa-vulkan-drivers"
"""Debian package of the software Vulkan driver (lavapipe) that draws without a GPU."""
CONNECT_TIMEOUT_S = 40.0
STABLE_TIMEOUT_S = 20.0
"""How long a screenshot may keep changing."""


def rerun_version() -> str:
    """The version of the rerun SDK."""
    return rr.__version__


def screenshot(
    rrd: Path, png: Path, *, frame_index: int | None = None, size: tuple[int, int] = (1600, 1000)
) -> None:
    """Save what the viewer shows of one step, by default the middle one.

    `size` is the window's width and height in pixels.

    Raises: BadRecording, when `rrd` cannot be read; MissingGL, when nothing can draw;
        BadOutput, when `png` cannot be written.
    """
    rrd, png = Path(rrd).resolve(), Path(png)
    frames = read_summary(rrd)["frames"]
    if not frames:
        raise BadRecording(f"screenshot: {rrd} holds no step to show; record the episode again.")
    step = frames // 2 if frame_index is None else frame_index
    if not 0 <= step < frames:
        raise BadRecording(
            f"screenshot: {rrd.name} has no step {step}; choose one of 0 to {frames - 1}."
        )
    with headless_viewer(size) as viewer:
        viewer.open(str(rrd))
        viewer.set_time("frame_index", sequence=step, play_state="paused")
        picture = take_stable_screenshot(viewer)
    try:
        png.parent.mkdir(parents=True, exist_ok=True)
        png.write_bytes(picture)
    except OSError as err:
        raise BadOutput(
            f"screenshot: cannot write {png} ({err.strerror}); choose a folder you may write to."
        ) from err


def open_viewer(rrd: Path, *, frame_index: int = 0) -> None:
    """Open a recording in Rerun's own window at one step; the window stays when this returns.

    Raises: BadRecording, when `rrd` cannot be read; MissingGL, when there is no display or
        nothing can draw.
    """
    rrd = Path(rrd).resolve()
    read_summary(rrd)
    if not has_display():
        raise MissingGL(
            "open_viewer: there is no display; add --png FILE for a picture, "
            f"or copy {rrd} to a machine that has one."
        )
    viewer = _start_viewer()
    viewer.open(str(rrd))
    viewer.set_time("frame_index", sequence=frame_index, play_state="paused")


def has_display() -> bool:
    """Whether a window can be opened here; outside Linux it always can."""
    if sys.platform != "linux":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _start_viewer() -> ViewerClient:
    """Rerun's own window; it outlives this process. Raises: MissingGL."""
    port = free_port()
    process = subprocess.Popen(
        _viewer_command(port),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=rerun_environment(),
        start_new_session=True,
    )
    try:
        return connect_viewer(process, port)
    except (RuntimeError, ConnectionError) as err:
        _end(process)
        raise MissingGL(
            f"open_viewer: the viewer did not come up ({err}); add --png FILE for a picture."
        ) from err


def view(rrd: Path, *, width: int = 1100, height: int = 680) -> "Viewer":
    """The live viewer as a notebook widget, showing a finished recording.

    Its files come from this machine, unless RERUN_NOTEBOOK_ASSET says otherwise. A saved notebook
    keeps no widget: show a `screenshot` beside it.

    Raises: BadRecording, when `rrd` cannot be read; MissingPart.
    """
    require("notebooks", "the viewer in a notebook")
    read_summary(rrd)
    os.environ.setdefault("RERUN_NOTEBOOK_ASSET", "serve-local")  # read when it is imported
    with redirect_stdout(StringIO()):  # rerun announces the port of its asset server
        from rerun.notebook import Viewer

        viewer = Viewer(width=width, height=height, use_global_recording=False)
        viewer._flush_hook(rrd.read_bytes())
    return viewer


@contextmanager
def headless_viewer(size: tuple[int, int]) -> Iterator[ViewerClient]:
    """A viewer without a window, reachable on 127.0.0.1 alone and gone at the end of the block.

    Raises: MissingGL, when no graphics driver can draw.
    """
    port = free_port()
    command = _viewer_command(port, "--headless", "--window-size", f"{size[0]}x{size[1]}")
    environment = {**rerun_environment(), "RUST_LOG": "off"}
    with (
        tempfile.TemporaryFile("w+") as log,
        subprocess.Popen(
            command, stdout=log, stderr=log, env=environment, start_new_session=True
        ) as process,
    ):
        try:
            yield connect_viewer(process, port)
        except (RuntimeError, ConnectionError, TimeoutError) as err:
            log.seek(0)
            output = " ".join(log.read().split())[-200:]
            raise MissingGL(
                f"screenshot: the viewer could not draw ({err}; {output}); "
                f"install a software driver: apt-get install -y {DRIVER}"
            ) from err
        finally:
            _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a viewer: the command is a launcher, and its child is the viewer."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def connect_viewer(process: subprocess.Popen[bytes], port: int) -> ViewerClient:
    """Wait until the viewer answers. Raises: ConnectionError, when it ended or timed out."""
    deadline = time.monotonic() + CONNECT_TIMEOUT_S
    while True:
        if process.poll() is not None:
            raise ConnectionError(f"it ended with status {process.returncode}")
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
            return client
        except (RuntimeError, ConnectionError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)


def take_stable_screenshot(viewer: ViewerClient) -> bytes:
    """A screenshot once it no longer changes: the viewer loads and decodes in the background."""
    deadline = time.monotonic() + STABLE_TIMEOUT_S
    before, now = b"", viewer.take_screenshot()
    while now != before and time.monotonic() < deadline:
        time.sleep(0.7)
        before, now = now, viewer.take_screenshot()
    return now


def free_port() -> int:
    """A TCP port that no process listens on."""
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def _viewer_command(port: int, *options: str) -> list[str]:
    return rerun_command(
        *options,
        "--bind",
        "127.0.0.1",
        "--port",
        str(port),
        "--hide-welcome-screen",
        "--expect-data-soon",
    )
