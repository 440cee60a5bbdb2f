"""The commands that are printed, to be run next."""

import shlex
from collections.abc import Mapping
from pathlib import Path


def command(*words: str | Path, environment: Mapping[str, str] | None = None) -> str:
    """A command of the package as a line for the shell: every word and variable is quoted."""
    parts = []
    for name, setting in (environment or {}).items():
        parts.append(f"{name}={shlex.quote(setting)}")
    parts.append(shlex.join(["python", "-m", "vap_core", *map(str, words)]))
    return " ".join(parts)
