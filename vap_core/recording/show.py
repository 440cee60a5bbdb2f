"""Rerun's viewer: a still picture without a display, a window, a notebook widget."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.experimental import ViewerClient

from vap_core.base.errors import BadOutput, BadRecording, BadStudy, MissingGL, require
from vap_core.base.media import Mp4
from vap_core.base.pictures import RIGHT_MARK, WRONG_MARK, method_marks, on_dark, rgb8
from vap_core.base.types import Rgb
from vap_core.recording.colours import BACKGROUND, image_root
from vap_core.recording.layout import (
    QUERY_NAMES,
    Part,
    attention_view,
    events_view,
    full_window,
    instruction_view,
    track_view,
    verdict_view,
)
from vap_core.recording.read import (
    MOST_HZ,
    prompted_entities,
    read_chunks,
    read_pictures,
    read_summary,
    recording_id,
)
from vap_core.recording.stream import (
    StoredBlueprint,
    finish_stream,
    open_stream,
    rerun_command,
    rerun_environment,
)

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont
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
    check_viewer(window=True, picture=False)
    viewer = _start_viewer()
    viewer.open(str(rrd))
    viewer.set_time("frame_index", sequence=frame_index, play_state="paused")


def has_driver() -> bool:
    """Whether a Vulkan driver is installed that can draw pictures of recordings (Linux)."""
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    if named or sys.platform != "linux":
        return True
    roots = ("/usr/share", "/usr/local/share", "/etc", str(Path.home() / ".local/share"))
    return any(list(Path(root, "vulkan", "icd.d").glob("*.json")) for root in roots)


def check_viewer(*, window: bool, picture: bool) -> None:
    """Check what can be checked at once, before anything is run or loaded to be shown.

    Raises: MissingGL: there is no display for a `window`, or no driver to draw a `picture`.
    """
    if window and not has_display():
        raise MissingGL(
            "view: there is no display for a window; add --png FILE for a picture, or copy the "
            "recording to a machine that has one."
        )
    if picture and not has_driver():
        raise MissingGL(
            "view: there is no Vulkan driver to draw a picture of a recording; install a software "
            f"driver: apt-get install -y {DRIVER}"
        )


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
        except (RuntimeError, OSError):  # on a busy machine it times out, too
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


SIDE_PX = 480
"""Height of a view."""
BAR_PX = 56
"""Height of the line of text above the views, and of the one below."""
HOLD_S, END_S = 1.5, 2.5
"""How long the deciding frame and the last one stand still."""
PAPER, INK, QUIET = (24, 28, 36), (240, 240, 240), (160, 166, 176)


def write_film(recording: Path, mp4: Path) -> int:
    """Write an episode's film, in real time; returns the number of its pictures.

    It stops for a moment at the frame that decided a failure; the verdict stands below the views
    from there on.

    Raises: BadRecording, when the recording cannot be read or has no pictures; BadOutput.
    """
    recording, mp4 = Path(recording), Path(mp4)
    summary = read_summary(recording)
    entities = prompted_entities(recording)
    pictures = read_pictures(recording, set(entities.values()))
    views = {camera: pictures[entity] for camera, entity in entities.items()}
    steps = sorted({step for of_camera in views.values() for step in of_camera})
    if not steps and recording_id(recording).startswith("together."):
        raise BadRecording(
            f"film: {recording} lays several recordings side by side, and a film is of one; name "
            "one of them."
        )
    if not steps:
        raise BadRecording(f"film: {recording} holds no pictures; record the episode again.")
    hz = float(summary.get("hz") or _frame_rate(recording, set(entities.values())))
    if not hz <= MOST_HZ:
        raise BadRecording(
            f"film: {recording} has {hz:.0f} steps a second by its timeline; "
            f"{MOST_HZ} are the most."
        )
    verdict = read_verdict(recording)
    if not verdict and "suite" in summary:
        verdict = str(summary.get("outcome", "unfinished")).upper()
    title = _title(summary) if "instruction" in summary else recording.stem
    deciding = int(summary.get("deciding_frame", -1))
    if deciding < 0:
        deciding = steps[-1]
    shown: dict[str, Rgb] = {}
    n_pictures = 0
    with Mp4(mp4, hz) as film:
        for step in range(steps[0], int(summary["frames"])):
            for camera, of_camera in views.items():
                if step in of_camera:
                    shown[camera] = of_camera[step]
            below = verdict if step >= deciding else ""
            picture = compose(shown, title, below, f"{step / hz:.1f} s")
            repeats = 1
            if step == deciding:
                repeats += round(HOLD_S * hz)
            if step == int(summary["frames"]) - 1:
                repeats += round(END_S * hz)
            for _ in range(repeats):
                film.add(picture)
            n_pictures += repeats
    return n_pictures


def _frame_rate(recording: Path, entities: set[str]) -> float:
    """Frames a second of a recording that does not say, by its timeline; 1 of a single frame."""
    seconds: dict[int, float] = {}
    for chunk in read_chunks(recording):
        if chunk.entity_path not in entities:
            continue
        batch = chunk.to_record_batch()
        if {"frame_index", "timestamp"} <= set(batch.schema.names):
            times = batch["timestamp"].cast("int64").to_pylist()
            seconds |= {
                step: time * 1e-9
                for step, time in zip(batch["frame_index"].to_pylist(), times, strict=True)
            }
    first, last = min(seconds, default=0), max(seconds, default=0)
    if last == first or seconds[last] <= seconds[first]:
        return 1.0
    return (last - first) / (seconds[last] - seconds[first])


def read_verdict(recording: Path) -> str:
    """The heading of a recording's verdict, marked with a tick or a cross; "" without one."""
    for chunk in read_chunks(recording):
        if chunk.entity_path != "/vap/verdict":
            continue
        text = chunk.to_record_batch()["TextDocument:text"][0].as_py()[0]
        line = text.splitlines()[0].removeprefix("## ")
        mark = RIGHT_MARK if line.startswith("SUCCESS") else WRONG_MARK
        return f"{mark} {line}"
    return ""


