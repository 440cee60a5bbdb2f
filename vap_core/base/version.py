"""Which code is running: results and recordings carry it beside their numbers."""

import subprocess
from functools import cache
from importlib.metadata import version
from pathlib import Path


@cache
def code_version(folder: Path | None = None) -> str:
    """The commit of a checkout (default: this one), with `+` when the tree differs.

    Where there is none, the installed version.
    """
    command = ["git", "describe", "--always", "--dirty=+", "--abbrev=10"]
    folder = folder or Path(__file__).resolve().parent
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return f"vap-core {version('vap-core')}"
    return done.stdout.strip()
