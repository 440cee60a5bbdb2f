"""Several methods on the same episode, in one recording with one timeline."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from vap_core.base.errors import BadStudy
from vap_core.base.palette import method_marks, on_dark, rgb8
from vap_core.recording.blueprint import full_window
from vap_core.recording.colours import BACKGROUND
from vap_core.recording.reading import read_chunks, read_summary
from vap_core.recording.stream import finish_stream, open_stream
from vap_core.recording.views import verdict_view

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
    rows: list[rrb.Container | rrb.View] = []
    for name, path in recordings.items():
        rows.append(_method_row(name, _copy_below(rec, name, path)))
    fps = next(iter(summaries.values())).get("hz") or 1.0
    shares = [*[1.0] * len(rows), 0.62]
    rows.append(_gripper_chart(list(recordings)))
    full_window(rrb.Vertical(*rows, row_shares=shares), float(fps)).send(rec)
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


def _method_row(name: str, image_roots: list[str]) -> rrb.Container:
    """One method: its verdict above, its views as the policy saw them, and the scene."""
    views: list[rrb.View] = [_prompted_view(name, root) for root in image_roots]
    scene = rrb.Spatial3DView(
        origin=f"/{name}",
        contents=[f"/{name}/world/**"],
        name=f"{name} · scene",
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
    )
    return rrb.Vertical(
        verdict_view(f"/{name}/vap/verdict", name),
        rrb.Horizontal(*views, scene),
        row_shares=[0.29, 0.71],
    )


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
        name="gripper to target, cm",
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
        overrides=overrides,
    )


def _prompted_view(name: str, image_root: str) -> rrb.Spatial2DView:
    camera = image_root.removeprefix("observation.images.")
    return rrb.Spatial2DView(
        origin=f"/{name}/{image_root}",
        contents=[f"/{name}/{image_root}/prompted"],
        name=f"{name} · {camera}",
        background=BACKGROUND,
    )
