"""The file of a recording: its name, the temporary file it grows in, and its rescue."""

import os
import re
import subprocess
import sys
from pathlib import Path

from vap_core.base.errors import BadOutput, BadRecording
from vap_core.recording.reading import read_summary, unreadable
from vap_core.simulation.types import EpisodeRow

LEFTOVER = re.compile(r"\.(?P<name>.+\.rrd)(?:\.\d+)?\.tmp")
"""The temporary file of a recording; those of earlier versions have no number."""
NO_PROXY_THERE = "http://127.0.0.1:9"
"""Port 9 is the discard service's, and nothing listens on it."""


def recording_name(row: EpisodeRow, method: str) -> str:
    """An episode's file name, for example `simpler-bridge.put-owl.003.s7.vap.rrd`."""
    return recording_file_name(row.suite, row.task, row.episode, row.seed, method)


def recording_file_name(suite: str, task: str, episode: int, seed: int, method: str) -> str:
    """The same from the columns of a results table."""
    stem = f"{suite}.{task}.{episode:03d}.s{seed}.{method}"
    return re.sub(r"[^\w.+-]+", "-", stem).strip("-.") + ".rrd"


def temporary_path(path: Path) -> Path:
    """Where a recording grows until it is finished: same folder, leading dot, suffix `.tmp`.

    Each process has its own, so that two that record one episode do not write one file.
    """
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def rerun_command(*arguments: str | Path) -> list[str]:
    """A command line of the rerun that this environment has."""
    return [sys.executable, "-m", "rerun", *map(str, arguments)]


def rerun_environment() -> dict[str, str]:
    """The environment of every process of Rerun's: it sends nothing, and writes no configuration.

    `CI` turns its analytics off; `rerun analytics disable` would write to the user's home. The
    viewer's look for a newer version has no switch without a window: it goes to a proxy that is not
    there.
    """
    environment = dict(os.environ)
    for name in ("FORCE_RERUN_ANALYTICS", "NO_PROXY", "no_proxy"):
        environment.pop(name, None)
    for name in ("ALL_PROXY", "HTTPS_PROXY", "HTTP_PROXY"):
        environment[name] = environment[name.lower()] = NO_PROXY_THERE
    return {**environment, "CI": "1"}


def recover(leftover: Path) -> Path:
    """Repair the temporary file of a killed process and give it the recording's name.

    Returns the recording's path. It holds every step up to the last flush, and no outcome.

    Raises: BadOutput, when the recording exists; BadRecording, when nothing can be saved.
    """
    leftover = Path(leftover)
    named = LEFTOVER.fullmatch(leftover.name)
    if named is None or not leftover.is_file():
        raise BadRecording(
            f"recover: {leftover} is no leftover of a recording; "
            f"expected an existing file named like {temporary_path(Path('NAME.rrd')).name}."
        )
    path = leftover.with_name(named["name"])
    if path.exists():
        raise BadOutput(
            f"recover: {path} already exists and is never overwritten; "
            f"{leftover} was left as it is."
        )
    repaired = leftover.with_name(f".{path.name}.mended")
    done = subprocess.run(
        rerun_command("rrd", "optimize", leftover, "-o", repaired),
        capture_output=True,
        text=True,
        env=rerun_environment(),
        check=False,
    )
    try:
        if done.returncode or not repaired.is_file():
            raise unreadable(leftover, done.stderr)
        read_summary(repaired)
        repaired.replace(path)
    finally:
        repaired.unlink(missing_ok=True)
    leftover.unlink()
    return path
