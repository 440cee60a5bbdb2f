"""A still picture of a recording's attention: every view and query side by side.

`screenshot` shows a recording as it opens, with the attention behind a tab.
"""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import rerun.blueprint as rrb

from vap_core.base.errors import BadRecording
from vap_core.recording.blueprint import full_window
from vap_core.recording.entities.paths import image_root
from vap_core.recording.reading import read_chunks, read_summary
from vap_core.recording.stream import StoredBlueprint, finish_stream, open_stream
from vap_core.recording.viewer import screenshot
from vap_core.recording.views import (
    QUERY_NAMES,
    Part,
    attention_view,
    events_view,
    instruction_view,
    track_view,
    verdict_view,
)

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
            "python -m vap_core measure attention RUN --record SUITE/TASK/METHOD/EPISODE."
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
