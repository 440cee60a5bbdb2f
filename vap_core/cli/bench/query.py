"""What it costs to find a frame: the index of a recording, a query over very many recordings, and opening one of them without a display."""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from vap_core.base.errors import MissingGL
from vap_core.cli.bench.loop import Limit, beside_budgets, demo_trial, median_ms
from vap_core.recording import DeferredRecorder, ensure_index, read_chunks, screenshot
from vap_core.rollout.loop import rollout

STEPS = 30
ASKED = """
import resource, sys, time
from pathlib import Path
from vap_core.recording.query import run_query
start = time.perf_counter()
found = len(run_query(Path(sys.argv[1]), "margin < 2 and success = false").matches)
print(time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, found)
"""
"""In a process of its own: seconds of a query, the most gigabytes it took, and how many recordings it found."""


def run(recordings: int = 1000, quick: bool = False) -> str:
    """Record a failure in the simulator, copy it under so many names, and ask all of them at once; takes a minute or two."""
    n = 20 if quick else recordings
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "recordings"
        first = _recorded(Path(scratch))
        whole = median_ms(lambda: list(read_chunks(first))) / 1e3
        folder.mkdir()
        took = []
        for i in tqdm(range(n), "record", unit="recording", leave=False, mininterval=1):
            path = folder / f"{i:05d}.rrd"
            read_chunks(first).write_rrd(path, application_id="vap", recording_id=path.stem)
            took.append(_seconds(partial(ensure_index, path)))
        asked_s, asked_gb, found = (float(word) for word in _python(ASKED, str(folder)).split())
        megabytes = sum(path.stat().st_size for path in folder.rglob("*.rrd")) / 1e6
        limits = [
            Limit(
                f"query over {n} recordings ({megabytes:.0f} MB)",
                asked_s,
                5,
                "s",
                f"{asked_s / whole:.0f} recordings read whole",
            ),
            Limit("memory of that process", asked_gb, 2, "GB", f"{found:.0f} found"),
            Limit(
                "index of a recording, once",
                1e3 * float(np.median(took)),
                50,
                "ms",
                f"{np.median(took) / whole:.2f} recordings read whole",
            ),
        ]
        try:
            opened = _seconds(
                lambda: screenshot(first, Path(scratch) / "one.png", size=(1920, 1080))
            )
            limits.append(
                Limit(
                    "opening a frame without a display",
                    opened,
                    15,
                    "s",
                    f"{opened / whole:.0f} recordings read whole",
                )
            )
            note = ""
        except MissingGL as error:
            note = f"\nopening a frame was not measured: {error}"
    return f"{STEPS} steps of 3 cameras; to read such a recording whole takes {1e3 * whole:.0f} ms\n\n{beside_budgets(limits)}{note}"


def _recorded(scratch: Path) -> Path:
    """STEPS steps of three cameras, too few to reach anything."""
    trial, row = demo_trial(scratch, STEPS)
    path = scratch / "one.rrd"
    next(
        rollout(trial, [row], lambda opening: DeferredRecorder(path, opening, lambda outcome: True))
    )
    return path


def _python(code: str, *words: str) -> str:
    return subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, check=True
    ).stdout


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start
