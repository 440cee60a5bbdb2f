"""The file of a recording: its name, the temporary file it grows in, and its rescue."""

import re
import subprocess
import sys
from pathlib import Path

from vap_core.base.errors import BadOutput, BadRecording
from vap_core.recording.reading import read_summary, unreadable
from vap_core.simulation.types import EpisodeRow


def recording_name(row: EpisodeRow, method: str) -> str:
    """An episode's file name, for example `simpler-bridge.put-owl.003.s7.vap.rrd`."""
    return recording_file_name(row.suite, row.task, row.episode, row.seed, method)


def recording_file_name(suite: str, task: str, episode: int, seed: int, method: str) -> str:
    """The same from the columns of a results table."""
    stem = f"{suite}.{task}.{episode:03d}.s{seed}.{method}"
    return re.sub(r"[^\w.+-]+", "-", stem).strip("-.") + ".rrd"


def temporary_path(path: Path) -> Path:
    """Where a recording grows until it is finished: same folder, leading dot, suffix `.tmp`."""
    return path.with_name(f".{path.name}.tmp")


def rerun_command(*arguments: str | Path) -> list[str]:
    """A command line of the rerun that this environment has."""
    return [sys.executable, "-m", "rerun", *map(str, arguments)]


def recover(leftover: Path) -> Path:
    """Repair the temporary file of a killed process and give it the recording's name.

    Returns the recording's path. It holds every step up to the last flush, and no outcome.

    Raises: BadOutput, when the recording exists; BadRecording, when nothing can be saved.
    """
    leftover = Path(leftover)
    path = leftover.with_name(leftover.name.removeprefix(".").removesuffix(".tmp"))
    if leftover != temporary_path(path) or not leftover.is_file():
        raise BadRecording(
            f"recover: {leftover} is no leftover of a recording; "
            f"expected an existing file named like {temporary_path(path).name}."
        )
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
