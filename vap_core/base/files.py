"""Files that are complete or absent, tables and checks of their values, and the version of the code
that wrote them.
"""

import ast
import csv
import errno
import fcntl
import hashlib
import inspect
import json
import os
import re
import shutil
import stat
import struct
import subprocess
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from vap_core.base.errors import BadOutput, BadStudy, VapError, first_line

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    import pyarrow as pa
    from datafusion import SessionContext


_PACKAGE = Path(__file__).resolve().parents[1]
_INSTALLED = _PACKAGE / "data"
DATA = _INSTALLED if _INSTALLED.is_dir() else _PACKAGE.parent / "data"
"""Weights, policies and episode lists that ship: inside an installed package (setup.py copies them
there), beside the package in a checkout."""
WORKSPACE = Path() if DATA == _INSTALLED else DATA.parent
"""The folder of notebooks, figures and data: the checkout, wherever a notebook is run from."""
SHIPPED = DATA / "policies"
"""The folder of the checkpoints that ship."""
NO_LINKS = (errno.EPERM, errno.ENOSYS, errno.EOPNOTSUPP, errno.EMLINK)
"""What a file system without hard links says of one."""
ABANDONED_S = 3600.0
"""A scratch file that was last written so long ago belongs to no process that runs."""

LARGEST_BYTES = 2_000_000_000
"""The largest file that is read into memory at once."""


def kept_folder(name: str) -> Path:
    """Where what is downloaded or computed once is kept for later: beside `DATA` in a checkout.

    An installed package keeps it in the user's cache, `XDG_CACHE_HOME` or ~/.cache.
    """
    if DATA != _INSTALLED:
        return DATA / name
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "vap-core" / name


@contextmanager
def writing(
    path: Path, caller: str, mend: str = "make room and run the same command again"
) -> Iterator[None]:
    """Inside, something is written to `path`, a file or a folder.

    Raises: BadOutput, which says how to mend it, for an OSError inside.
    """
    try:
        yield
    except OSError as error:
        raise BadOutput(
            f"{caller}: {path} cannot be written ({error.strerror or error}); {mend}."
        ) from error


def make_folder(folder: Path, caller: str, mend: str = "choose another folder with --out") -> None:
    """Make a folder, before the work whose results it will hold.

    Raises: BadOutput when it cannot be made, or no file in it.
    """
    with writing(folder, caller, mend):
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass


def take_name(scratch: Path, path: Path) -> None:
    """Give a finished file its name, unless something has it.

    Where there are no hard links (exFAT, some network drives), two processes that do so at one
    moment may replace each other's file.

    Raises: FileExistsError; OSError.
    """
    try:
        os.link(scratch, path)
    except OSError as error:
        if error.errno not in NO_LINKS:
            raise
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from error
        os.replace(scratch, path)
    else:
        scratch.unlink()


@contextmanager
def replacing(path: Path, *, replace: bool = True) -> Iterator[Path]:
    """A path to write to, which replaces `path` when the block ends without an error.

    Without `replace` it takes the name `path` only if nothing has it at that moment, whatever other
    processes do.

    Raises: OSError; without `replace` FileExistsError.
    """
    scratch = path.with_name(f".{path.name}.{uuid4().hex}.tmp")
    try:
        yield scratch
        if replace:
            os.replace(scratch, path)
        else:
            take_name(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)


def write_atomic(path: Path, data: bytes, *, replace: bool = True) -> None:
    """Write the whole file, or nothing. Raises: OSError; without `replace` FileExistsError."""
    with replacing(path, replace=replace) as scratch:
        scratch.write_bytes(data)


def write_files(
    files: Mapping[Path, bytes], caller: str, mend: str, *, replace: bool = False
) -> None:
    """Write files; those that hold just these bytes already are left as they are.

    Raises: BadOutput for an OSError; without `replace`, before anything is written, for a file
        that holds other bytes.
    """
    missing: dict[Path, bytes] = {}
    for path, data in files.items():
        with writing(path, caller, mend):
            if path.is_file() and path.read_bytes() == data:
                continue
            taken = os.path.lexists(path)
        if taken and not replace:
            raise BadOutput(f"{caller}: {path} exists with other contents; {mend}.")
        missing[path] = data
    for path, data in missing.items():
        with writing(path, caller, mend):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(path, data, replace=replace)


