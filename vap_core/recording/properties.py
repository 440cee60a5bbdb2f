"""The properties of a recording, named like the columns of a results table.

Group `rollout` says what ran, group `outcome` how it ended and, for a failure, why.
"""

from typing import Any

import numpy as np
import rerun as rr

from vap_core.base.version import code_version
from vap_core.rollout.failure import Diagnosis
from vap_core.rollout.types import EpisodeHeader
from vap_core.simulation.types import Outcome


def rollout_properties(header: EpisodeHeader) -> rr.AnyValues:
    """What is known before the first action."""
    row = header.row
    return rr.AnyValues(
        suite=row.suite,
        task=row.task,
        episode=row.episode,
        method=header.method,
        policy=header.policy,
        seed=row.seed,
        git=code_version(),
        hz=header.hz,
        instruction=header.instruction,
        rewritten=header.rewritten,
    )


def outcome_properties(outcome: Outcome, diagnosis: Diagnosis | None) -> rr.AnyValues:
    """How the episode ended; the case of a failure, empty for any other episode."""
    return rr.AnyValues(
        outcome=outcome.status,
        success=outcome.success,
        cmr=outcome.cmr,
        steps=outcome.steps,
        success_once=outcome.success_once,
        held_steps=outcome.held_steps,
        wrong_object=outcome.wrong_object,
        first_object_correct=outcome.first_object_correct,
        detail=outcome.detail,
        **_case_properties(diagnosis),
    )


def _case_properties(diagnosis: Diagnosis | None) -> dict[str, Any]:
    if diagnosis is None:
        return {
            "case": "",
            "sub_case": "",
            "deciding_frame": np.int64(-1),
            "deciding_camera": "",
            "case_confidence": 0.0,
            "case_sentence": "",
        }
    return {
        "case": diagnosis.case,
        "sub_case": diagnosis.sub_case,
        "deciding_frame": np.int64(diagnosis.frame_index),
        "deciding_camera": diagnosis.camera,
        "case_confidence": diagnosis.confidence,
        "case_sentence": diagnosis.sentence,
    }
