"""The folder of a run: settings by digest, a lock, parts that are written whole, and tables.

A run's folder holds `run.json` (its manifest: configuration and digest), `.lock` (locked by the
process that works there) and tables as folders of Parquet parts; episodes are in `parts`.
"""

import fcntl
import hashlib
import json
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any
from uuid import uuid4

from vap_core.base.errors import BadOutput
from vap_core.base.files import (
    parse_json,
    read_arrow,
    read_file,
    remove_scratch,
    write_atomic,
    writing,
)
from vap_core.study.table import printed

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

MANIFEST = "run.json"
LOCK = ".lock"
"""The file that `locked` locks; it is never renamed or removed, so all processes lock the same."""
CHOOSE = "choose another folder with --out"
KEY = ["suite", "task", "method", "seed", "episode"]
"""The columns that name an episode of a run; the table is in this order."""
ROW_KEY = ["suite", "task", "seed", "episode"]
"""The columns that name a row of an episode list: KEY without the method."""


def key_of(row: Mapping[Any, Any]) -> tuple[Any, ...]:
    """KEY of a row of a run's table."""
    return tuple(row[name] for name in KEY)


def digest(configuration: Mapping[str, Any]) -> str:
    """A short hash of anything that JSON can express; equal configurations, equal digests."""
    return hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()[:16]


def open_run(folder: Path, configuration: Mapping[str, Any]) -> Path:
    """Begin a run in `folder`, or go on with the one that is there.

    Raises:
        BadOutput: the folder cannot be written, holds something else, or a run of another
            configuration.
    """
    if folder.exists() and not folder.is_dir():
        raise BadOutput(f"open_run: {folder} is a file; choose another folder with --out.")
    if not (folder / MANIFEST).exists():
        _check_empty(folder)
        with writing(folder, "open_run", CHOOSE):
            folder.mkdir(parents=True, exist_ok=True)
            with locked(folder):
                _begin_run(folder, configuration)
    manifest = read_manifest(folder)
    if manifest["digest"] != digest(configuration):
        raise BadOutput(
            f"open_run: {folder} holds another run ({differences(manifest, configuration)}); "
            f"choose another folder with --out, for example --out {shlex.quote(f'{folder}-2')}."
        )
    return folder


def _check_empty(folder: Path) -> None:
    """Raises: BadOutput when there is a file in the folder that `open_run` did not write."""
    if not folder.exists():
        return
    for present in folder.iterdir():
        if present.name == LOCK or present.name.startswith(f".{MANIFEST}"):
            continue
        if not (folder / MANIFEST).exists():  # it can have been begun in between
            raise BadOutput(
                f"open_run: {folder} is not empty and holds no run; choose another folder with "
                "--out."
            )


def _begin_run(folder: Path, configuration: Mapping[str, Any]) -> None:
    """Write the manifest, unless another process has since. Raises: OSError."""
    if (folder / MANIFEST).exists():
        return
    manifest = {"digest": digest(configuration), "configuration": dict(configuration)}
    write_atomic(folder / MANIFEST, json.dumps(manifest, indent=1, sort_keys=True).encode())


def differences(manifest: Mapping[str, Any], configuration: Mapping[str, Any]) -> str:
    """Where a run's configuration differs from the one that is wanted now, in words."""
    before = manifest["configuration"]
    now = json.loads(json.dumps(dict(configuration)))
    changed = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    parts = [
        f"{name} {before.get(name, 'unset')} there, {now.get(name, 'unset')} now"
        for name in changed
        if not isinstance(now.get(name), dict | list)
    ]
    return "; ".join(parts or [f"other {', '.join(changed)}"])


def read_manifest(folder: Path) -> dict[str, Any]:
    """A run's `digest` and `configuration`.

    Raises: BadOutput when run.json is absent or damaged.
    """
    path = folder / MANIFEST
    damaged = f"run: {path} is absent or damaged; choose another folder, or run again with --out."
    if not path.is_file():
        beside = [each.parent.name for each in folder.parent.glob(f"*/{MANIFEST}")]
        damaged = f"run: {path} is absent or damaged: {folder} holds no run"
        near = get_close_matches(folder.name, beside, cutoff=0.4)
        damaged += f"; did you mean {' or '.join(near)}?" if near else "; name the --out of one."
    try:
        manifest = parse_json(read_file(path))
    except (OSError, ValueError) as error:
        raise BadOutput(damaged) from error
    if not isinstance(manifest, dict) or "digest" not in manifest:
        raise BadOutput(damaged)
    if not isinstance(manifest.get("configuration"), dict):
        raise BadOutput(damaged)
    return manifest


def sweep(folder: Path) -> None:
    """Remove the scratch of killed processes; unfinished recordings stay (`view --recover`)."""
    for kind in ("parts", "traces", "audit", "recordings/.index-*"):
        for place in folder.glob(kind):
            remove_scratch(place)


@contextmanager
def locked(folder: Path, lock: Callable[[IO[bytes], int], None] = fcntl.flock) -> Iterator[None]:
    """Keep other processes out of a run while this one works on it.

    With `fcntl.flock` the processes that this one forks hold the folder, too, until all have ended;
    with `fcntl.lockf` they do not.

    Raises: BadOutput when another process holds it, or the folder cannot be written.
    """
    with writing(folder, "open_run", CHOOSE):
        file = (folder / LOCK).open("ab")
    with file:
        try:
            lock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise BadOutput(
                f"locked: another process is working in {folder}; wait for it, or choose another "
                "folder with --out."
            ) from error
        yield


