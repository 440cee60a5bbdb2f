"""The index of a recording: its properties and one row of numbers per step, in a small file.

A query reads these instead of the recordings: a thousand of them in seconds.
"""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from rerun.chunk import Chunk, RrdReader

from vap_core.base.errors import BadRecording
from vap_core.base.files import sha256_of
from vap_core.recording.file import temporary_path
from vap_core.recording.reading import (
    KINDS,
    PROPERTIES,
    UNREADABLE,
    open_whole,
    property_group,
    read_checked_properties,
)
from vap_core.recording.stream import finish_stream, log_properties, open_stream

CURVES = {
    "margin": "/vap/vote_margin/",
    "track_score": "/vap/track_score/",
    "gap_cm": "/vap/hand/gripper",
    "lift_cm": "/vap/hand/target",
}
"""Columns of each step, and what their entities begin with; of several views the least counts."""
STEPS = "/steps"
"""The entity of an index that holds the columns."""
STATE = "/observation.state"
"""What every recording has at every step."""
GROUPS = ("rollout", "outcome")
"""The property groups of an index: of each what `KINDS` names, always as the same types."""
INDEXED_ENTITIES = [
    *(f"{PROPERTIES}/{group}" for group in GROUPS),
    STATE,
    "/vap/vote_margin/**",
    "/vap/track_score/**",
    "/vap/hand/**",
]
FOLDER = ".index-2"
"""Beside recordings; the number grows when what an index holds changes."""
DIGITS = 16
"""How much of its SHA-256 the name of an index says."""
SUFFIX = ".rrd"

type Samples = list[tuple[np.ndarray, np.ndarray]]
"""Steps and values, once per chunk."""


def ensure_index(recording: Path, folder: Path | None = None) -> Path:
    """The index of a recording, in FOLDER beside it or in `folder`; written where there is none.

    Its name has the recording's size in bytes, so that another recording gets another index, and a
    checksum of its own bytes, so that a damaged one is made again.

    Raises: BadRecording when the recording cannot be read, or is none of an episode.
    """
    found = find_indexes([recording], folder).get(recording)
    if found is not None:
        return found
    try:
        name = _name(recording)
        return _write_index(recording, _place(recording, folder), name)
    except UNREADABLE as error:
        raise BadRecording(str(error).splitlines()[0][:160]) from error


def find_indexes(recordings: Iterable[Path], folder: Path | None = None) -> dict[Path, Path]:
    """The index of every recording that has a whole one; those that are damaged are removed."""
    listed: dict[Path, dict[str, list[Path]]] = {}
    found = {}
    for recording in recordings:
        place = _place(recording, folder)
        if place not in listed:
            listed[place] = _list_indexes(place)
        with suppress(OSError):
            for index in listed[place].get(_name(recording), ()):
                if index.name == _kept_name(_name(recording), index):
                    found[recording] = index
                else:
                    index.unlink()
    return found


def _place(recording: Path, folder: Path | None) -> Path:
    return folder or recording.parent / FOLDER


def _name(recording: Path) -> str:
    """How the names of a recording's indexes begin. Raises: OSError, when it is not there."""
    return f"{recording.stem}.{recording.stat().st_size}"


def _kept_name(name: str, index: Path) -> str:
    """The name under which an index is kept; it says its checksum. Raises: OSError."""
    return f"{name}.{sha256_of(index)[:DIGITS]}{SUFFIX}"


def _list_indexes(place: Path) -> dict[str, list[Path]]:
    """The indexes of a folder, by how their names begin; none where it may not be entered."""
    by_name: dict[str, list[Path]] = {}
    with suppress(OSError):
        for path in sorted(place.glob(f"*.{'?' * DIGITS}{SUFFIX}")):
            by_name.setdefault(path.name[: -DIGITS - len(SUFFIX) - 1], []).append(path)
    return by_name


def _write_index(recording: Path, place: Path, name: str) -> Path:
    reader = open_whole(recording)
    recording_id = reader.recordings()[0].recording_id
    properties, state, curves = _read_indexed(reader)
    if "rollout" not in properties or not state:
        raise ValueError("no recording of an episode")
    steps = np.unique(np.concatenate([frame_indices for frame_indices, _ in state]))
    columns: dict[str, Any] = {
        curve: _least_per_step(steps, samples) for curve, samples in curves.items()
    }
    unnamed = temporary_path(place / f"{name}{SUFFIX}")
    unnamed.unlink(missing_ok=True)
    rec = open_stream(unnamed, recording_id)
    for group, values in properties.items():
        if values:
            log_properties(rec, group, rr.AnyValues(**values))
    index = [rr.TimeColumn("frame_index", sequence=steps)]
    rec.send_columns(STEPS, index, rr.AnyValues.columns(**columns))
    finish_stream(rec, unnamed)
    path = place / _kept_name(name, unnamed)
    unnamed.replace(path)
    return path


def _read_indexed(
    reader: RrdReader,
) -> tuple[dict[str, dict[str, Any]], Samples, dict[str, Samples]]:
    """The properties by group, the state's samples, and those of every curve."""
    properties: dict[str, dict[str, Any]] = {}
    state: Samples = []
    curves: dict[str, Samples] = {name: [] for name in CURVES}
    for chunk in reader.store().stream().filter(content=INDEXED_ENTITIES):
        group = property_group(chunk)
        if group in GROUPS:
            properties.setdefault(group, {}).update(_typed_properties(chunk))
        elif chunk.is_static:
            continue
        elif chunk.entity_path.startswith(STATE):
            state.append(_samples(chunk))
        else:
            for name, prefix in CURVES.items():
                if chunk.entity_path.startswith(prefix):
                    curves[name].append(_samples(chunk))
    return properties, state, curves


def _typed_properties(chunk: Chunk) -> dict[str, Any]:
    """What KINDS names, every number that may be a float as one.

    One catalog holds all indexes of a run, and a column of it has one type.

    Raises: ValueError, as `read_checked_properties`.
    """
    values = {}
    for name, value in read_checked_properties(chunk).items():
        if name in KINDS:
            values[name] = float(value) if KINDS[name] == (int, float) else value
    return values


def _samples(chunk: Chunk) -> tuple[np.ndarray, np.ndarray]:
    batch = chunk.to_record_batch()
    steps = batch["frame_index"].to_numpy(zero_copy_only=False)
    return steps, batch["Scalars:scalars"].flatten().to_numpy()


def _least_per_step(steps: np.ndarray, samples: Samples) -> np.ndarray:
    """The least of all views at every step, nan where there is none."""
    least = np.full(len(steps), np.nan)
    for frame_indices, values in samples:
        np.fmin.at(least, np.searchsorted(steps, frame_indices), values)
    return least
