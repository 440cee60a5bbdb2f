"""What a researcher adds to a recording afterwards: a layer beside it, with the recording's own id. The recording itself is never rewritten."""

from dataclasses import dataclass
from pathlib import Path

import rerun as rr
from rerun.chunk import RrdReader

from vap_core.errors import BadRecording, BadStudy, one_of
from vap_core.failures import CASES
from vap_core.record.file import finish_stream, open_stream, put, put_property, read_summary

CORRECTIONS = "corrections"
"""The layer's name, and the folder beside `recordings` where its files lie."""


@dataclass(frozen=True)
class Correction:
    """What somebody found who looked: the case and sub-case that a failure really is, and in their words why."""

    case: str
    sub_case: str
    note: str = ""

    def __post_init__(self) -> None:
        if self.case not in CASES:
            raise one_of("correct: case", self.case, CASES)
        if self.sub_case not in CASES[self.case]:
            raise one_of(f"correct: sub-case of {self.case}", self.sub_case, CASES[self.case])


def layer_path(recording: Path) -> Path:
    """Where the corrections of a recording lie."""
    return recording.parent.parent / CORRECTIONS / recording.name


def correct(recording: Path, correction: Correction, frame_index: int) -> Path:
    """Keep a correction of one recording, in place of an earlier one; the viewer and the catalog merge it by the recording's id.

    Raises: BadRecording when the recording cannot be read; BadStudy when it tells of no failure.
    """
    summary = read_summary(recording)
    if summary.get("outcome.status") != "failure":
        raise BadStudy(f"correct: {recording.name} ended in {summary.get('outcome.status', 'nothing')}; only failures have a case.")
    path = layer_path(recording)
    fresh = path.with_name(f".{path.name}.new")
    fresh.unlink(missing_ok=True)
    rec = open_stream(fresh, _identity(recording))
    text = f"corrected to {correction.case}, {correction.sub_case}" + (f": {correction.note}" if correction.note else "")
    put_property(rec, "correction",
        rr.AnyValues(failure_case=correction.case, sub_case=correction.sub_case, why=correction.note or text, was=summary["outcome.failure_case"]),
    )  # fmt: skip
    put(rec, "/vap/events", rr.TextLog(text, level="ERROR"), at=[rr.TimeColumn("frame_index", sequence=[frame_index])])
    finish_stream(rec, fresh)
    fresh.replace(path)
    return path


def corrections(folder: Path) -> dict[str, Correction]:
    """Every correction in a run's folder, by the name of its recording. Raises: BadRecording for one that is damaged."""
    found = {}
    for path in sorted((folder / CORRECTIONS).glob("*.rrd")):
        held: dict[str, str] = {}
        try:
            for chunk in RrdReader(path).stream():
                if chunk.entity_path == "/__properties/correction":
                    batch = chunk.to_record_batch()
                    held = {name: batch[name][0].as_py()[0] for name in batch.schema.names if not name.startswith("rerun.")}
            found[path.name] = Correction(held["failure_case"], held["sub_case"], held["why"])
        except (RuntimeError, ValueError, OSError, KeyError) as error:
            raise BadRecording(f"corrections: {path} is damaged ({error}); delete it and correct that failure again.") from error
    return found


def _identity(recording: Path) -> str:
    return next(entry.recording_id for entry in RrdReader(recording).recordings())
