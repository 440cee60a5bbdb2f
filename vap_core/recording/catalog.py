"""Reads all recordings of a run at once, through Rerun's own catalog server on 127.0.0.1.

    steps = load_steps(Path("data/runs/demo/recordings"))
    rows_matching(steps.table, "margin < 0.05 and success = false")

A file that cannot be read is named in `steps.unreadable`; the rest of the query goes on.
"""

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlparse

import rerun as rr

from vap_core.base.errors import BadRecording, first_line
from vap_core.recording.corrections import CORRECTIONS, corrections_folder
from vap_core.recording.index import CURVES, FOLDER, STEPS, find_indexes
from vap_core.recording.isolated import index_isolated
from vap_core.recording.legacy_names import former_name
from vap_core.recording.reading import recording_id

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    from rerun.catalog import DatasetEntry

PROPERTY_COLUMNS = {
    "rollout": ("suite", "task", "method", "policy", "episode", "seed"),
    "outcome": (
        "outcome",
        "success",
        "success_once",
        "held_steps",
        "cmr",
        "wrong_object",
        "first_object_correct",
        "steps",
        "detail",
        "case",
        "sub_case",
        "deciding_frame",
        "deciding_camera",
        "case_confidence",
        "case_sentence",
    ),
}
"""Columns that every step of a recording shares, by property group; as in results tables."""
CORRECTED_COLUMNS = ("case", "sub_case", "case_sentence")
"""Columns that a correction replaces."""


@dataclass(frozen=True)
class StepTable:
    """One row per step of every recording, and why other files were left out.

    Columns of `table`: `file`, PROPERTY_COLUMNS (as corrected), `corrected`, `frame_index`, CURVES.
    """

    table: "pd.DataFrame"
    unreadable: dict[Path, str]


def load_steps(folder: Path) -> StepTable:
    """Read every recording of a folder, through its index.

    Raises: BadRecording when there is none, or none that can be read.
    """
    files = sorted(Path(folder).glob("*.rrd"))
    if not files:
        raise BadRecording(
            f"query: there is no recording in {folder}; run eval with --record all, or failures."
        )
    unreadable: dict[Path, str] = {}
    with tempfile.TemporaryDirectory() as scratch, rr.server.Server(host="127.0.0.1") as server:
        indexes = ensure_indexes(files, Path(scratch), unreadable)
        if not indexes:
            raise BadRecording(
                f"query: none of {len(files)} files in {folder} can be read; "
                f"the first: {next(iter(unreadable.values()))}."
            )
        dataset = server.client().create_dataset("recordings")
        register_recordings(dataset, indexes, indexes, unreadable)
        layers = sorted(corrections_folder(Path(folder)).glob("*.rrd"))
        register_files(dataset, {path: path for path in layers}, unreadable, layer=CORRECTIONS)
        return StepTable(_join_steps(dataset, _by_file(indexes)), unreadable)


def _can_index(folder: Path) -> bool:
    """Whether indexes can be written beside the recordings of a folder."""
    indexes = folder / FOLDER
    return os.access(indexes if indexes.exists() else folder, os.W_OK)


def ensure_indexes(
    files: Sequence[Path], scratch: Path, unreadable: dict[Path, str]
) -> dict[Path, Path]:
    """The index of every recording of one folder that has one, or can get one.

    New ones are in `scratch` where none can be written beside the recordings. Recordings are read
    in a process of their own.
    """
    from tqdm import tqdm

    folder = None if _can_index(files[0].parent) else scratch
    indexes = find_indexes(files, folder)
    missing = [path for path in files if path not in indexes]
    for path, reason in tqdm(
        index_isolated(missing, folder),
        "index",
        total=len(missing),
        unit="recording",
        leave=False,
        delay=3,
        mininterval=1,
    ):
        if reason is not None:
            unreadable[path] = reason
    indexes |= find_indexes([path for path in missing if path not in unreadable], folder)
    for path in missing:
        if path not in indexes:
            unreadable.setdefault(path, "its index was removed while it was read")
    return {path: indexes[path] for path in files if path in indexes}


def register_recordings(
    dataset: "DatasetEntry",
    files: Mapping[Path, Path],
    indexes: Mapping[Path, Path],
    unreadable: dict[Path, str],
) -> None:
    """Register what to read for each recording; of those that hold one episode the first alone."""
    refused: dict[Path, str] = {}
    register_files(dataset, files, refused)
    first = _files_by_segment(dataset, _by_file(files)) if refused else {}
    for path, reason in refused.items():
        original = first.get(recording_id(indexes[path]))
        if original is not None:
            reason = f"it holds the same episode as {Path(original).name}; move one of them away"
        unreadable[path] = reason


def _by_file(files: Mapping[Path, Path]) -> dict[Path, Path]:
    """The recording by what is read for it."""
    return {read.resolve(): recording for recording, read in files.items()}


