"""Append-only results: parquet parts written atomically, one run per folder, only what is missing runs again."""

import fcntl
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from vap_core.errors import BadOutput
from vap_core.files import write_atomic

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

KEY = ["suite", "task", "method", "seed", "episode"]
"""Names an episode of a run; the table is in this order."""


def digest(configuration: Mapping[str, Any]) -> str:
    """A short hash of whatever JSON can say; equal configurations, equal digests."""
    return hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()[:16]


def open_run(folder: Path, configuration: Mapping[str, Any]) -> Path:
    """Begin a run in `folder`, or go on with the one that is there.

    Raises:
        BadOutput: the folder cannot be written, holds something else, or a run of another configuration.
    """
    path = folder / "run.json"
    wanted = json.dumps({"digest": digest(configuration), "configuration": dict(configuration)}, indent=1, sort_keys=True)
    if folder.exists() and not folder.is_dir():
        raise BadOutput(f"open_run: {folder} is a file; choose another folder with --out.")
    if path.exists():
        held = note(folder)
        if held["digest"] != digest(configuration):
            raise BadOutput(f"open_run: {folder} holds another run ({differences(held, configuration)}); choose another folder with --out.")
        return folder
    if folder.exists() and any(not path.name.startswith(".run.json") for path in folder.iterdir()):
        raise BadOutput(f"open_run: {folder} is not empty and holds no run; choose another folder with --out.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path, wanted.encode())
    except OSError as error:
        raise BadOutput(f"open_run: {folder} cannot be written ({error.strerror}); choose another folder with --out.") from error
    return folder


def differences(held: Mapping[str, Any], configuration: Mapping[str, Any]) -> str:
    """What a run was asked for and what is asked for now, where they differ."""
    was, now = held["configuration"], json.loads(json.dumps(dict(configuration)))
    odd = [name for name in {**was, **now} if was.get(name) != now.get(name)]
    told = [f"{name} {was.get(name, 'unset')} there, {now.get(name, 'unset')} now" for name in odd if not isinstance(now.get(name), dict | list)]
    return "; ".join(told or [f"other {', '.join(odd)}"])


def note(folder: Path) -> dict[str, Any]:
    """A run's `digest` and `configuration`. Raises: BadOutput when run.json is absent or damaged."""
    path = folder / "run.json"
    try:
        held = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise BadOutput(f"run: {path} is absent or damaged; choose another folder, or run again with --out.") from error
    if not isinstance(held, dict) or not {"digest", "configuration"} <= held.keys():
        raise BadOutput(f"run: {path} is absent or damaged; choose another folder, or run again with --out.")
    return held


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes out of a run while this one works on it. Raises BadOutput when one is in already."""
    with (folder / "run.json").open() as held:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise BadOutput(f"locked: another process is working in {folder}; wait for it, or choose another folder with --out.") from error
        yield


def append(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Add finished episodes as one new part. Raises BadOutput when the disk is full."""
    add(folder, "parts", rows, "append")


def add(folder: Path, kind: str, rows: Sequence[Mapping[str, Any]], who: str) -> None:
    """Add `rows` to the run's tables of a `kind`, as one new part. Raises: BadOutput, in the name of `who`, when the disk is full."""
    import pandas as pd

    try:
        (folder / kind).mkdir(exist_ok=True)
        write_atomic(folder / kind / f"{uuid4().hex}.parquet", pd.DataFrame(list(rows)).to_parquet(index=False, compression="zstd"))
    except OSError as error:
        raise BadOutput(f"{who}: {folder} cannot be written ({error.strerror}); make room and run the same command again.") from error


def compact(folder: Path) -> None:
    """Make one part of many, every attempt kept; cut short, it leaves rows that stand in two parts, which `read` takes for one. Raises: BadOutput."""
    from pyarrow import concat_tables

    parts = sorted((folder / "parts").glob("*.parquet"))
    if len(parts) < 2:
        return
    rows = concat_tables([_part(part) for part in parts], promote_options="permissive").to_pandas()
    append(folder, rows.drop_duplicates([name for name in (*KEY, "attempt") if name in rows]).to_dict("records"))
    for part in parts:
        part.unlink()


def read(folder: Path) -> "pd.DataFrame":
    """Every finished episode, in the order of their keys; of one that ran twice the last attempt counts."""
    import pandas as pd
    from pyarrow import concat_tables

    parts = _parts(folder)
    if not parts:
        return pd.DataFrame(columns=KEY)
    table = concat_tables(parts, promote_options="permissive").to_pandas()
    if not {*KEY, "attempt"} <= set(table.columns):
        raise BadOutput(f"read: {folder} was written by an older version; run the same command again with another --out.")
    table = table.sort_values([*KEY, "attempt"], ignore_index=True)
    return table.drop_duplicates(KEY, keep="last", ignore_index=True)


def _parts(folder: Path) -> "list[pa.Table]":
    """Its parts; looked up anew when one is gone, for then another process has just made one of many. Raises: BadOutput."""
    while True:
        parts = sorted((folder / "parts").glob("*.parquet"))
        try:
            return [_part(part) for part in parts]
        except BadOutput:
            if all(part.exists(follow_symlinks=False) for part in parts):
                raise


def _part(path: Path) -> "pa.Table":
    from pyarrow import ArrowException
    from pyarrow.parquet import read_table

    try:
        return read_table(path)
    except (ArrowException, OSError) as error:
        raise BadOutput(f"read: {path} is damaged; delete it and run the same command again, its episodes run anew.") from error
