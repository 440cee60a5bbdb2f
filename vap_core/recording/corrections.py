"""Corrections of a recording: a layer beside it, with the recording's own id.

The recording itself is never rewritten.
"""

import os
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import rerun as rr

from vap_core.base.errors import BadRecording, BadStudy
from vap_core.recording.isolated import read_layers
from vap_core.recording.layers import Correction as Correction
from vap_core.recording.reading import list_files, read_summary, recording_id
from vap_core.recording.stream import finish_stream, log_properties, log_row, open_stream

CORRECTIONS = "corrections"
"""The layer's name, and the folder beside `recordings` that holds its files."""


def layer_path(recording: Path) -> Path:
    """Where the correction of a recording is."""
    return corrections_folder(recording.parent) / recording.name


def corrections_folder(recordings: Path) -> Path:
    """The folder beside a folder of recordings; also beside ".", which has no parent by name."""
    return Path(os.path.normpath(recordings / os.pardir / CORRECTIONS))


def write_correction(recording: Path, correction: Correction, frame_index: int) -> Path:
    """Write a correction of one recording, in place of an earlier one; returns the layer's path.

    The viewer merges it with the recording, because both have the same id.

    Raises: BadRecording when the recording cannot be read; BadStudy when it is of no failure.
    """
    summary = read_summary(recording)
    if summary.get("outcome") != "failure":
        raise BadStudy(
            f"correct: {recording.name} ended in {summary.get('outcome', 'nothing')}; "
            "only failures have a case."
        )
    path = layer_path(recording)
    unfinished = path.with_name(f".{path.name}.new")
    unfinished.unlink(missing_ok=True)
    rec = open_stream(unfinished, recording_id(recording))
    values = rr.AnyValues(
        case=correction.case,
        sub_case=correction.sub_case,
        case_sentence=correction.note or str(correction),
        was=summary["case"],
        policy=summary.get("policy", ""),
    )
    log_properties(rec, "correction", values)
    event = rr.TextLog(str(correction), level="ERROR")
    at = [rr.TimeColumn("frame_index", sequence=[frame_index])]
    log_row(rec, "/vap/events", event, at=at)
    finish_stream(rec, unfinished)
    unfinished.replace(path)
    return path


def read_corrections(folder: Path) -> dict[str, Correction]:
    """Every correction in a run's folder, by the name of its recording.

    Raises: BadRecording for one that is damaged, and for what may not be read.
    """
    corrections = {}
    layers = list_files(folder / CORRECTIONS)
    with closing(read_layers(layers)) as read:
        for path, correction, reason in read:
            if correction is None:
                raise BadRecording(reason)
            corrections[path.name] = correction
    return corrections


def read_corrections_of(
    failures: Mapping[Path, Path], unreadable: dict[Path, str]
) -> dict[Path, Correction]:
    """The correction of every recorded failure that has one; each has what to read its id from.

    A layer of another id does not count: of a recording that has been made again with another
    policy, or copied from another recording's. Layers are read in a process of their own; one that
    is damaged is named in `unreadable`.

    Raises: BadRecording for a folder of corrections without rights.
    """
    there: set[Path] = set()
    for folder in {path.parent for path in failures}:
        there.update(list_files(corrections_folder(folder)))
    recordings = {layer_path(path): path for path in failures if layer_path(path) in there}
    corrections = {}
    for layer, correction, reason in read_layers(list(recordings)):
        recording = recordings[layer]
        if correction is None:
            unreadable[layer] = reason
        elif correction.recording == recording_id(failures[recording]):
            corrections[recording] = correction
    return corrections
