"""What it costs to find a frame.

The index of a recording, a query over very many recordings, and opening one of them without a
display.
"""

import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from vap_core.base.errors import MissingGL
from vap_core.cli.bench.loop import Limit, beside_budgets, demo_trial, median_ms
from vap_core.cli.bench.timing import seconds_of
from vap_core.recording import DeferredRecorder, ensure_index, read_chunks, screenshot
from vap_core.rollout.loop import rollout

STEPS = 30
QUERY = """
import resource, sys, time
from pathlib import Path
from vap_core.recording.query import run_query
start = time.perf_counter()
found = len(run_query(Path(sys.argv[1]), "margin < 2 and success = false").matches)
print(time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, found)
"""
"""In a process of its own: a query's seconds, its most gigabytes, and the recordings it found."""


def run(recordings: int = 1000, quick: bool = False) -> str:
    """Copy the recording of a failure under so many names, and query all of them at once.

    Takes a minute or two.
    """
    n = 20 if quick else recordings
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "recordings"
        first = _record_failure(Path(scratch))
        whole_s = median_ms(lambda: list(read_chunks(first))) / 1e3
        index_s = _copy_and_index(first, folder, n)
        limits = _query_limits(folder, n, whole_s)
        limits.append(
            Limit(
                what="index of a recording, once",
                measured=1e3 * index_s,
                budget=50.0,
                unit="ms",
                ratio=f"{index_s / whole_s:.2f} recordings read whole",
            )
        )
        note = ""
        try:
            limits.append(_open_limit(first, whole_s))
        except MissingGL as error:
            note = f"\nopening a frame was not measured: {error}"
    title = (
        f"{STEPS} steps of 3 cameras; to read such a recording whole takes {1e3 * whole_s:.0f} ms"
    )
    return f"{title}\n\n{beside_budgets(limits)}{note}"


def _record_failure(folder: Path) -> Path:
    """STEPS steps of three cameras, too few to reach anything."""
    trial, row = demo_trial(folder, STEPS)
    path = folder / "one.rrd"
    next(
        rollout(trial, [row], lambda opening: DeferredRecorder(path, opening, lambda outcome: True))
    )
    return path


def _copy_and_index(recording: Path, folder: Path, n: int) -> float:
    """Copy a recording n times into a new folder; returns the median seconds of an index."""
    folder.mkdir()
    seconds = []
    for i in tqdm(range(n), "record", unit="recording", leave=False, mininterval=1):
        path = folder / f"{i:05d}.rrd"
        read_chunks(recording).write_rrd(path, application_id="vap", recording_id=path.stem)
        seconds.append(seconds_of(partial(ensure_index, path)))
    return float(np.median(seconds))


def _query_limits(folder: Path, n: int, whole_s: float) -> list[Limit]:
    """Time and memory of a query over the recordings of a folder."""
    seconds, gigabytes, found = map(float, _python(QUERY, str(folder)).split())
    megabytes = sum(path.stat().st_size for path in folder.rglob("*.rrd")) / 1e6
    return [
        Limit(
            what=f"query over {n} recordings ({megabytes:.0f} MB)",
            measured=seconds,
            budget=5.0,
            unit="s",
            ratio=f"{seconds / whole_s:.0f} recordings read whole",
        ),
        Limit(
            what="memory of that process",
            measured=gigabytes,
            budget=2.0,
            unit="GB",
            ratio=f"{found:.0f} found",
        ),
    ]


def _open_limit(recording: Path, whole_s: float) -> Limit:
    """Raises: MissingGL."""
    png = recording.with_name("one.png")
    seconds = seconds_of(partial(screenshot, recording, png, size=(1920, 1080)))
    return Limit(
        what="opening a frame without a display",
        measured=seconds,
        budget=15.0,
        unit="s",
        ratio=f"{seconds / whole_s:.0f} recordings read whole",
    )


def _python(code: str, *arguments: str) -> str:
    """What a program prints, in a process of its own."""
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout
