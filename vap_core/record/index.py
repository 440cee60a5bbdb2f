"""What a query asks of a recording, in a small file beside it: properties, and a row of numbers per step. A thousand of these are read in seconds."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from rerun.chunk import Chunk, RrdReader

from vap_core.errors import BadOutput, BadRecording
from vap_core.record.file import finish_stream, open_stream, temporary

CURVES = {"margin": "/vap/vote_margin/", "track_score": "/vap/track_score/", "gap_cm": "/vap/hand/gripper", "lift_cm": "/vap/hand/target"}
"""Columns of each step, and where their entities begin; of several views the least counts."""
STEPS, STATE = "/steps", "/observation.state"
"""Where the numbers stand in an index; and what every recording has at every step."""
READ = ["/__properties/**", STATE, "/vap/vote_margin/**", "/vap/track_score/**", "/vap/hand/**"]
FOLDER = ".index-1"
"""Beside recordings; counted on when what stands in it changes."""


def index(recording: Path, folder: Path | None = None) -> Path:
    """The index of a recording, in FOLDER beside it or in `folder`, its name and its size in bytes; written where there is none.

    Raises: BadRecording when the recording cannot be read, or is none of an episode.
    """
    place = folder or recording.parent / FOLDER
    try:
        path = place / f"{recording.stem}.{recording.stat().st_size}.rrd"
        if not path.exists():
            temporary(path).unlink(missing_ok=True)
            _write(recording, path)
    except BadOutput:
        if not path.exists():  # written by another process meanwhile
            raise
    except (RuntimeError, ValueError, OSError, Warning) as error:
        raise BadRecording(str(error).splitlines()[0][:160]) from error
    return path


def _write(recording: Path, path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # without a footer it warns, and can read nothing by itself
        reader = RrdReader(recording)
    held, store = reader.recordings(), reader.store()
    about: list[Chunk] = []
    parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {name: [] for name in (STATE, *CURVES)}
    for chunk in store.stream().filter(content=READ):
        if chunk.entity_path.startswith("/__properties"):
            about.append(chunk)
        elif not chunk.is_static:
            batch = chunk.to_record_batch()
            part = batch["frame_index"].to_numpy(zero_copy_only=False), batch["Scalars:scalars"].flatten().to_numpy()
            for name, place in {STATE: STATE, **CURVES}.items():
                if chunk.entity_path.startswith(place):
                    parts[name].append(part)
    if not any(chunk.entity_path == "/__properties/rollout" for chunk in about) or not parts[STATE]:
        raise ValueError("no recording of an episode")
    steps = np.unique(np.concatenate([at for at, _ in parts.pop(STATE)]))
    rec = open_stream(path, held[0].recording_id)
    rec.send_chunks(about)
    columns: dict[str, Any] = {name: _least(steps, of_views) for name, of_views in parts.items()}
    rec.send_columns(STEPS, [rr.TimeColumn("frame_index", sequence=steps)], rr.AnyValues.columns(**columns))
    finish_stream(rec, path)


def _least(steps: np.ndarray, of_views: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The least of all views at every step, nan where there is none."""
    found = np.full(len(steps), np.nan)
    for at, values in of_views:
        np.fmin.at(found, np.searchsorted(steps, at), values)
    return found
