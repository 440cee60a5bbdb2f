"""Keep the results of finished runs as one small table, with their configurations."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core import suites
from vap_core.errors import BadOutput
from vap_core.files import write_atomic
from vap_core.store import KEY, note, read

if TYPE_CHECKING:
    import pandas as pd


def published(table: Path) -> "list[tuple[dict[str, Any], pd.DataFrame]]":
    """Every run in a table that `publish` wrote: its run.json, and its episodes. Raises: BadOutput when it is none of them."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        held = pq.read_table(table)
        notes = json.loads((held.schema.metadata or {})[b"runs"])
        whole = held.to_pandas()
        return [(note, whole[whole["configuration"] == note["digest"]].drop(columns="configuration")) for note in notes]
    except (OSError, pa.ArrowInvalid, KeyError, ValueError) as error:
        raise BadOutput(f"published: {table} is no table of finished runs ({type(error).__name__}); publish writes one.") from error


def runs(place: Path) -> "list[tuple[dict[str, Any], pd.DataFrame]]":
    """The run of a folder, or every run in a published table: its run.json, and its episodes. Raises: BadOutput."""
    return published(place) if place.suffix == ".parquet" else [(note(place), read(place))]


def publish(folders: Sequence[Path], target: Path, *, replace: bool = False) -> int:
    """Write every episode of the runs, with each run's configuration in the file's metadata; returns the number of episodes.

    A folder may be a table that `publish` wrote, too: its runs are taken as they are. Tracebacks, wall times and memory stay behind.
    Raises: BadOutput for a folder that holds no run or an unfinished one, for two runs of the same episodes, or a target that is no new
    parquet file.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if target.suffix != ".parquet" or target.is_dir():
        raise BadOutput(f"publish: {target} is no name of a table; end it with .parquet.")
    if target.exists() and not replace:
        raise BadOutput(f"publish: {target} exists; choose another name with --to, or pass --replace.")
    tables, notes = [], []
    for folder, about, table in ((place, *run) for place in folders for run in runs(place)):
        study = about["configuration"]
        wanted = len(study["methods"]) * sum(
            len(suites.listed(suite, task, study["episodes"], study["seed"], study["seeds"])) for suite, task in study["tasks"]
        )
        if len(table) < wanted:
            raise BadOutput(f"publish: {folder} holds {len(table)} of {wanted} episodes; run the same command again to finish it.")
        columns = [name for name in table.columns if name not in ("detail", "peak_mb") and not name.startswith("seconds_")]
        tables.append(pa.Table.from_pandas(table[columns].assign(configuration=about["digest"]), preserve_index=False))
        notes.append(about)
    whole = pa.concat_tables(tables, promote_options="permissive")
    keys = whole.select([*KEY, "policy"]).to_pandas()
    if keys.duplicated().any():
        raise BadOutput(f"publish: two of {', '.join(map(str, folders))} hold the same episodes; name each run once.")
    metadata = {**(whole.schema.metadata or {}), b"runs": json.dumps(notes, sort_keys=True).encode()}
    sink = pa.BufferOutputStream()
    pq.write_table(whole.replace_schema_metadata(metadata), sink, compression="zstd")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(target, sink.getvalue().to_pybytes())
    except OSError as error:
        raise BadOutput(f"publish: {target} cannot be written ({error.strerror}); choose another place with --to.") from error
    return whole.num_rows
