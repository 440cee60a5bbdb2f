"""Corrections of a recording: a layer beside it, with the recording's own id.

The recording itself is never rewritten.
"""

import os
from dataclasses import dataclass, field
from pathlib import Path

import rerun as rr

from vap_core.base.errors import BadRecording, BadStudy, one_of
from vap_core.recording.reading import (
    property_group,
    read_chunks,
    read_properties,
    read_summary,
    recording_id,
)
from vap_core.recording.stream import finish_stream, log_properties, log_row, open_stream
from vap_core.rollout.failure import CASES

CORRECTIONS = "corrections"
"""The layer's name, and the folder beside `recordings` that holds its files."""


@dataclass(frozen=True)
class Correction:
    """What a researcher concluded: the case and sub-case of a failure, and a note why.

    `policy` is the label of the one that was recorded, "" where a layer does not say.
    """

    case: str
    sub_case: str
    note: str = ""
    policy: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if self.case not in CASES:
            raise one_of("correct: case", self.case, CASES)
        if self.sub_case not in CASES[self.case]:
            raise one_of(f"correct: sub-case of {self.case}", self.sub_case, CASES[self.case])

    def __str__(self) -> str:
        text = f"corrected to {self.case}, {self.sub_case}"
        return f"{text}: {self.note}" if self.note else text


def layer_path(recording: Path) -> Path:
    """Where the correction of a recording is."""
    return corrections_folder(recording.parent) / recording.name


def corrections_folder(recordings: Path) -> Path:
    """The folder beside a folder of recordings; also beside ".", which has no parent by name."""
    return Path(os.path.normpath(recordings / os.pardir / CORRECTIONS))


def write_correction(recording: Path, correction: Correction, frame_index: int) -> Path:
    """Write a correction of one recording, in place of an earlier one; returns the layer's path.

    The viewer and the catalog merge it with the recording, because both have the same id.

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

    Raises: BadRecording for one that is damaged.
    """
    paths = sorted((folder / CORRECTIONS).glob("*.rrd"))
    return {path.name: read_correction(path) for path in paths}


def read_correction(path: Path) -> Correction:
    """The correction of one layer. Raises: BadRecording, when it is damaged."""
    values = {}
    try:
        for chunk in read_chunks(path):
            if property_group(chunk) == "correction":
                values = read_properties(chunk)
        note, policy = values["case_sentence"], str(values.get("policy", ""))
        return Correction(values["case"], values["sub_case"], note, policy)
    except (RuntimeError, ValueError, OSError, KeyError) as error:
        raise BadRecording(
            f"corrections: {path} is damaged ({error}); delete it and correct that failure again."
        ) from error
