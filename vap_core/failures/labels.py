"""What can be said of a failed episode: its case, and where the rules that decide it draw their lines."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from vap_core.suites.rules import LIFT_M, MOVED_M
from vap_core.values import value

type Case = Literal["case 1", "case 2", "case 3", "unprompted", "unlabelled"]
CASES: dict[Case, tuple[str, ...]] = {
    "case 1": ("no proposal", "shifted proposal", "distractor vote", "poor mask", "drift"),
    "case 2": ("views disagree", "views drift apart"),
    "case 3": ("wrong object", "collision", "missed grasp", "slip", "misplacement", "timeout"),
    "unprompted": ("wrong object", "collision", "missed grasp", "slip", "misplacement", "timeout"),
    "unlabelled": ("nothing found", "lost track", "narrow vote", "no signal"),
}
"""Every sub-case of every case, in the order of the way from the picture to the hand."""


@dataclass(frozen=True)
class Limits:
    """Where the rules draw their lines.

    A mask is on the target from `iou` on; a view counts that shows at least `pixels` of it (of 224 x 224) or that highlights something; prompts
    are wrong that are wrong in at least `share` of the judged steps; a candidate proposes the target from a box IoU of `proposal` on. The target
    is carried when it is held and at least `lift_m` higher; an object is knocked when it moved by `moved_m`; the hand closes on the target
    when the gripper's command falls below `closed` with the tcp within `near_m` of its bounding box.
    """

    iou: float = 0.5
    pixels: float = 100.0
    share: float = 0.5
    proposal: float = 0.5
    lift_m: float = LIFT_M
    moved_m: float = MOVED_M
    near_m: float = 0.05
    closed: float = 0.5


LIMITS = Limits()
NEIGHBOURS: dict[str, tuple[float, float]] = {
    "iou": (0.35, 0.65),
    "pixels": (50.0, 200.0),
    "share": (0.34, 0.67),
    "proposal": (0.35, 0.65),
    "lift_m": (0.005, 0.02),
    "moved_m": (0.02, 0.05),
    "near_m": (0.03, 0.08),
    "closed": (0.35, 0.65),
}
"""One limit at a time, stricter and laxer."""


@value
class Diagnosis:
    """Why one episode failed. `camera` is "" where none decides; `sentence` says it in words; `evidence` in numbers and names."""

    case: Case
    sub_case: str
    frame_index: int
    camera: str
    evidence: Mapping[str, float | str]
    confidence: float
    sentence: str

    def columns(self) -> dict[str, Any]:
        """Its part of a row of a results table."""
        evidence = {name: round(part, 4) if isinstance(part, float) else part for name, part in self.evidence.items()}
        return {
            "case": self.case, "sub_case": self.sub_case, "deciding_frame": self.frame_index, "deciding_camera": self.camera,
            "case_confidence": self.confidence, "case_sentence": self.sentence, "case_evidence": json.dumps(evidence),
        }  # fmt: skip


NONE: dict[str, Any] = {
    "case": "", "sub_case": "", "deciding_frame": -1, "deciding_camera": "", "case_confidence": float("nan"), "case_sentence": "",
    "case_evidence": "",
}  # fmt: skip
"""Of an episode that did not fail."""


def neighbours(limits: Limits) -> Iterator[Limits]:
    """`limits` with one of them changed, twice for each."""
    for name, values in NEIGHBOURS.items():
        for each in values:
            yield replace(limits, **{name: each})
