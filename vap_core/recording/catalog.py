"""Reads all recordings of a run at once, through Rerun's own catalog server on 127.0.0.1.

    steps = load_steps(Path("data/runs/demo/recordings"))
    rows_matching(steps.table, "margin < 0.05 and success = false")

A file that cannot be read is named in `steps.unreadable`; the rest of the query goes on.
"""

import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlparse

import rerun as rr

from vap_core.base.errors import BadRecording, first_line
from vap_core.recording.corrections import layer_path, read_corrections_of
from vap_core.recording.file import recording_file_name
from vap_core.recording.index import CURVES, FOLDER, STEPS, find_indexes
from vap_core.recording.isolated import index_isolated
from vap_core.recording.layers import Correction
from vap_core.recording.reading import list_recordings, recording_id

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
NAMING = ("suite", "task", "episode", "seed", "method")
"""The properties that a recorder names its file by."""


@dataclass(frozen=True)
class StepTable:
    """One row per step of every recording, and why other files were left out.

    Columns of `table`: `file`, PROPERTY_COLUMNS (as corrected), `corrected`, `frame_index`, CURVES.
    """

    table: "pd.DataFrame"
    unreadable: dict[Path, str]


def load_steps(folder: Path) -> StepTable:
    """Read every recording of a folder, through its index.

    Raises: BadRecording when there is none, or none that can be read, and for corrections without
        rights.
    """
    files = list_recordings(Path(folder))
    unreadable: dict[Path, str] = {}
    with tempfile.TemporaryDirectory() as scratch, rr.server.Server(host="127.0.0.1") as server:
        indexes = _ensure_indexes(files, Path(scratch), unreadable)
        if not indexes:
            raise BadRecording(
                f"query: none of {len(files)} files in {folder} can be read; "
                f"the first: {next(iter(unreadable.values()))}."
            )
        dataset = server.client().create_dataset("recordings")
        register_recordings(dataset, indexes, unreadable)
        properties = _property_table(dataset, _by_file(indexes))
        failed = map(Path, properties["file"][properties["outcome"] == "failure"])
        corrections = read_corrections_of({path: indexes[path] for path in failed}, unreadable)
        table = _join_steps(_corrected(properties, corrections), _curve_table(dataset))
        return StepTable(table, unreadable)


def _can_index(folder: Path) -> bool:
    """Whether indexes can be written beside the recordings of a folder."""
    indexes = folder / FOLDER
    return os.access(indexes if os.path.exists(indexes) else folder, os.W_OK)


def _ensure_indexes(
    files: Sequence[Path], scratch: Path, unreadable: dict[Path, str]
) -> dict[Path, Path]:
    """The index of every recording of one folder that has one, or can get one.

    New ones are in `scratch` where none can be written beside the recordings. Recordings are read
    in a process of their own.
    """
    indexes = find_indexes(files)
    missing = [path for path in files if path not in indexes]
    folder = None if _can_index(files[0].parent) else scratch
    answers = index_isolated(missing, folder)
    for path, reason in show_progress(answers, "index", len(missing)):
        if reason is not None:
            unreadable[path] = reason
    indexes |= find_indexes([path for path in missing if path not in unreadable], folder)
    for path in missing:
        if path not in indexes:
            unreadable.setdefault(path, "its index was removed while it was read")
    return {path: indexes[path] for path in files if path in indexes}


def show_progress[T](answers: Iterable[T], doing: str, total: int) -> Iterable[T]:
    """The same, with a bar that counts recordings where they take longer than 3 seconds."""
    from tqdm import tqdm

    return tqdm(
        answers,
        doing,
        total=total,
        unit="recording",
        leave=False,
        delay=3,
        mininterval=1,
    )


def register_recordings(
    dataset: "DatasetEntry",
    files: Mapping[Path, Path],
    unreadable: dict[Path, str],
) -> None:
    """Register what to read for each recording; of those that hold one episode one alone.

    That is one that has a correction, or else the name that a recorder gives it, or else the first.
    """
    left_out: dict[Path, str] = {}
    register_files(dataset, files, left_out)
    registered = _registered(dataset, _by_file(files)) if left_out else {}
    copies: dict[str, list[Path]] = {}
    for path, reason in left_out.items():
        segment = recording_id(files[path])
        if segment in registered:
            copies.setdefault(segment, []).append(path)
        else:
            unreadable[path] = reason
    for segment, others in copies.items():
        first, name = registered[segment]
        same = [first, *others]
        kept = min(same, key=lambda path: (not os.path.exists(layer_path(path)), path.name != name))
        if kept != first and not _replace(dataset, files[kept]):
            kept = first
        for path in same:
            if path != kept:
                unreadable[path] = (
                    f"it holds the same episode as {kept.name}; move one of them away"
                )


def _replace(dataset: "DatasetEntry", read: Path) -> bool:
    """Register a file in place of the one that has its segment; whether it could be."""
    from rerun.catalog import OnDuplicateSegmentLayer

    url = read.resolve().as_uri()
    try:
        done = dataset.register([url], on_duplicate=OnDuplicateSegmentLayer.REPLACE)
        return not any(result.error for result in done.iter_results())
    except ValueError:
        return False


def _registered(
    dataset: "DatasetEntry", recordings: Mapping[Path, Path]
) -> dict[str, tuple[Path, str]]:
    """The recording of every segment, if it is among `recordings`, and what `_own_name` says."""
    found = {}
    table = _property_table(dataset, recordings).dropna(subset=["file"])
    for row in table.to_dict("records"):
        found[row["segment"]] = (Path(row["file"]), _own_name(row))
    return found


def _own_name(row: Mapping[str, Any]) -> str:
    """The name that a recorder gives a recording, "" where its properties do not say it."""
    import pandas as pd

    suite, task, episode, seed, method = (row[name] for name in NAMING)
    if any(pd.isna(row[name]) for name in NAMING):
        return ""
    return recording_file_name(suite, task, int(episode), int(seed), method)


def _by_file(files: Mapping[Path, Path]) -> dict[Path, Path]:
    """The recording by what is read for it."""
    return {read.resolve(): recording for recording, read in files.items()}


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


def _corrected(
    properties: "pd.DataFrame", corrections: Mapping[Path, Correction]
) -> "pd.DataFrame":
    """Corrections in place of what they correct, marked in the column `corrected`."""
    table = properties.assign(corrected=False)
    for index, file in table["file"].items():
        correction = corrections.get(Path(file))
        if correction is not None:
            cells = {
                "case": correction.case,
                "sub_case": correction.sub_case,
                "case_sentence": correction.note,
                "corrected": True,
            }
            table.loc[index, list(cells)] = list(cells.values())
    return table


def _join_steps(properties: "pd.DataFrame", curves: "pd.DataFrame") -> "pd.DataFrame":
    """Every step beside the properties of its recording."""
    joined = properties.merge(curves, on="segment", how="inner").drop(columns="segment")
    return joined.sort_values(["file", "frame_index"], ignore_index=True)


def _property_table(dataset: "DatasetEntry", recordings: Mapping[Path, Path]) -> "pd.DataFrame":
    """One row per recording; `recordings` has the file by index."""
    import pandas as pd
    import pyarrow as pa

    segments = pa.Table.from_batches(dataset.segment_table().collect())
    table = pd.DataFrame({"segment": segments["rerun_segment_id"].to_pandas()})
    table["file"] = [
        _recording_of(urls, recordings) for urls in segments["rerun_storage_urls"].to_pylist()
    ]
    for group, names in PROPERTY_COLUMNS.items():
        for name in names:
            table[name] = _first_elements(segments, f"property:{group}:{name}")
    return table


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
