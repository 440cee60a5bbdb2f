"""The four tables of a replay as files: written beside its parts, published, read."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import BadOutput
from vap_core.base.files import code_version, parse_json, read_parquet, write_atomic, writing
from vap_core.study import store

if TYPE_CHECKING:
    import pandas as pd

TABLES = ("episodes", "calls", "layers", "causal")
PREFIX = "attention_"
REPLACED = ["suite", "method"]
"""What a published table holds of a suite and method is replaced whole."""
ABOUT = b"attention"
"""Where the tables keep the runs and the code that they are of."""


def file_name(name: str) -> str:
    return f"{PREFIX}{name}.parquet"


def write(
    folder: Path, rows: Mapping[str, Sequence[Mapping[str, Any]]], runs: Sequence[Any]
) -> None:
    """Write the four tables of a replay of some runs. Raises: BadOutput."""
    import pandas as pd
    import pyarrow as pa

    about = json.dumps([{"runs": list(runs), "code": code_version()}], sort_keys=True).encode()
    for name in TABLES:
        table = pa.Table.from_pandas(_compact(pd.DataFrame(rows[name])), preserve_index=False)
        data = store.encode_table(table.replace_schema_metadata({ABOUT: about}))
        with writing(folder, "attention"):
            write_atomic(folder / file_name(name), data)


def read(folder: Path) -> "dict[str, pd.DataFrame]":
    """The tables that were published in a folder. Raises: BadOutput."""
    tables = {}
    for name in TABLES:
        path = folder / file_name(name)
        if not path.exists():
            raise BadOutput(
                f"attention: {path} is missing; make it: python -m vap_core measure attention RUN "
                f"--publish {folder}"
            )
        tables[name] = read_parquet(path, "attention", "publish it again")
    return tables


def publish(folder: Path, to: Path) -> list[Path]:
    """Keep the tables of a finished replay in another folder.

    What that holds of the suites and methods of these episodes goes, also from a table to which
    the replay adds nothing; what it holds of others stays. Raises: BadOutput.
    """
    import pyarrow.parquet as pq

    found = read(folder)
    files = {}
    for name, table in found.items():
        metadata = pq.read_schema(folder / file_name(name)).metadata or {}
        (about,) = parse_json(metadata[ABOUT])
        files[file_name(name)] = store.add_rows(
            to / file_name(name), table, REPLACED, {ABOUT: about}, replaced=found["episodes"]
        )
    return store.publish_tables(files, to, caller="attention")


def _compact(table: "pd.DataFrame") -> "pd.DataFrame":
    """Four digits of every number, names as categories."""
    for name in table.columns:
        if table[name].dtype == "float64":
            table[name] = table[name].round(4).astype("float32")
        elif table[name].dtype == "int64":
            table[name] = table[name].astype("int32")
        elif table[name].dtype == object and name not in ("layout", "text"):
            table[name] = table[name].astype("category")
    return table
