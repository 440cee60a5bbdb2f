"""What is wrong with the rows of an encoder, in one line that names its contract test."""

import numpy as np
from jaxtyping import Float32

from vap_core.perception.protocols import Encoder

LENGTH_TOLERANCE = 1e-3
"""How far from 1 an embedding's length may be."""


def row_fault(rows: Float32[np.ndarray, "n _d"], references: Float32[np.ndarray, "k _e"]) -> str:
    """What is wrong with the rows of crops, "" where nothing is."""
    if rows.shape[1] != references.shape[1]:
        return f"{rows.shape[1]} numbers a crop, and {references.shape[1]} for the references"
    if not np.isfinite(rows).all():
        return "numbers that are not finite"
    length = np.linalg.norm(rows, axis=1)
    far = np.abs(length - 1) > LENGTH_TOLERANCE
    return f"a row of length {length[far][0]:.3g}, not of length 1" if far.any() else ""


def describe_fault(what: str, encoder: Encoder, fault: str) -> str:
    """The line about an encoder that gave `fault` when `what` asked it."""
    return (
        f"{what}: encoder {encoder.name!r} gave {fault}; test it with "
        "pytest --pyargs vap_core.contracts --encoder MODULE:NAME."
    )
