"""A recording as a film for a talk: what the policy saw, with the verdict below it."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.errors import BadRecording
from vap_core.base.palette import RIGHT_MARK, WRONG_MARK
from vap_core.base.types import Rgb
from vap_core.base.video import Mp4
from vap_core.recording.reading import MOST_HZ, read_chunks, read_summary, recording_id
from vap_core.recording.stored_pictures import prompted_entities, read_pictures

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont

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