def _files_by_segment(
    dataset: "DatasetEntry", recordings: Mapping[Path, Path]
) -> dict[str, str | None]:
    """The recording of every segment; None where its index is not among its files."""
    import pyarrow as pa

    segments = pa.Table.from_batches(dataset.segment_table().collect())
    files = [_recording_of(urls, recordings) for urls in segments["rerun_storage_urls"].to_pylist()]
    return dict(zip(segments["rerun_segment_id"].to_pylist(), files, strict=True))


def register_files(
    dataset: "DatasetEntry",
    files: Mapping[Path, Path],
    unreadable: dict[Path, str],
    layer: str = "base",
) -> None:
    """Register what to read for each file, all at once.

    Where one of them prevents that, each half is registered by itself.
    """
    if not files:
        return
    paths = list(files)
    urls = [files[path].resolve().as_uri() for path in paths]
    try:
        results = list(dataset.register(urls, layer_name=layer).iter_results())
    except ValueError as error:
        if len(paths) == 1:
            unreadable[paths[0]] = first_line(error)[:160]
            return
        middle = len(paths) // 2
        for half in (paths[:middle], paths[middle:]):
            register_files(dataset, {path: files[path] for path in half}, unreadable, layer)
        return
    of_url = dict(zip(urls, paths, strict=True))
    for result in results:  # in the order in which they were finished
        if result.error:
            unreadable[of_url[result.uri]] = str(result.error).strip().splitlines()[-1][:160]


def _join_steps(dataset: "DatasetEntry", recordings: Mapping[Path, Path]) -> "pd.DataFrame":
    """Every step beside the properties of its recording; `recordings` has the file by index."""
    joined = _property_table(dataset, recordings).merge(
        _curve_table(dataset), on="segment", how="inner"
    )
    joined = joined.drop(columns="segment")
    return joined.sort_values(["file", "frame_index"], ignore_index=True)


def _property_table(dataset: "DatasetEntry", recordings: Mapping[Path, Path]) -> "pd.DataFrame":
    """One row per recording; a correction replaces what it corrects."""
    import pandas as pd
    import pyarrow as pa

    segments = pa.Table.from_batches(dataset.segment_table().collect())
    table = pd.DataFrame({"segment": segments["rerun_segment_id"].to_pandas()})
    table["file"] = [
        _recording_of(urls, recordings) for urls in segments["rerun_storage_urls"].to_pylist()
    ]
    for group, names in PROPERTY_COLUMNS.items():
        for name in names:
            table[name] = _property(segments, group, name)
    table["corrected"] = _property(segments, "correction", "case").notna()
    for name in CORRECTED_COLUMNS:
        correction = _property(segments, "correction", name)
        table[name] = correction.where(table["corrected"], table[name])
    # A correction of a recording that is gone, or was made again with another policy, is alone.
    return table[table["file"].notna()]


def _recording_of(urls: Sequence[str], recordings: Mapping[Path, Path]) -> str | None:
    """The recording whose index is among the files of a segment; None where there is none."""
    for url in urls:
        if _url_path(url) in recordings:
            return str(recordings[_url_path(url)])
    return None


def _curve_table(dataset: "DatasetEntry") -> "pd.DataFrame":
    """One row per step and recording."""
    import pandas as pd
    import pyarrow as pa

    reader = dataset.filter_contents([STEPS]).reader(index="frame_index")
    rows = pa.Table.from_batches(reader.collect())
    table = pd.DataFrame(
        {
            "segment": rows["rerun_segment_id"].to_pandas(),
            "frame_index": rows["frame_index"].to_pandas(),
        }
    )
    for name in CURVES:
        table[name] = _first_elements(rows, f"{STEPS}:{name}").astype(float)
    return table


def _property(segments: "pa.Table", group: str, name: str) -> "pd.Series[Any]":
    """A property of every recording, whether written under its current or its former name."""
    column = f"property:{group}:{name}"
    former_column = f"property:{group}:{former_name(group, name)}"
    if former_column not in segments.column_names:
        return _first_elements(segments, column)
    former_values = _first_elements(segments, former_column)
    if column not in segments.column_names:
        return former_values
    values = _first_elements(segments, column)
    return values.where(values.notna(), former_values)


def _first_elements(table: "pa.Table", name: str) -> "pd.Series[Any]":
    """The first element of each list of a column, null where there is none."""
    import pandas as pd
    import pyarrow.compute as pc

    if name not in table.column_names:
        return pd.Series([None] * table.num_rows, dtype=object)
    column = table[name].combine_chunks()
    lists = pc.if_else(pc.greater(pc.list_value_length(column), 0), column, None)
    return pc.list_element(lists, 0).to_pandas()


def _url_path(url: str) -> Path:
    return Path(unquote(urlparse(url).path))
