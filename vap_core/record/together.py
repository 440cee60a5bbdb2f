"""Several methods on the same episode, in one recording with one time line: what one of them saw when the other went wrong."""

from collections.abc import Mapping
from pathlib import Path

import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from vap_core.errors import BadStudy
from vap_core.record.blueprint import BACKGROUND, panels
from vap_core.record.file import Layout, finish_stream, open_stream, read_summary

SAME = ("suite", "task", "episode", "seed")


def together(recordings: Mapping[str, Path], out: Path) -> None:
    """Copy recordings of one episode into `out`, each under its own name: `/vap/...` of "generic" becomes `/generic/vap/...`.

    Raises: BadStudy, when they are not of the same episode; BadRecording, when one cannot be read; BadOutput, when `out` exists.
    """
    about = {name: read_summary(path) for name, path in recordings.items()}
    keys = {name: tuple(summary.get(f"rollout.{part}") for part in SAME) for name, summary in about.items()}
    if len(set(keys.values())) > 1:
        told = "; ".join(f"{name} {' '.join(map(str, key))}" for name, key in keys.items())
        raise BadStudy(f"together: these are not recordings of one episode: {told}.")
    key = next(iter(keys.values()))
    rec = open_stream(out, ".".join(["together", *map(str, key), *recordings]))
    rec.send_recording_name(" · ".join([*map(str, key[:3]), " against ".join(recordings)]))
    cameras: dict[str, list[str]] = {}
    for name, path in recordings.items():
        cameras[name] = []
        for chunk in RrdReader(path).stream():
            if chunk.entity_path.startswith("/__"):
                continue
            parts = chunk.entity_path.split("/")
            if len(parts) == 3 and parts[1].startswith("observation.images.") and parts[2] == "prompted":
                cameras[name] = list(dict.fromkeys([*cameras[name], parts[1]]))
            rec.send_chunks(chunk.with_entity_path(f"/{name}{chunk.entity_path.rstrip('/')}"))
    _blueprint(cameras, float(next(iter(about.values())).get("rollout.hz") or 1.0)).send(rec)
    finish_stream(rec, out)


def _blueprint(cameras: Mapping[str, list[str]], fps: float) -> Layout:
    """A column for each method, the same things at the same height: words, views as the policy got them, the scene, the hand, events."""

    def column(name: str) -> rrb.Container:
        views = [rrb.Spatial2DView(origin=f"/{name}/{root}", contents=[f"/{name}/{root}/prompted"], name=_short(name, root), background=BACKGROUND)
                 for root in cameras[name]]  # fmt: skip
        scene = rrb.Spatial3DView(origin=f"/{name}", contents=[f"/{name}/world/**"], name=f"{name} · scene", background=BACKGROUND,
                                  line_grid=rrb.LineGrid3D(visible=False))  # fmt: skip
        words = rrb.TextDocumentView(origin=f"/{name}/vap/instruction", name=f"{name} · instruction")
        hand = rrb.TimeSeriesView(origin=f"/{name}/vap/hand", name=f"{name} · hand", plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop))
        course = rrb.StateTimelineView(origin=f"/{name}/vap/status", name=f"{name} · course")
        return rrb.Vertical(words, rrb.Horizontal(*views, scene), rrb.Horizontal(hand, course), row_shares=[0.9, 2.2, 1.1])

    return panels(rrb.Horizontal(*(column(name) for name in cameras)), fps)


def _short(name: str, root: str) -> str:
    return f"{name} · {root.removeprefix('observation.images.')}"