@contextmanager
def folder_locked(folder: Path) -> Iterator[None]:
    """Inside, other processes that lock the folder wait. Raises: OSError."""
    held = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX)
        yield
    finally:
        os.close(held)


def remove_scratch(folder: Path, pattern: str = ".*.tmp") -> None:
    """Remove what killed processes left in a folder: scratch as old as ABANDONED_S, if it can be.

    What another process is writing is younger.
    """
    for scratch in folder.glob(pattern):
        with suppress(OSError):
            if time.time() - scratch.stat().st_mtime < ABANDONED_S:
                continue
            if scratch.is_dir():
                shutil.rmtree(scratch)
            else:
                scratch.unlink()


def check_regular(path: Path) -> None:
    """Raises: OSError when there is no regular file. To open a pipe waits for its writer."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "it is no regular file", str(path))


def read_file(path: Path) -> bytes:
    """A regular file's contents.

    Raises: OSError, also for one above LARGEST_BYTES, and where the memory does not suffice.
    """
    check_regular(path)
    if path.stat().st_size > LARGEST_BYTES:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(path))
    try:
        return path.read_bytes()
    except MemoryError as error:
        raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM), str(path)) from error


def file_fault(path: Path) -> str:
    """Why no file can be read at a path, as the rest of a sentence about it; "" where one can be.

    `Path.is_file` raises for a folder without rights, and for a name that is too long.
    """
    try:
        if re.match(r"[a-z]\w+:/", str(path)):
            return "is an address, and nothing is fetched here; download it and name the file"
        if not path.is_file():
            return "is not a file"
        with path.open("rb"):
            return ""
    except OSError as error:
        return f"cannot be read ({error.strerror or error})"


def encode_tensors(tensors: "Mapping[str, np.ndarray]", metadata: Mapping[str, str]) -> bytes:
    """A safetensors file with its header sorted: equal contents are equal bytes."""
    from safetensors.numpy import save

    data = save(dict(tensors), metadata=dict(metadata))
    (size,) = struct.unpack("<Q", data[:8])
    header = json.dumps(
        json.loads(data[8 : 8 + size]), sort_keys=True, separators=(",", ":"), ensure_ascii=False
    ).encode()
    header += b" " * (-len(header) % 8)
    return struct.pack("<Q", len(header)) + header + data[8 + size :]


@contextmanager
def saving_tensors() -> Iterator[None]:
    """Inside, safetensors writes a file. Raises: OSError where it cannot."""
    from safetensors import SafetensorError

    try:
        yield
    except SafetensorError as error:
        raise OSError(first_line(error)) from error


def parse_json(text: str | bytes) -> Any:
    """What JSON from outside holds.

    Raises: ValueError when it is no JSON, or nested deeper than Python recurses.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("JSON that is nested too deep") from error


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_rows(
    path: Path,
    columns: Sequence[str],
    *,
    optional: Sequence[str] = (),
    caller: str,
    error: type[VapError],
) -> list[tuple[int, dict[str, str]]]:
    """Every row that is not empty, with the number of its line; a cell that is absent is "".

    `caller` is the command that an error names.

    Raises: `error`, for a file that cannot be read, or that lacks one of `columns`.
    """
    names = (*columns, *optional)
    try:
        check_regular(path)
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            for name in columns:
                if name not in (reader.fieldnames or ()):
                    raise error(
                        f"{caller}: {path} lacks the column {name!r}; its first line is "
                        f"{','.join(names)}."
                    )
            rows = []
            for row in reader:
                cells = {name: (row.get(name) or "").strip() for name in names}
                if any(cells.values()):
                    rows.append((reader.line_num, cells))
            return rows
    except (OSError, UnicodeDecodeError, csv.Error) as failure:
        raise error(
            f"{caller}: {path} cannot be read ({failure!s:.100}); save it as UTF-8 with commas."
        ) from failure


