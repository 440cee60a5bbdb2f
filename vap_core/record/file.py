"""The file of a recording: its name, its growing temporary, its rescue after a kill, its summary."""

import re
import subprocess
import sys
import warnings
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings
from rerun.chunk import RrdReader

from vap_core.errors import BadOutput, BadRecording
from vap_core.values import EpisodeRow


def recording_name(row: EpisodeRow, method: str) -> str:
    """The file name of an episode's recording, e.g. `simpler-bridge.put-owl.003.s7.vap.rrd`."""
    return file_name(row.suite, row.task, row.episode, row.seed, method)


def file_name(suite: str, task: str, episode: int, seed: int, method: str) -> str:
    """The same from what a results table says."""
    return re.sub(r"[^\w.+-]+", "-", f"{suite}.{task}.{episode:03d}.s{seed}.{method}").strip("-.") + ".rrd"


def temporary(path: Path) -> Path:
    """Where a recording grows until it is finished: same folder, leading dot, and no `.rrd` at its end."""
    return path.with_name(f".{path.name}.tmp")


def open_stream(path: Path, recording_id: str) -> rr.RecordingStream:
    """A stream into `temporary(path)` that flushes only when told, so that equal runs give equal chunks.

    Raises: BadOutput, when `path` exists or its folder cannot be written.
    """
    if path.exists():
        raise BadOutput(f"record: {path} already exists and is never overwritten; choose another folder or remove it.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary(path).write_bytes(b"")
    except OSError as err:
        raise BadOutput(f"record: cannot write in {path.parent} ({err.strerror}); choose a folder you may write to.") from err
    rerun_bindings.flush_and_cleanup_orphaned_recordings()  # else every finished recording keeps its threads and some megabytes
    config = rr.ChunkBatcherConfig(flush_tick=timedelta(days=365), flush_num_bytes=2**40, flush_num_rows=2**40)
    rec = rr.RecordingStream("vap", recording_id=recording_id, send_properties=False, batcher_config=config)
    rec.set_log_time_enabled(False)
    rec.save(temporary(path))
    return rec


class Layout(rrb.Blueprint):
    """A blueprint that ends the stream it is sent through: rerun keeps one of each, with its threads, until the process ends."""

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        super()._log_to_stream(stream)
        self._through = stream

    def send(self, rec: rr.RecordingStream) -> None:
        """Make it what the recording opens with."""
        rec.send_blueprint(self)
        self._through.disconnect()


def put(rec: rr.RecordingStream, entity: str, *parts: rr.AsComponents, at: Sequence[rr.TimeColumn] = ()) -> None:
    """Write one row, static without `at`. As a column of its own it keeps its place in the file; `rec.log` would shuffle."""
    batches = [batch for part in parts for batch in part.as_component_batches()]
    rec.send_columns(entity, at, [batch.partition([len(batch.as_arrow_array())]) for batch in batches])


def put_property(rec: rr.RecordingStream, name: str, values: rr.AnyValues) -> None:
    """Recording properties are static components of a reserved entity."""
    put(rec, f"/__properties/{name}", values)


def finish_stream(rec: rr.RecordingStream, path: Path) -> None:
    """Write the footer, then give the recording its name."""
    rec.flush()
    rec.disconnect()
    if path.exists():
        raise BadOutput(f"record: {path} appeared meanwhile; this run's recording is kept as {temporary(path)}.")
    temporary(path).replace(path)


def rerun_cli(*words: str | Path) -> list[str]:
    """A command line of the rerun that this environment holds."""
    return [sys.executable, "-m", "rerun", *map(str, words)]


def recover(leftover: Path) -> Path:
    """Mend the temporary file that a killed process left, and give it the name of a recording; returns that path.

    It holds every step up to the last flush, and no outcome.

    Raises: BadOutput, when the recording exists; BadRecording, when nothing can be saved.
    """
    leftover = Path(leftover)
    path = leftover.with_name(leftover.name.removeprefix(".").removesuffix(".tmp"))
    if leftover != temporary(path) or not leftover.is_file():
        raise BadRecording(f"recover: {leftover} is no leftover of a recording; expected an existing file named like {temporary(path).name}.")
    if path.exists():
        raise BadOutput(f"recover: {path} already exists and is never overwritten; {leftover} was left as it is.")
    mended = leftover.with_name(f".{path.name}.mended")
    done = subprocess.run(rerun_cli("rrd", "optimize", leftover, "-o", mended), capture_output=True, text=True, check=False)
    try:
        if done.returncode or not mended.is_file():
            raise unreadable(leftover, done.stderr)
        read_summary(mended)
        mended.replace(path)
    finally:
        mended.unlink(missing_ok=True)
    leftover.unlink()
    return path


def read_summary(path: Path) -> dict[str, Any]:
    """Properties as `rollout.<name>` and `outcome.<name>`, and `frames`, the number of recorded steps.

    Raises: BadRecording, when the file is missing, damaged, or no recording.
    """
    path = Path(path)
    if not path.is_file():
        raise BadRecording(f"read_summary: there is no recording at {path}.")
    summary: dict[str, Any] = {}
    steps: set[int] = set()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # rerun only warns when a footer is missing: such a file was never finished
            for chunk in RrdReader(path).stream():
                batch = chunk.to_record_batch()
                group = chunk.entity_path.removeprefix("/__properties/")
                if group in ("rollout", "outcome"):
                    held = {name: batch[name][0].as_py() for name in batch.schema.names if not name.startswith("rerun.")}
                    summary |= {f"{group}.{name}": cells[0] if cells else None for name, cells in held.items()}
                elif "frame_index" in batch.schema.names:
                    steps.update(batch["frame_index"].to_pylist())
    except (RuntimeError, ValueError, OSError, Warning) as err:
        raise unreadable(path, err) from err
    return {**summary, "frames": len(steps)}


def unreadable(path: Path, why: object) -> BadRecording:
    reason = " ".join(str(why).split())[-160:]
    return BadRecording(f"{path} cannot be read as a recording ({reason}); `rerun rrd optimize {path} -o mended.rrd` saves what can be saved.")