def append(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Add finished episodes as one new part. Raises: BadOutput when the disk is full."""
    write_part(folder, "parts", rows, caller="append")


def write_part(folder: Path, kind: str, rows: Sequence[Mapping[str, Any]], caller: str) -> Path:
    """Add `rows` as one new part to the table `kind` of a run; returns the part.

    Raises: BadOutput, which names the `caller`, when the disk is full.
    """
    import pandas as pd

    with writing(folder, caller):
        (folder / kind).mkdir(exist_ok=True)
        data = pd.DataFrame(list(rows)).to_parquet(index=False, compression="zstd")
        path = folder / kind / f"{uuid4().hex}.parquet"
        write_atomic(path, data)
        return path


def compact(folder: Path) -> None:
    """Join all parts into one; every attempt is kept.

    Killed in between, it leaves rows in two parts, which `read` counts once.

    Raises: BadOutput.
    """
    paths = sorted((folder / "parts").glob("*.parquet"))
    if len(paths) < 2:
        return
    table = _joined(folder, [_read_part(path) for path in paths])
    key = table.columns.intersection([*KEY, "attempt"]).tolist()
    append(folder, table.drop_duplicates(key).to_dict("records"))
    for path in paths:
        path.unlink()


def read(folder: Path) -> "pd.DataFrame":
    """Every finished episode, in the order of KEY; of several attempts the last one.

    Raises: BadOutput when a part is damaged or of an older version, or does not fit the others.
    """
    import pandas as pd

    parts = _read_parts(folder)
    if not parts:
        return pd.DataFrame(columns=KEY)
    table = _joined(folder, parts)
    if not {*KEY, "attempt"} <= set(table.columns):
        raise BadOutput(
            f"read: {folder} was written by an older version; run the same command again with "
            "another --out."
        )
    return table.drop_duplicates(KEY, keep="last", ignore_index=True)


def _joined(folder: Path, parts: "Sequence[pa.Table]") -> "pd.DataFrame":
    """The rows of all parts, in the order of KEY and attempts where they have them."""
    from pyarrow import ArrowException, concat_tables

    try:
        table = concat_tables(parts, promote_options="permissive").to_pandas()
        order = [name for name in (*KEY, "attempt") if name in table.columns]
        return table.sort_values(order, ignore_index=True) if order else table
    except (ArrowException, ValueError, TypeError) as error:
        raise BadOutput(
            f"read: the parts in {folder} do not fit together ({type(error).__name__}); run the "
            "same command again with another --out."
        ) from error


def _read_parts(folder: Path) -> "list[pa.Table]":
    """All parts of a run.

    They are listed again when one has disappeared: another process has just joined them.

    Raises: BadOutput.
    """
    while True:
        paths = sorted((folder / "parts").glob("*.parquet"))
        try:
            return [_read_part(path) for path in paths]
        except BadOutput:
            if all(path.exists(follow_symlinks=False) for path in paths):
                raise


def _read_part(path: Path) -> "pa.Table":
    return read_arrow(
        path, "read", "delete it and run the same command again, its episodes run anew"
    )


def write_json_part(path: Path, content: Any, caller: str) -> None:
    """Keep one finished part; its folder is made. Raises: BadOutput."""
    with writing(path.parent, caller):
        path.parent.mkdir(parents=True, exist_ok=True)
        # Scalars of NumPy become numbers.
        write_atomic(path, json.dumps(content, default=lambda scalar: scalar.item()).encode())


def read_json_part(path: Path, caller: str) -> Any:
    """What `write_json_part` kept. Raises: BadOutput for a damaged part."""
    try:
        return parse_json(read_file(path))
    except (OSError, ValueError) as error:
        raise BadOutput(
            f"{caller}: {path} is damaged; delete it and run the same command again."
        ) from error


def write_tables(
    folder: Path, tables: Mapping[str, Sequence[Mapping[str, Any]]], caller: str
) -> "dict[str, pd.DataFrame]":
    """Each table as NAME.parquet, for programs, with the run's manifest in its metadata, and as
    NAME.csv, for people; returns the tables as they are read back. Raises: BadOutput.
    """
    import pyarrow as pa

    about = json.dumps(read_manifest(folder), sort_keys=True).encode()
    for name, rows in tables.items():
        columns = list(dict.fromkeys(name for row in rows for name in row))
        arrow = pa.table({"suite": pa.array([], pa.string())})
        if rows:
            arrow = pa.table({name: [row.get(name) for row in rows] for name in columns})
        with writing(folder, caller):
            data = encode_table(arrow.replace_schema_metadata({b"run": about}))
            write_atomic(folder / f"{name}.parquet", data)
            csv = printed(arrow.to_pandas().round(4), "csv")
            write_atomic(folder / f"{name}.csv", csv.encode())
    return read_tables({name: folder / f"{name}.parquet" for name in tables}, caller)


def read_tables(paths: Mapping[str, Path], caller: str) -> "dict[str, pd.DataFrame]":
    """Tables by name. Raises: BadOutput, where one is missing or damaged."""
    missing = [path.name for path in paths.values() if not path.exists()]
    if missing:
        folder = next(iter(paths.values())).parent
        raise BadOutput(
            f"{caller}: {folder} lacks {', '.join(missing)}; run the same {caller} again to finish "
            "it, or with --publish to keep its tables there."
        )
    remedy = "delete it and run the same command again"
    return {name: read_arrow(path, caller, remedy).to_pandas() for name, path in paths.items()}


def encode_table(table: "pa.Table") -> bytes:
    """The table as a Parquet file, with its metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", compression_level=22)  # to be carried
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
