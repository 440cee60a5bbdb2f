"""Files that are complete or absent, and where the files that ship with the package are."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

DATA = Path(__file__).resolve().parents[2] / "data"
"""Weights, policies, episode lists and results that ship beside the package."""


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
            os.link(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)


def write_atomic(path: Path, data: bytes, *, replace: bool = True) -> None:
    """Write the whole file, or nothing. Raises: OSError; without `replace` FileExistsError."""
    with replacing(path, replace=replace) as scratch:
        scratch.write_bytes(data)


def parse_json(text: str | bytes) -> Any:
    """What JSON from outside holds.

    Raises: ValueError when it is no JSON, or nested deeper than Python recurses.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("JSON that is nested too deep") from error
