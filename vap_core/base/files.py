"""Files that are complete or absent, and where the files that ship with the package are."""

import os
from pathlib import Path
from uuid import uuid4

DATA = Path(__file__).resolve().parents[2] / "data"
"""Weights, policies, episode lists and results that ship beside the package."""


def write_atomic(path: Path, data: bytes) -> None:
    """Write the whole file, or nothing. Raises: OSError."""
    scratch = path.with_name(f".{path.name}.{uuid4().hex}.tmp")
    try:
        scratch.write_bytes(data)
        os.replace(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)
