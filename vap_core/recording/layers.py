"""What a layer of corrections holds, and reading one in this process."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vap_core.base.errors import BadRecording, UnknownName, one_of
from vap_core.recording.reading import (
    UNREADABLE,
    property_group,
    read_chunks,
    read_properties,
    recording_id,
    refused,
)
from vap_core.rollout.failure import CASES


@dataclass(frozen=True)
class Correction:
    """What a researcher concluded: the case and sub-case of a failure, and a note why.

    `policy` is the label of the one that was recorded, "" where a layer does not say; `recording`
    is the id of the recording that a layer is of, "" where this is of none.
    """

    case: str
    sub_case: str
    note: str = ""
    policy: str = field(default="", compare=False)
    recording: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if self.case not in CASES:
            raise one_of("correct: case", self.case, CASES)
        if self.sub_case not in CASES[self.case]:
            raise one_of(f"correct: sub-case of {self.case}", self.sub_case, CASES[self.case])

    def __str__(self) -> str:
        text = f"corrected to {self.case}, {self.sub_case}"
        return f"{text}: {self.note}" if self.note else text


def read_correction(path: Path) -> Correction:
    """The correction of one layer, read in this process: damaged bytes can end it.

    Raises: BadRecording, when it is damaged, or may not be read.
    """
    values: dict[str, Any] = {}
    try:
        for chunk in read_chunks(path):
            if property_group(chunk) == "correction":
                values = read_properties(chunk)
        values.setdefault("policy", "")
        for name in ("case", "sub_case", "case_sentence", "policy"):
            if not isinstance(values[name], str):
                raise ValueError(f"its {name} is {str(values[name])[:40]!r}")
        return Correction(
            case=values["case"],
            sub_case=values["sub_case"],
            note=values["case_sentence"],
            policy=values["policy"],
            recording=recording_id(path),
        )
    except PermissionError as error:
        raise refused(path, error) from error
    except (*UNREADABLE, LookupError, UnknownName) as error:
        raise damaged_layer(path, error) from error


def damaged_layer(path: Path, reason: object) -> BadRecording:
    """The error of a layer that holds no correction."""
    line = " ".join(str(reason).split())[-160:]
    return BadRecording(
        f"corrections: {path} is damaged ({line}); delete it and correct that failure again."
    )
