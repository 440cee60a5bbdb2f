"""Files of a measurement that goes on where it stopped: JSON parts, and the tables they become.

`caller` is the command that an error names.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import BadOutput
from vap_core.base.files import parse_json, read_file, write_atomic, writing
from vap_core.base.parquet import read_arrow

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


def write_json_part(
    path: Path, content: Any, caller: str, default: Callable[[Any], Any] | None = None
) -> None:
    """Keep one finished part; its folder is made. `default` is json's. Raises: BadOutput."""
    with writing(path.parent, caller):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, json.dumps(content, default=default).encode())


def read_json_part(path: Path, caller: str) -> Any:
    """What `write_json_part` kept. Raises: BadOutput for a damaged part."""
    try:
        return parse_json(read_file(path))
    except (OSError, ValueError) as error:
        raise BadOutput(
            f"{caller}: {path} is damaged; delete it and run the same command again."
        ) from error


def write_table(table: "pd.DataFrame", out: Path, name: str) -> list[Path]:
    """The table as Parquet, for programs, and as CSV, for people. Raises: BadOutput."""
    paths = [out / f"{name}.parquet", out / f"{name}.csv"]
    with writing(out, name):
        write_atomic(paths[0], table.to_parquet(index=False, compression="zstd"))
        write_atomic(paths[1], table.round(4).to_csv(index=False).encode())
    return paths


def encode_table(table: "pa.Table") -> bytes:
    """The table as a Parquet file, with its metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    return sink.getvalue().to_pybytes()


def add_rows(
    path: Path,
    table: "pd.DataFrame",
    key: list[str],
    about: dict[bytes, Any],
    replaced: "pd.DataFrame | None" = None,
) -> bytes:
    """The rows of a kept table and of a new one as a Parquet file.

    Kept rows that are equal in `key` to a row of `replaced` (default: of the new table) are left
    out. The metadata hold, under the name in `about`, a list: what they held, and its value unless
    that is there.

    Raises: BadOutput for a damaged table.
    """
    import pandas as pd
    import pyarrow as pa

    ((name, new),) = about.items()
    held: list[Any] = []
    whole = table
    if path.exists():
        kept = read_arrow(path, "publish", "restore it, or delete it and publish again")
        held = parse_json((kept.schema.metadata or {}).get(name, b"[]"))
        old = kept.to_pandas()
        if len(old):  # one without rows may have no columns
            gone = pd.MultiIndex.from_frame((table if replaced is None else replaced)[key])
            old = old[~pd.MultiIndex.from_frame(old[key]).isin(gone)]
        if len(old):
            whole = pd.concat([old, table], ignore_index=True) if len(table) else old
    if new not in held:
        held.append(new)
    arrow = pa.Table.from_pandas(whole, preserve_index=False)
    metadata = {**(arrow.schema.metadata or {}), name: json.dumps(held, sort_keys=True).encode()}
    return encode_table(arrow.replace_schema_metadata(metadata))


def publish_tables(tables: Mapping[str, bytes], to: Path, caller: str) -> list[Path]:
    """Write files by name into a folder, which is made; returns their paths. Raises: BadOutput."""
    with writing(to, caller, "choose another folder with --publish"):
        to.mkdir(parents=True, exist_ok=True)
        for name, data in tables.items():
            write_atomic(to / name, data)
    return [to / name for name in tables]
