"""What a benchmark measured, as a small JSON file with its provenance, and as tables.

A measurement is kept as JSON, and printed as tables.
"""

import json
import os
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from vap_core.base.errors import BadOutput
from vap_core.base.files import write_atomic, writing
from vap_core.base.tables import Rows, align, markdown
from vap_core.base.version import code_version

LIBRARIES = ("torch", "mujoco", "lerobot", "onnxruntime", "ray")


@dataclass(frozen=True)
class Table:
    """A titled table of text cells, the header first, and a note that may be empty."""

    title: str
    rows: Rows
    note: str = ""


@dataclass(frozen=True)
class Measurement:
    """The values of one benchmark, as JSON holds them, and where they come from."""

    bench: str
    provenance: Mapping[str, Any]
    values: Mapping[str, Any]


def provenance(command: str, **about: Any) -> dict[str, Any]:
    """Code version, machine, versions of libraries and day; `about` adds n, seeds and the like."""
    libraries = {"python": platform.python_version()}
    for name in LIBRARIES:
        found = _installed(name)
        if found:
            libraries[name] = found
    return {
        "command": command,
        "commit": code_version(),
        "machine": f"{_processor()}, {_cores()}",
        "day": datetime.now(UTC).date().isoformat(),
        "libraries": libraries,
        **about,
    }


def n_cores() -> int:
    """The cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _cores() -> str:
    n = n_cores()
    return "1 core" if n == 1 else f"{n} cores"


def write(measurement: Measurement, path: Path) -> None:
    """Raises: BadOutput."""
    text = json.dumps(asdict(measurement), indent=1) + "\n"
    with writing(path, "bench", "give --json another name"):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, text.encode())


def read(path: Path) -> Measurement:
    """Raises: BadOutput."""
    try:
        return Measurement(**json.loads(path.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise BadOutput(
            f"bench: {path} holds no measurement ({type(error).__name__}); bench writes one by "
            "--json."
        ) from error


def as_text(measurement: Measurement, tables: list[Table]) -> str:
    """The tables as they are printed."""
    parts = [_origin(measurement)]
    for table in tables:
        parts.append(f"{table.title}\n\n{align(table.rows)}")
        if table.note:
            parts.append(table.note)
    return "\n\n".join(parts)


def as_markdown(measurement: Measurement, tables: list[Table]) -> str:
    """The tables as a part of a Markdown page."""
    command = measurement.provenance["command"]
    parts = [f"`{command}`. {_origin(measurement)}."]
    for table in tables:
        parts.append(f"**{table.title}**\n\n{markdown(table.rows)}")
        if table.note:
            parts.append(table.note)
    return "\n\n".join(parts)


def _origin(measurement: Measurement) -> str:
    about = dict(measurement.provenance)
    about.pop("command")
    libraries = about.pop("libraries")
    facts = []
    for name, fact in about.items():
        facts.append(f"{name} {fact}")
    for name, number in libraries.items():
        facts.append(f"{name} {number}")
    return ", ".join(facts)


def _installed(name: str) -> str:
    try:
        return version(name)
    except ModuleNotFoundError:
        return ""


def _processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
