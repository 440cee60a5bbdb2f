"""A run's recordings as a table in Rerun's viewer: filter it, click a row, see its deciding frame.

    with serve_run(Path("data/runs/demo")) as browser:
        print(browser.url)

The catalog server is on 127.0.0.1 alone and holds nothing but the run's own files.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rerun as rr
import rerun.blueprint as rrb

from vap_core.base.condition import rows_matching
from vap_core.base.errors import BadOutput, BadRecording, first_line
from vap_core.recording.blueprint import full_window
from vap_core.recording.catalog import (
    register_files,
    register_recordings,
    show_progress,
)
from vap_core.recording.corrections import CORRECTIONS, layer_path, read_corrections_of
from vap_core.recording.isolated import read_summaries
from vap_core.recording.query import UNFINISHED
from vap_core.recording.reading import list_recordings, recording_id, recordings_folder
from vap_core.recording.stored_pictures import by_camera
from vap_core.recording.viewer import free_port
from vap_core.recording.views import (
    coverage_view,
    events_view,
    gripper_view,
    instruction_view,
    policy_view,
    verdict_view,
    vote_view,
)

if TYPE_CHECKING:
    import pyarrow as pa
    from rerun.catalog import DatasetEntry

COLUMNS = {
    "link": "open at its frame",
    "outcome": "outcome",
    "case": "case",
    "sub_case": "sub-case",
    "suite": "suite",
    "task": "task",
    "method": "method",
    "episode": "episode",
    "seed": "seed",
    "steps": "steps",
    "deciding_frame": "frame",
    "case_sentence": "why",
    "policy": "policy",
    "file": "file",
}
"""The columns of the table, and their titles."""
NUMBERS = ("episode", "seed", "steps", "deciding_frame")


@dataclass(frozen=True)
class Browser:
    """A running server: the address of its table, its rows, and the files that were left out.

    `n_matching` rows fit the condition; all of them, where there is none.
    """

    url: str
    rows: list[dict[str, Any]]
    unreadable: dict[Path, str]
    n_matching: int


@contextmanager
def serve_run(run: Path, where: str | None = None, port: int | None = None) -> Iterator[Browser]:
    """Serve the recordings of a run until the block ends.

    `where` is a SQL condition on COLUMNS; the viewer shows it as a filter that can be changed.

    Raises: BadRecording, when there is no recording that can be read; BadStudy for a condition
        that does not fit COLUMNS; BadOutput, when the port cannot be served.
    """
    import pandas as pd
    import pyarrow as pa

    folder = recordings_folder(run)
    files = list_recordings(folder)
    unreadable: dict[Path, str] = {}
    summaries: dict[Path, dict[str, Any]] = {}
    for path, summary, reason in show_progress(read_summaries(files), "read", len(files)):
        if summary is None:
            unreadable[path] = reason
        else:
            summaries[path] = summary
    with tempfile.TemporaryDirectory() as scratch, _server(port or free_port()) as server:
        client = server.client()
        dataset = client.create_dataset("recordings")
        register_recordings(dataset, {path: path for path in summaries}, unreadable)
        layers = _correct(summaries, unreadable)
        register_files(dataset, {path: path for path in layers}, unreadable, layer=CORRECTIONS)
        rows = _rows(dataset, summaries, unreadable)
        if not rows:
            raise BadRecording(
                f"query: none of {len(files)} files in {folder} can be read; "
                f"the first: {next(iter(unreadable.values()))}."
            )
        n_matching = len(rows)
        if where is not None:
            n_matching = len(rows_matching(pd.DataFrame(rows), where))
        _register_layout(dataset, Path(scratch))
        table = client.create_table("episodes", _schema())
        table.append(pa.RecordBatch.from_pylist(rows, schema=_schema()))
        blueprint = Path(scratch) / "episodes.rbl"
        _table_layout(where).save("vap", blueprint)
        table.register_blueprint(blueprint.resolve().as_uri())
        yield Browser(f"{client.url}/entry/{table.id}", rows, unreadable, n_matching)


def _correct(summaries: dict[Path, dict[str, Any]], unreadable: dict[Path, str]) -> list[Path]:
    """Put corrected cases in place of the recorded ones; returns the layers that hold them."""
    failures = {}
    for path, summary in summaries.items():
        if path not in unreadable and summary.get("outcome") == "failure":
            failures[path] = path
    corrections = read_corrections_of(failures, unreadable)
    for path, correction in corrections.items():
        summary = summaries[path]
        summary["case"], summary["sub_case"] = correction.case, correction.sub_case
        summary["case_sentence"] = correction.note
    return [layer_path(path) for path in corrections]


@contextmanager
def _server(port: int) -> Iterator[rr.server.Server]:
    try:
        server = rr.server.Server(host="127.0.0.1", port=port)
    except (OSError, RuntimeError, ValueError) as error:
        raise BadOutput(
            f"query: port {port} cannot be served ({first_line(error)}); choose another by --port."
        ) from error
    with server:
        yield server


def _schema() -> "pa.Schema":
    import pyarrow as pa

    fields = []
    for name in COLUMNS:
        fields.append((name, pa.int64() if name in NUMBERS else pa.string()))
    return pa.schema(fields)


def _rows(
    dataset: "DatasetEntry", summaries: dict[Path, dict[str, Any]], unreadable: dict[Path, str]
) -> list[dict[str, Any]]:
    """One row per recording: failures first, then by case and sub-case."""
    rows = []
    for path, summary in summaries.items():
        if path in unreadable:
            continue
        segment = recording_id(path)
        frame = max(0, int(summary.get("deciding_frame", 0)))
        row: dict[str, Any] = {}
        for name in COLUMNS:
            row[name] = summary.get(name, 0 if name in NUMBERS else "")
        row["link"] = dataset.segment_url(segment, "frame_index", frame)
        row["file"] = path.name
        row["outcome"] = row["outcome"] or UNFINISHED
        rows.append(row)
    rows.sort(key=lambda row: (row["outcome"] == "success", row["case"], row["sub_case"]))
    return rows


def _register_layout(dataset: "DatasetEntry", scratch: Path) -> None:
    """Recordings of a catalog open with one layout for all: the verdict, every view, the curves.

    A recording's own layout, with the evidence of its case, opens with its file. This one has every
    camera that any recording has.
    """
    columns: list[rrb.Container | rrb.View] = []
    for camera in by_camera(dataset.schema().entity_paths()):
        pictures = rrb.Horizontal(vote_view(camera, "vote"), policy_view(camera))
        columns.append(rrb.Vertical(coverage_view(camera), pictures, row_shares=[1.6, 1]))
    course = rrb.Horizontal(instruction_view(), gripper_view(), events_view())
    window = rrb.Vertical(
        verdict_view(), rrb.Horizontal(*columns), course, row_shares=[0.11, 0.61, 0.28]
    )
    path = scratch / "recordings.rbl"
    full_window(window).save("vap", path)
    dataset.register_blueprint(path.resolve().as_uri())


def _table_layout(where: str | None) -> rrb.TableBlueprint:
    columns = []
    for name, title in COLUMNS.items():
        columns.append(rrb.table.Column(name, name=title))
    return rrb.TableBlueprint(
        table_layout=rrb.table.TableLayout(columns=columns),
        filters=[where] if where else [],
    )
