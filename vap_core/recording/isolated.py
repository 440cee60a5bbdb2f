"""Indexes recordings in a process of its own, because a damaged one can end the process.

Rerun's reader stops the whole process where some bytes are wrong, and no exception can be caught.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from vap_core.base.errors import VapError
from vap_core.recording.index import ensure_index

ENDED_READER = "its damaged bytes ended the process that read it"
START = "from vap_core.recording.isolated import main; main()"


def index_isolated(
    recordings: Sequence[Path], folder: Path | None = None
) -> Iterator[tuple[Path, str | None]]:
    """Every recording, with the reason why it has no index, or None where it has one now.

    `folder` is ensure_index's.
    """
    left = list(recordings)
    while left:
        done = 0
        for reason in _run_reader(left, folder):
            yield left[done], reason
            done += 1
        if done < len(left):
            yield left[done], ENDED_READER
            done += 1
        left = left[done:]


def main() -> None:
    """The other process: a line of JSON in with the paths, a line out for each of them."""
    asked = json.loads(sys.stdin.readline())
    folder = None if asked["folder"] is None else Path(asked["folder"])
    for path in asked["recordings"]:
        reason = None
        try:
            ensure_index(Path(path), folder)
        except VapError as error:  # also a disk that is full
            reason = str(error)
        print(json.dumps(reason), flush=True)


def _run_reader(recordings: Sequence[Path], folder: Path | None) -> Iterator[str | None]:
    """The reasons that the other process gives until it ends."""
    asked = {
        "folder": None if folder is None else str(folder),
        "recordings": [str(path) for path in recordings],
    }
    process = subprocess.Popen(
        [sys.executable, "-c", START],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        process.stdin.write(json.dumps(asked) + "\n")
        process.stdin.close()
        for line in process.stdout:
            yield json.loads(line)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