UNOPENED = (errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE, errno.EIO, errno.ENOMEM)
"""Errors of opening or reading a file that say nothing of what it holds."""


def read_arrow(path: Path, caller: str, remedy: str) -> "pa.Table":
    """A table with its notes.

    Raises: BadOutput, of one line. It ends with the `remedy`, unless the table only cannot be
        opened: then nothing says that it is damaged.
    """
    from pyarrow import ArrowException
    from pyarrow.parquet import read_metadata, read_table

    try:
        check_regular(path)
        about = read_metadata(path)
        sizes = [about.row_group(i).total_byte_size for i in range(about.num_row_groups)]
        if max(sum(sizes), 8 * about.num_rows * about.num_columns) > LARGEST_BYTES:
            raise OSError(errno.ENOMEM, f"over {LARGEST_BYTES / 1e9:g} GB unpacked")
        return read_table(path)
    except (UnicodeEncodeError, OSError) as error:
        if isinstance(error, OSError) and error.errno not in UNOPENED:
            raise BadOutput(f"{caller}: {path} is damaged; {remedy}.") from error
        reason = getattr(error, "strerror", None) or "a name that is no text"
        raise BadOutput(
            f"{caller}: {ascii(str(path))[1:-1]} cannot be opened ({reason}); the table may be "
            "whole: mend that, and run the same command again."
        ) from error
    except (ArrowException, ValueError) as error:
        raise BadOutput(f"{caller}: {path} is damaged; {remedy}.") from error


def read_parquet(path: Path, caller: str, remedy: str) -> "pd.DataFrame":
    """The rows of a table. Raises: BadOutput, of one line that ends with the `remedy`."""
    return read_arrow(path, caller, remedy).to_pandas()


def signed(value: float, digits: int = 0) -> str:
    """A rounded number with its sign: "+3", "-0.4"; "+0" for all that rounds to zero."""
    return f"{value:+z.{digits}f}"


def signed_interval(middle: float, low: float, high: float, digits: int = 0) -> str:
    """A signed number and its interval: "+3 [-1, +7]"."""
    return f"{signed(middle, digits)} [{signed(low, digits)}, {signed(high, digits)}]"


LONGEST, DEEPEST = 4_000, 40
"""Characters and nested brackets of a condition. The parser recurses: far more end the process."""
FUNCTIONS = frozenset(
    "abs ceil char_length character_length coalesce contains ends_with exp floor greatest isnan "
    "least left length ln log10 lower nullif power regexp_like right round signum sqrt "
    "starts_with strpos substr substring trim btrim trunc upper".split()
)
"""What a condition may call. Others can make a value of any length, and exhaust the memory."""
LINE = "__vap_line__"
"""The column with a row's number; no table of ours has one of this name."""


def rows_matching(table: "pd.DataFrame", condition: str) -> "pd.DataFrame":
    """The rows for which a SQL condition holds, such as "margin < 0.05 and success = false".

    Raises: BadStudy.
    """
    flat = table.reset_index(drop=True)
    with _asked({"episodes": flat.assign(**{LINE: flat.index})}, condition, condition) as context:
        lines: list[int] = []
        for batch in context.table("episodes").filter(condition).select(LINE).collect():
            lines += batch[LINE].to_pylist()
    return flat.loc[sorted(lines)]


def select(tables: "Mapping[str, pd.DataFrame]", sql: str, asked: str) -> "pd.DataFrame":
    """What a SQL query over tables finds; it can change nothing. Errors show what was `asked`.

    Raises: BadStudy.
    """
    from datafusion import SQLOptions

    options = SQLOptions().with_allow_ddl(False).with_allow_dml(False).with_allow_statements(False)
    with _asked(tables, sql, asked) as context:
        return context.sql_with_options(sql, options).to_pandas()


