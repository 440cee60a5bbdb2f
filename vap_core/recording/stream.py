"""Writing to a recording: the stream into its file, one row, and time columns."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from datetime import timedelta
from glob import escape
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings

from vap_core.base.errors import BadOutput, BadRecording
from vap_core.base.files import remove_scratch, take_name, writing
from vap_core.recording.read import UNREADABLE, open_whole, read_summary, unreadable
from vap_core.rollout.types import Frame
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


ROOM_BYTES = 32 * 2**20
"""More than one flush writes. Rerun's writer of a file can wait forever when a write fails."""

type Moment = tuple[int, float]
"""Control step and seconds since the episode's start."""


def open_stream(path: Path, recording_id: str) -> rr.RecordingStream:
    """A stream into `temporary_path(path)`.

    It flushes only on request, so that equal runs give equal chunks.

    Raises: BadOutput, when `path` exists, its folder cannot be written, or its disk is full.
    """
    if path.exists():
        raise BadOutput(
            f"record: {path} already exists and is never overwritten; "
            "choose another folder or remove it."
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _require_room(path)
        temporary_path(path).write_bytes(b"")
    except OSError as err:
        raise BadOutput(
            f"record: cannot write in {path.parent} ({err.strerror}); "
            "choose a folder you may write to."
        ) from err
    with suppress(RuntimeError):  # another recording's: its own flush raises it
        # Otherwise every finished recording keeps its threads and some megabytes.
        rerun_bindings.flush_and_cleanup_orphaned_recordings()
    config = rr.ChunkBatcherConfig(
        flush_tick=timedelta(days=365),
        flush_num_bytes=2**40,
        flush_num_rows=2**40,
    )
    rec = rr.RecordingStream(
        "vap", recording_id=recording_id, send_properties=False, batcher_config=config
    )
    rec.set_log_time_enabled(False)
    rec.save(temporary_path(path))
    return rec


def finish_stream(rec: rr.RecordingStream, path: Path) -> None:
    """Write the footer, then give the recording its name, if nothing has it at that moment.

    Raises: BadOutput, when it cannot be written whole, or a file of that name appeared meanwhile.
    """
    flush_stream(rec, path)
    rec.disconnect()
    scratch = temporary_path(path)
    try:
        open_whole(scratch)  # rerun only logs that a disk is full
    except UNREADABLE as error:
        raise _unwritten(path) from error
    with writing(path, "record"):
        try:
            take_name(scratch, path)
        except FileExistsError as error:
            raise BadOutput(
                f"record: {path} appeared meanwhile; this run's recording is kept as {scratch}."
            ) from error
    # Of killed processes that recorded it before.
    remove_scratch(path.parent, f".{escape(path.name)}.*tmp")


def flush_stream(rec: rr.RecordingStream, path: Path) -> None:
    """Write what was sent so far.

    Raises: BadOutput, when it cannot be written; nothing is left of the recording then.
    """
    _require_room(path)
    try:
        rec.flush()
    except RuntimeError as error:
        raise _unwritten(path) from error


def _require_room(path: Path) -> None:
    """Raises: BadOutput, where the disk has less than ROOM_BYTES left."""
    if shutil.disk_usage(path.parent).free < ROOM_BYTES:
        raise _unwritten(path)


def _unwritten(path: Path) -> BadOutput:
    """The error of a recording that has not become whole; its temporary file is removed."""
    temporary_path(path).unlink(missing_ok=True)
    return BadOutput(f"record: {path} cannot be written; make room and run the same command again.")


class StoredBlueprint(rrb.Blueprint):
    """A blueprint that ends the stream it is sent through.

    Rerun would keep one stream for each, with its threads, until the process ends.
    """

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        super()._log_to_stream(stream)
        self._stream = stream

    def send(self, rec: rr.RecordingStream) -> None:
        """Make it the layout that the recording opens with."""
        rec.send_blueprint(self)
        self._stream.disconnect()


def log_row(
    rec: rr.RecordingStream,
    entity: str,
    *archetypes: rr.AsComponents,
    at: Sequence[rr.TimeColumn] = (),
) -> None:
    """Write one row, static without `at`.

    As a column of its own it keeps its place in the file; `rec.log` may move it.
    """
    columns = [
        batch.partition([len(batch.as_arrow_array())])
        for archetype in archetypes
        for batch in archetype.as_component_batches()
    ]
    rec.send_columns(entity, at, columns)


def log_properties(rec: rr.RecordingStream, group: str, values: rr.AnyValues) -> None:
    """Recording properties are static components of a reserved entity."""
    log_row(rec, f"/__properties/{group}", values)


def time_columns(moments: Sequence[Moment]) -> list[rr.TimeColumn]:
    """The two timelines of a recording."""
    steps = []
    seconds = []
    for step, second in moments:
        steps.append(step)
        seconds.append(second)
    return [
        rr.TimeColumn("frame_index", sequence=steps),
        rr.TimeColumn("timestamp", duration=np.array(seconds, np.float64)),
    ]


def frame_times(frames: Sequence[Frame]) -> list[rr.TimeColumn]:
    """The time columns of frames."""
    return time_columns([(frame.frame_index, frame.timestamp_s) for frame in frames])
