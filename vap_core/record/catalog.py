"""Asks all recordings of a run at once, through Rerun's own catalog server on 127.0.0.1: a condition in, the steps for which it holds out.

    found = steps(Path("data/runs/demo/recordings"))
    matching(found.table, "margin < 0.05 and success = false")

A file that cannot be read is named in `found.unreadable`; the rest of the query goes on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlparse

import rerun as rr

from vap_core.errors import BadRecording
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
CURVES = {"margin": "/vap/vote_margin/", "track_score": "/vap/track_score/", "gap_cm": "/vap/hand/gripper", "lift_cm": "/vap/hand/target"}
"""Columns of each step, and where their entities begin; of several views the least counts."""


@dataclass(frozen=True)
class Steps:
    """One row per step of every recording in `table`: its `file`, PROPERTIES (corrected where a researcher did), `frame_index` and CURVES."""

    table: "pd.DataFrame"
    unreadable: dict[Path, str]


def steps(folder: Path) -> Steps:
    """Read every recording of a folder. Raises: BadRecording when there is none, or none that can be read."""
    files = sorted(Path(folder).glob("*.rrd"))
    if not files:
        raise BadRecording(f"query: there is no recording in {folder}; run eval with --record all, or failures.")
    unreadable: dict[Path, str] = {}
    with rr.server.Server(host="127.0.0.1") as server:
        dataset = server.client().create_dataset("recordings")
        _register(dataset, files, unreadable)
        if len(unreadable) == len(files):
            raise BadRecording(f"query: none of {len(files)} files in {folder} can be read; the first: {next(iter(unreadable.values()))}.")
        layers = sorted((Path(folder).parent / CORRECTIONS).glob("*.rrd"))
        _register(dataset, layers, unreadable, layer=CORRECTIONS)
        return Steps(_joined(dataset, unreadable), unreadable)


def _register(dataset: "DatasetEntry", files: Sequence[Path], unreadable: dict[Path, str], layer: str = "base") -> None:
    """All at once; where one of them spoils that, each half by itself."""
    if not files:
        return
    try:
        results = list(dataset.register([path.resolve().as_uri() for path in files], layer_name=layer).iter_results())
        unreadable.update({path: _line(result.error) for path, result in zip(files, results, strict=True) if result.error})
    except ValueError as error:
        if len(files) == 1:
            unreadable[files[0]] = _line(error)
            return
        middle = len(files) // 2
        _register(dataset, files[:middle], unreadable, layer)
        _register(dataset, files[middle:], unreadable, layer)


def _line(error: object) -> str:
    return str(error).splitlines()[0][:160]


def _joined(dataset: "DatasetEntry", unreadable: dict[Path, str]) -> "pd.DataFrame":
    import pandas as pd
    import pyarrow as pa

    whole = pa.Table.from_batches(dataset.segment_table().collect())
    about = pd.DataFrame({"segment": whole["rerun_segment_id"].to_pandas()})
    about["file"] = [_path(urls[0]) for urls in whole["rerun_storage_urls"].to_pylist()]
    for name, group in PROPERTIES.items():
        about[name] = _first(whole, f"property:{group}:{name}")
    fixed = {name: _first(whole, f"property:correction:{name}") for name in ("failure_case", "sub_case", "why")}
    about["corrected"] = fixed["failure_case"].notna()
    for name, column in fixed.items():
        about[name] = column.where(about["corrected"], about[name])
    foreign = about["suite"].isna()
    unreadable.update({Path(file): "no recording of an episode" for file in about.loc[foreign, "file"]})
    content = ["/vap/vote_margin/**", "/vap/track_score/**", "/vap/hand/**", "/action"]
    rows = pa.Table.from_batches(dataset.filter_contents(content).reader(index="frame_index").collect())
    table = pd.DataFrame({"segment": rows["rerun_segment_id"].to_pandas(), "frame_index": rows["frame_index"].to_pandas()})
    for name, prefix in CURVES.items():
        held = [_first(rows, column) for column in rows.column_names if column.startswith(prefix) and column.endswith(":Scalars:scalars")]
        table[name] = pd.concat(held, axis=1).astype(float).min(axis=1) if held else float("nan")
    joined = about[~foreign].merge(table, on="segment", how="inner").drop(columns="segment")
    return joined.sort_values(["file", "frame_index"], ignore_index=True)


def _first(table: "pa.Table", name: str) -> "pd.Series[Any]":
    """The first element of each list of a column, null where there is none."""
    import pandas as pd
    import pyarrow.compute as pc

    if name not in table.column_names:
        return pd.Series([None] * table.num_rows, dtype=object)
    column = table[name].combine_chunks()
    return pc.list_element(pc.if_else(pc.greater(pc.list_value_length(column), 0), column, None), 0).to_pandas()


def _path(url: str) -> str:
    return unquote(urlparse(url).path)