@contextmanager
def _asked(
    tables: "Mapping[str, pd.DataFrame]", sql: str, asked: str
) -> "Iterator[SessionContext]":
    """A session with some tables and FUNCTIONS alone; what is wrong with a question is one line."""
    import pyarrow as pa
    from datafusion import SessionContext

    _check_size(sql)
    context = SessionContext()
    for name in context.udfs():
        if name not in FUNCTIONS:
            context.deregister_udf(name)
    for name, table in tables.items():
        arrow = pa.Table.from_pandas(table, preserve_index=False)
        # A table without rows has no batch, and datafusion panics at none.
        batches = arrow.to_batches() or [pa.RecordBatch.from_pylist([], schema=arrow.schema)]
        context.register_record_batches(name, [batches])
    try:
        yield context
    except Exception as error:  # datafusion raises bare exceptions
        reason = " ".join(str(error).split()).partition(" Valid fields are")[0][:200]
        absent = re.search(r"No field named \"?(?:\w+\.)?(\w+)", reason)
        columns = {str(c): 0 for table in tables.values() for c in table.columns if c != LINE}
        near = get_close_matches(absent[1].lower(), columns) if absent else []
        listed = f"columns: {', '.join(columns)}."
        mend = f"did you mean {' or '.join(near)}?" if near else listed
        shown = " ".join(asked.split())[:200]
        fault = BadStudy(f"condition: {shown!r} is none on this table ({reason}); {mend}")
        fault.is_whole = True
        raise fault from error


def _check_size(condition: str) -> None:
    depth = deepest = 0
    for character in condition:
        depth += (character == "(") - (character == ")")
        deepest = max(deepest, depth)
    if len(condition) > LONGEST or deepest > DEEPEST:
        raise BadStudy(
            f"condition: it has {len(condition):,} characters and {deepest} nested brackets; "
            f"{LONGEST:,} and {DEEPEST} are the most."
        )


@cache
def code_version(folder: Path | None = None) -> str:
    """The commit of a checkout (default: this one), with `+` when the tree differs.

    Where there is none, the installed version; "unknown" for a copy that is neither.
    """
    folder = folder or Path(__file__).resolve().parent
    try:
        if not _git(folder, "ls-files"):  # installed inside another project's repository
            return _installed_version()
        return _git(folder, "describe", "--always", "--dirty=+", "--abbrev=10")
    except (OSError, subprocess.SubprocessError):
        return _installed_version()


def _git(folder: Path, *words: str) -> str:
    done = subprocess.run(
        ["git", *words], cwd=folder, capture_output=True, text=True, timeout=10, check=True
    )
    return done.stdout.strip()


def code_digest(folder: Path, without: Collection[str] = ()) -> str:
    """A digest of a module, or of those below a folder but for the ones named in `without`.

    Comments, docstrings and line breaks do not count.
    """
    found = hashlib.sha256()
    paths = [folder] if folder.is_file() else sorted(folder.rglob("*.py"))
    for path in paths:
        if path.stem in without:
            continue
        found.update(path.relative_to(folder).as_posix().encode())
        found.update(ast.dump(_without_docstrings(ast.parse(path.read_text()))).encode())
    return found.hexdigest()[:16]


def source_digest(form: Any) -> str:
    """A digest of the source of a function, or of the class of a callable and of its bases.

    What has no source, because it is built in or typed into a console, is left out; "" where
    nothing has any.
    """
    if inspect.isroutine(form) or inspect.isclass(form):
        parts: tuple[Any, ...] = (form,)
    else:
        parts = type(form).__mro__
    source = ""
    for part in parts:
        try:
            source += inspect.getsource(part)
        except (OSError, TypeError):
            continue
    return hashlib.sha256(source.encode()).hexdigest()[:16] if source else ""


def _installed_version() -> str:
    try:
        return f"vap-core {version('vap-core')}"
    except PackageNotFoundError:
        return "unknown"


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        node.body = [part for part in body if not _is_string(part)]  # type: ignore[attr-defined]
    return tree


def _is_string(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )
