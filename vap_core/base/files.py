"""Files that are complete or absent, and where the files that ship with the package are."""

import errno
import fcntl
import hashlib
import json
import os
import shutil
import stat
import struct
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from vap_core.base.errors import BadOutput, first_line

if TYPE_CHECKING:
    import numpy as np

_PACKAGE = Path(__file__).resolve().parents[1]
_INSTALLED = _PACKAGE / "data"
DATA = _INSTALLED if _INSTALLED.is_dir() else _PACKAGE.parent / "data"
"""Weights, policies and episode lists that ship: inside an installed package (setup.py copies them
there), beside the package in a checkout."""
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
