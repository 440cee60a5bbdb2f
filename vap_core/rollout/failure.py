"""The diagnosis of a failed episode: its case, and the trace that explains it.

The rules are in study.diagnosis.
"""

import json
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from vap_core.base.types import value
from vap_core.rollout.types import Episode, MaskCoverage

type Case = Literal["case 1", "case 2", "case 3", "unprompted", "unlabelled"]
MANIPULATION = ("wrong object", "collision", "missed grasp", "slip", "misplacement", "timeout")
CASES: dict[Case, tuple[str, ...]] = {
    "case 1": (
        "no proposal",
        "not in view",
        "shifted proposal",
        "distractor vote",
        "poor mask",
        "drift",
    ),
    "case 2": ("views disagree", "views drift apart"),
    "case 3": MANIPULATION,
    "unprompted": MANIPULATION,
    "unlabelled": ("nothing found", "not in view", "lost track", "narrow vote", "no signal"),
}
"""Every sub-case of every case, from perception to manipulation."""


@value
class Diagnosis:
    """Why one episode failed.

    It has the deciding frame and camera ("" where none decides), a sentence, and evidence in
    numbers and names.
    """

    case: Case
    sub_case: str
    frame_index: int
    camera: str
    evidence: Mapping[str, float | str]
    confidence: float
    sentence: str

    def columns(self) -> dict[str, Any]:
        """Its part of a row of a results table."""
        evidence = {}
        for name, part in self.evidence.items():
            evidence[name] = round(part, 4) if isinstance(part, float) else part
        return {
            "case": self.case,
            "sub_case": self.sub_case,
            "deciding_frame": self.frame_index,
            "deciding_camera": self.camera,
            "case_confidence": self.confidence,
            "case_sentence": self.sentence,
            "case_evidence": json.dumps(evidence),
        }


NO_DIAGNOSIS: dict[str, Any] = {
    "case": "",
    "sub_case": "",
    "deciding_frame": -1,
    "deciding_camera": "",
    "case_confidence": float("nan"),
    "case_sentence": "",
    "case_evidence": "",
}
"""The columns of an episode that did not fail."""


@value
class EpisodeTrace:
    """What the diagnosis reads, one entry per recorded step.

    Nothing in it depends on a threshold. `others` are the objects other than target and goal that
    the robot touched in a step, `touches` says whether the target was one. `gap_m` is the distance
    of the tcp from the target's bounding box, `lift_m` how much higher each object is than at
    first, `moved_m` how far it has moved. `grip` is the gripper's command, 0 closed .. 1 open, nan
    at the terminal frame, which has none. `candidates` counts proposals by camera; `rejected` are
    the cameras in which the method says that the target is not in view, `overruled` those in which
    something else than the vote chose the candidate.
    """

    target: str
    rule: str
    steps: tuple[int, ...]
    coverage: tuple[tuple[MaskCoverage, ...], ...]
    others: tuple[tuple[str, ...], ...]
    touches: tuple[bool, ...]
    held: tuple[frozenset[str], ...]
    gap_m: Float64[np.ndarray, " t"]
    lift_m: Mapping[str, Float64[np.ndarray, " t"]]
    moved_m: Mapping[str, Float64[np.ndarray, " t"]]
    grip: Float64[np.ndarray, " t"]
    candidates: Mapping[str, int]
    prompted: bool
    rejected: frozenset[str] = frozenset()
    overruled: frozenset[str] = frozenset()


@value
class Explanation:
    """The trace of an episode, where there is ground truth, and its diagnosis, where it failed."""

    trace: EpisodeTrace | None
    diagnosis: Diagnosis | None


type Explain = Callable[[Episode], Explanation]
