"""A still picture of a recording, drawn by rerun's own viewer without a display."""

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

from rerun.experimental import ViewerClient

from vap_core.errors import BadOutput, BadRecording, MissingGL
from vap_core.record.file import read_summary, rerun_cli

if TYPE_CHECKING:
    from rerun.notebook import Viewer

DRIVER = "mesa-vulkan-drivers"
"""Debian package of the software Vulkan driver (lavapipe) that draws without a GPU."""


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


@contextmanager
def headless_viewer(size: tuple[int, int], timeout_s: float = 40.0) -> Iterator[ViewerClient]:
    """A viewer without a window, reachable on 127.0.0.1 alone and gone at the end of the block.

    Raises: MissingGL, when no graphics driver can draw.
    """
    port = free_port()
    window = f"{size[0]}x{size[1]}"
    command = rerun_cli(
        "--headless", "--window-size", window, "--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen", "--expect-data-soon"
    )
    with (
        tempfile.TemporaryFile("w+") as log,
        subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, "RUST_LOG": "off"}, start_new_session=True) as process,
    ):
        try:
            yield connect(process, port, timeout_s)
        except (RuntimeError, ConnectionError, TimeoutError) as err:
            log.seek(0)
            said = " ".join(log.read().split())[-200:]
            raise MissingGL(f"screenshot: the viewer could not draw ({err}; {said}); install a software driver: apt-get install -y {DRIVER}") from err
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # the command is a launcher: its child is the viewer


def connect(process: subprocess.Popen[bytes], port: int, timeout_s: float) -> ViewerClient:
    """Wait until the viewer answers."""
    end = time.monotonic() + timeout_s
    while True:
        if process.poll() is not None:
            raise ConnectionError(f"it ended with status {process.returncode}")
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
            return client
        except (RuntimeError, ConnectionError):
            if time.monotonic() > end:
                raise
            time.sleep(0.2)


def screenshot(rrd: Path, png: Path, *, frame_index: int | None = None, size: tuple[int, int] = (1600, 1000)) -> None:
    """Open a recording at one step, by default its middle one, and save what a researcher would see, `size` pixels wide and high.

    Raises: BadRecording, when `rrd` cannot be read; MissingGL, when nothing can draw; BadOutput, when `png` cannot be written.
    """
    rrd, png = Path(rrd).resolve(), Path(png)
    frames = read_summary(rrd)["frames"]
    if not frames:
        raise BadRecording(f"screenshot: {rrd} holds no step to show; record the episode again.")
    step = frames // 2 if frame_index is None else frame_index
    if not 0 <= step < frames:
        raise BadRecording(f"screenshot: {rrd.name} has no step {step}; choose one of 0 to {frames - 1}.")
    with headless_viewer(size) as viewer:
        viewer.open(str(rrd))
        viewer.set_time("frame_index", sequence=step, play_state="paused")
        picture = settled(viewer)
    try:
        png.parent.mkdir(parents=True, exist_ok=True)
        png.write_bytes(picture)
    except OSError as err:
        raise BadOutput(f"screenshot: cannot write {png} ({err.strerror}); choose a folder you may write to.") from err


def open_viewer(rrd: Path, *, frame_index: int = 0) -> None:
    """Open a recording in Rerun's own window at one step; the window stays when this returns.

    Raises: BadRecording, when `rrd` cannot be read; MissingGL, when there is no display or nothing can draw.
    """
    rrd = Path(rrd).resolve()
    read_summary(rrd)
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise MissingGL(f"open_viewer: there is no display; add --png FILE for a picture, or copy {rrd} to a machine that has one.")
    port = free_port()
    command = rerun_cli("--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen", "--expect-data-soon")
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        viewer = connect(process, port, 40.0)
    except (RuntimeError, ConnectionError) as err:
        raise MissingGL(f"open_viewer: the viewer did not come up ({err}); add --png FILE for a picture.") from err
    viewer.open(str(rrd))
    viewer.set_time("frame_index", sequence=frame_index, play_state="paused")


def settled(viewer: ViewerClient, patience_s: float = 20.0) -> bytes:
    """The viewer loads and decodes in the background: its picture is done when it no longer changes."""
    end = time.monotonic() + patience_s
    before, now = b"", viewer.take_screenshot()
    while now != before and time.monotonic() < end:
        time.sleep(0.7)
        before, now = now, viewer.take_screenshot()
    return now


def view(rrd: Path, *, width: int = 1100, height: int = 680) -> "Viewer":
    """The live viewer as a notebook widget, showing a finished recording; offline with RERUN_NOTEBOOK_ASSET=serve-local.

    A saved notebook keeps no widget: show a `screenshot` beside it. Raises: BadRecording, when `rrd` cannot be read.
    """
    read_summary(rrd)
    with redirect_stdout(StringIO()):  # rerun announces the port of its asset server
        from rerun.notebook import Viewer

        viewer = Viewer(width=width, height=height, use_global_recording=False)
        viewer._flush_hook(rrd.read_bytes())
    return viewer
