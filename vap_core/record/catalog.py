"""Asks all recordings of a run at once, through Rerun's own catalog server on 127.0.0.1: a condition in, the steps for which it holds out.

    found = steps(Path("data/runs/demo/recordings"))
    matching(found.table, "margin < 0.05 and success = false")

A file that cannot be read is named in `found.unreadable`; the rest of the query goes on.
"""

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlparse

import rerun as rr

from vap_core.errors import BadRecording
from vap_core.record.index import CURVES, STEPS, index
from vap_core.record.layers import CORRECTIONS

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    from rerun.catalog import DatasetEntry

PROPERTIES = {
    "suite": "rollout", "task": "rollout", "method": "rollout", "episode": "rollout", "seed": "rollout", "status": "outcome", "success": "outcome",
    "wrong_object": "outcome", "length": "outcome", "failure_case": "outcome", "sub_case": "outcome", "deciding_frame": "outcome",
    "confidence": "outcome", "why": "outcome",
}  # fmt: skip
"""Columns that every step of a recording shares, and the property group each comes from."""


@dataclass(frozen=True)
class Steps:
    """One row per step of every recording in `table`: its `file`, PROPERTIES (corrected where a researcher did), `frame_index` and CURVES."""

    table: "pd.DataFrame"
    unreadable: dict[Path, str]


def steps(folder: Path) -> Steps:
    """Read every recording of a folder, through its index. Raises: BadRecording when there is none, or none that can be read."""
    files = sorted(Path(folder).glob("*.rrd"))
    if not files:
        raise BadRecording(f"query: there is no recording in {folder}; run eval with --record all, or failures.")
    unreadable: dict[Path, str] = {}
    with tempfile.TemporaryDirectory() as elsewhere, rr.server.Server(host="127.0.0.1") as server:
        indexes = _indexed(files, None if os.access(folder, os.W_OK) else Path(elsewhere), unreadable)
        if not indexes:
            raise BadRecording(f"query: none of {len(files)} files in {folder} can be read; the first: {next(iter(unreadable.values()))}.")
        dataset = server.client().create_dataset("recordings")
        _register(dataset, indexes, unreadable)
        layers = {path: path for path in sorted((Path(folder).parent / CORRECTIONS).glob("*.rrd"))}
        _register(dataset, layers, unreadable, layer=CORRECTIONS)
        return Steps(_joined(dataset, {at.resolve(): file for file, at in indexes.items()}), unreadable)


def _indexed(files: Sequence[Path], folder: Path | None, unreadable: dict[Path, str]) -> dict[Path, Path]:
    """The index of every recording that has one, or can get one."""
    from tqdm import tqdm

    found = {}
    for path in tqdm(files, "index", unit="recording", leave=False, delay=3, mininterval=1):
        try:
            found[path] = index(path, folder)
        except BadRecording as error:
            unreadable[path] = str(error)
    return found


def _register(dataset: "DatasetEntry", files: Mapping[Path, Path], unreadable: dict[Path, str], layer: str = "base") -> None:
    """What to read for each file, all at once; where one of them spoils that, each half by itself."""
    if not files:
        return
    named = list(files)
    try:
        results = list(dataset.register([files[path].resolve().as_uri() for path in named], layer_name=layer).iter_results())
        unreadable.update({path: _line(result.error) for path, result in zip(named, results, strict=True) if result.error})
    except ValueError as error:
        if len(named) == 1:
            unreadable[named[0]] = _line(error)
            return
        middle = len(named) // 2
        for half in (named[:middle], named[middle:]):
            _register(dataset, {path: files[path] for path in half}, unreadable, layer)


def _line(error: object) -> str:
    return str(error).splitlines()[0][:160]


def _joined(dataset: "DatasetEntry", recordings: Mapping[Path, Path]) -> "pd.DataFrame":
    """Every step beside what its recording tells of itself; `recordings` are those whose index is read."""
    import pandas as pd
    import pyarrow as pa

    whole = pa.Table.from_batches(dataset.segment_table().collect())
    about = pd.DataFrame({"segment": whole["rerun_segment_id"].to_pandas()})
    about["file"] = [str(recordings[_path(urls[0])]) for urls in whole["rerun_storage_urls"].to_pylist()]
    for name, group in PROPERTIES.items():
        about[name] = _first(whole, f"property:{group}:{name}")
    fixed = {name: _first(whole, f"property:correction:{name}") for name in ("failure_case", "sub_case", "why")}
    about["corrected"] = fixed["failure_case"].notna()
    for name, column in fixed.items():
        about[name] = column.where(about["corrected"], about[name])
    rows = pa.Table.from_batches(dataset.filter_contents([STEPS]).reader(index="frame_index").collect())
    table = pd.DataFrame({"segment": rows["rerun_segment_id"].to_pandas(), "frame_index": rows["frame_index"].to_pandas()})
    for name in CURVES:
        table[name] = _first(rows, f"{STEPS}:{name}").astype(float)
    joined = about.merge(table, on="segment", how="inner").drop(columns="segment")
    return joined.sort_values(["file", "frame_index"], ignore_index=True)


def _first(table: "pa.Table", name: str) -> "pd.Series[Any]":
    """The first element of each list of a column, null where there is none."""
    import pandas as pd
    import pyarrow.compute as pc

    if name not in table.column_names:
        return pd.Series([None] * table.num_rows, dtype=object)
    column = table[name].combine_chunks()
    return pc.list_element(pc.if_else(pc.greater(pc.list_value_length(column), 0), column, None), 0).to_pandas()


def _path(url: str) -> Path:
    return Path(unquote(urlparse(url).path))
