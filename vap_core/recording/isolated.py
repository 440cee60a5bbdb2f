"""Reads recordings and corrections, and indexes, in another process: a damaged file can end it.

Rerun's reader stops the whole process where some bytes are wrong, and no exception can be caught.
"""

import json
import os
import subprocess
import sys
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vap_core.base.errors import BadRecording, VapError
from vap_core.recording.index import ensure_index
from vap_core.recording.layers import Correction, damaged_layer, read_correction
from vap_core.recording.reading import read_summary, unreadable

ENDED_READER = "its damaged bytes ended the process that read it"
START = "from vap_core.recording.isolated import main; main()"


def index_isolated(
    recordings: Sequence[Path], folder: Path | None = None
) -> Iterator[tuple[Path, str | None]]:
    """Every recording, with the reason why it has no index, or None where it has one now.

    `folder` is ensure_index's.
    """
    asked = {"folder": None if folder is None else str(folder)}
    for path, answer in _answers(recordings, asked):
        yield path, answer["reason"]


def read_summaries(
    recordings: Sequence[Path],
) -> Generator[tuple[Path, dict[str, Any] | None, str]]:
    """Every recording with its summary (`read_summary`), None where a reason says why not."""
    for path, answer in _answers(recordings, {"summary": True}):
        yield path, answer.get("summary"), answer["reason"] or ""


def check_recording(recording: Path) -> None:
    """Check that a recording can be read, before this process reads it. Raises: BadRecording."""
    for path, _, reason in read_summaries([Path(recording)]):
        if reason == ENDED_READER:
            raise unreadable(path, reason)
        if reason:
            raise BadRecording(reason)


def read_layers(layers: Sequence[Path]) -> Generator[tuple[Path, Correction | None, str]]:
    """Every layer with its correction, None where a reason says why it has none."""
    for path, answer in _answers(layers, {"correction": True}):
        if "correction" in answer:
            yield path, Correction(**answer["correction"]), ""
        elif answer["reason"] == ENDED_READER:
            yield path, None, str(damaged_layer(path, ENDED_READER))
        else:
            yield path, None, answer["reason"]


def main() -> None:
    """The other process: a line of JSON in with the paths, a line out for each of them."""
    asked = json.loads(sys.stdin.readline())
    folder = None if asked.get("folder") is None else Path(asked["folder"])
    for path in asked["recordings"]:
        answer: dict[str, Any] = {"reason": None}
        try:
            if asked.get("summary"):
                answer["summary"] = read_summary(Path(path))
            elif asked.get("correction"):
                answer["correction"] = asdict(read_correction(Path(path)))
            else:
                ensure_index(Path(path), folder)
        except VapError as error:  # also a disk that is full
            answer["reason"] = str(error)
        print(json.dumps(answer, default=str), flush=True)


def _answers(
    recordings: Sequence[Path], asked: Mapping[str, Any]
) -> Iterator[tuple[Path, dict[str, Any]]]:
    """What other processes answer about every recording; a new one begins where one ends."""
    left = list(recordings)
    while left:
        done = 0
        for answer in _run_reader({**asked, "recordings": [str(path) for path in left]}):
            yield left[done], answer
            done += 1
        if done < len(left):
            yield left[done], {"reason": ENDED_READER}
            done += 1
        left = left[done:]


def _run_reader(asked: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """The answers that the other process gives until it ends."""
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