def compose(views: Mapping[str, Rgb], title: str, verdict: str, time: str) -> Rgb:
    """One picture: the title, every view under its camera's name, the verdict."""
    from PIL import Image, ImageDraw

    scaled = []
    for rgb in views.values():
        h, w = rgb.shape[:2]
        scaled.append(Image.fromarray(rgb).resize((round(SIDE_PX * w / h), SIDE_PX)))
    taken = sum(view.width for view in scaled)
    width = max(taken, 2 * SIDE_PX)
    picture = Image.new("RGB", (width, SIDE_PX + 2 * BAR_PX), PAPER)
    draw = ImageDraw.Draw(picture)
    left = (width - taken) // 2
    for camera, view in zip(views, scaled, strict=True):
        picture.paste(view, (left, BAR_PX))
        draw.text((left + 8, BAR_PX + 6), camera, fill=INK, font=_font(18))
        left += view.width
    _line(draw, title, BAR_PX // 2, width, QUIET)
    _line(draw, verdict, BAR_PX + SIDE_PX + BAR_PX // 2, width - 90, INK)
    foot = (width - 12, BAR_PX + SIDE_PX + BAR_PX // 2)
    draw.text(foot, time, fill=QUIET, font=_font(18), anchor="rm")
    return np.asarray(picture)


def _title(summary: Mapping[str, Any]) -> str:
    rewritten = summary.get("rewritten")
    words = f'"{summary.get("instruction", "")}"'
    if rewritten and rewritten != summary.get("instruction"):
        words += f', read as "{rewritten}"'
    return f"{summary.get('method', '')} · {words}"


def _line(draw: Any, text: str, y: int, width: int, ink: tuple[int, int, int]) -> None:
    """A line of text at the left, as large as fits."""
    for size in (24, 20, 17, 14, 12):
        font = _font(size)
        if draw.textlength(text, font=font) <= width - 24:
            break
    draw.text((12, y), text, fill=ink, font=font, anchor="lm")


def _font(size: int) -> "FreeTypeFont":
    """A font that has the tick and the cross."""
    import matplotlib
    from PIL import ImageFont

    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    return ImageFont.truetype(str(folder / "DejaVuSans.ttf"), size)


SIZE = (1600, 900)
"""Width and height of the window in pixels."""


def attention_screenshot(rrd: Path, png: Path, *, frame_index: int | None = None) -> None:
    """Save a picture of the attention at one step, by default the middle one.

    The true mask of the target is outlined in the picture beside the maps.

    Raises: BadRecording, when `rrd` cannot be read or holds no attention; MissingGL, when nothing
        can draw; BadOutput, when `png` cannot be written.
    """
    rrd = Path(rrd)
    read_summary(rrd)
    queries = attended(rrd)
    if not queries:
        raise BadRecording(
            f"view: {rrd.name} holds no attention; record it with --attention all, or by "
            "./vap measure attention RUN --record SUITE/TASK/METHOD/EPISODE."
        )
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / rrd.name
        stream = open_stream(copy, "attention")
        for chunk in read_chunks(rrd):
            stream.send_chunks(chunk)
        _layout(queries).send(stream)
        finish_stream(stream, copy)
        screenshot(copy, png, frame_index=frame_index, size=SIZE)


def attended(rrd: Path) -> dict[str, tuple[str, ...]]:
    """The queries with an overlay, by camera, in the order of QUERY_NAMES."""
    found: dict[str, set[str]] = {}
    root = image_root("")
    for chunk in read_chunks(rrd):
        camera, middle, query = chunk.entity_path.removeprefix(root).partition("/attention/")
        if chunk.entity_path.startswith(root) and middle:
            found.setdefault(camera, set()).add(query)
    ordered = {}
    for camera, queries in found.items():
        ordered[camera] = tuple(query for query in QUERY_NAMES if query in queries)
    return ordered


def _layout(queries: Mapping[str, Sequence[str]]) -> StoredBlueprint:
    """A row per camera: the picture with track and truth, then every query's map."""
    rows: list[Part] = []
    for camera, names in queries.items():
        maps = [attention_view(camera, query) for query in names]
        rows.append(rrb.Horizontal(track_view(camera, "track, truth"), *maps))
    texts = rrb.Horizontal(instruction_view(), events_view())
    parts: list[Part] = [verdict_view(), rrb.Vertical(*rows), texts]
    return full_window(rrb.Vertical(*parts, row_shares=[0.14, 0.65, 0.21]))


EPISODE_COLUMNS = ("suite", "task", "episode", "seed")
"""What recordings of one episode share."""
GRIPPER = "/vap/hand/gripper_to_target"
"""The curve that is drawn for every method."""


def combine_recordings(recordings: Mapping[str, Path], out: Path) -> None:
    """Copy recordings of one episode into `out`, each below its own name.

    `/vap/...` of "generic" becomes `/generic/vap/...`.

    Raises: BadStudy, when they are not of the same episode; BadRecording, when one cannot be read;
        BadOutput, when `out` exists.
    """
    summaries = {name: read_summary(path) for name, path in recordings.items()}
    suite, task, episode, seed = _common_episode(summaries)
    recording_id = ".".join(["together", suite, task, episode, seed, *recordings])
    rec = open_stream(out, recording_id)
    rec.send_recording_name(" · ".join([suite, task, episode, " against ".join(recordings)]))
    columns = [
        _method_column(name, _copy_below(rec, name, path)) for name, path in recordings.items()
    ]
    fps = next(iter(summaries.values())).get("hz") or 1.0
    parts: list[Part] = [rrb.Horizontal(*columns), _gripper_chart(list(recordings))]
    full_window(rrb.Vertical(*parts, row_shares=[0.72, 0.28]), float(fps)).send(rec)
    finish_stream(rec, out)


def _common_episode(summaries: Mapping[str, dict[str, Any]]) -> list[str]:
    """EPISODE_COLUMNS of all recordings. Raises: BadStudy."""
    episodes = {}
    for name, summary in summaries.items():
        episodes[name] = [str(summary.get(column)) for column in EPISODE_COLUMNS]
    first = next(iter(episodes.values()))
    if list(episodes.values()).count(first) < len(episodes):
        parts = [" ".join([name, *episode]) for name, episode in episodes.items()]
        raise BadStudy(f"together: these are not recordings of one episode: {'; '.join(parts)}.")
    return first


def _copy_below(rec: rr.RecordingStream, name: str, path: Path) -> list[str]:
    """Copy a recording below `/name`; returns the camera entities with prompted pictures."""
    roots = []
    for chunk in read_chunks(path):
        if chunk.entity_path.startswith("/__"):
            continue
        parent, _, entity = chunk.entity_path.rpartition("/")
        image_root = parent.removeprefix("/")
        is_prompted = image_root.startswith("observation.images.") and entity == "prompted"
        if is_prompted and image_root not in roots:
            roots.append(image_root)
        rec.send_chunks(chunk.with_entity_path(f"/{name}{chunk.entity_path.rstrip('/')}"))
    return roots


def _method_column(name: str, image_roots: list[str]) -> rrb.Container:
    """One method: its verdict above its views as the policy saw them."""
    views = [_prompted_view(name, root) for root in image_roots]
    verdict = verdict_view(f"/{name}/vap/verdict", name)
    return rrb.Vertical(verdict, rrb.Horizontal(*views), row_shares=[0.32, 0.68])


def _gripper_chart(names: list[str]) -> rrb.View:
    """Every method's distance from the target in one chart."""
    overrides: Any = {}
    marks = method_marks(names)
    for name in names:
        colour = rgb8(on_dark(marks[name][0]))
        overrides[f"/{name}{GRIPPER}"] = rr.SeriesLines(names=[name], colors=[colour], widths=[2.5])
    return rrb.TimeSeriesView(
        origin="/",
        contents=list(overrides),
        name="distance to yours, cm",
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
        overrides=overrides,
    )


def _prompted_view(name: str, image_root: str) -> rrb.Spatial2DView:
    camera = image_root.removeprefix("observation.images.")
    return rrb.Spatial2DView(
        origin=f"/{name}/{image_root}",
        contents=[f"/{name}/{image_root}/prompted", f"/{name}/{image_root}/identity/**"],
        name=f"{name} · {camera}",
        background=BACKGROUND,
    )
