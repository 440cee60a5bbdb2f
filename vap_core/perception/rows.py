"""What is wrong with the rows of an encoder, in one line that names its contract test."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from vap_core.base.errors import BadEncoder
from vap_core.base.types import Rgb
from vap_core.perception.protocols import Encoder

LENGTH_TOLERANCE = 1e-3
"""How far from 1 an embedding's length may be."""


def embed_crops(what: str, encoder: Encoder, crops: Sequence[Rgb]) -> Float32[np.ndarray, "n d"]:
    """The rows of an encoder, as the protocol has them; their numbers may be any.

    Raises: BadEncoder: they are no NumPy array of type float32 with one row a crop; the message
        begins with `what`.
    """
    rows = encoder(crops)
    fault = _form_fault(rows, len(crops))
    if fault:
        raise BadEncoder(describe_fault(what, encoder, fault))
    return rows


def _form_fault(rows: object, n: int) -> str:
    """What keeps a value from being the rows of `n` crops, "" where nothing does."""
    if not isinstance(rows, np.ndarray):
        return f"{type(rows).__name__}, not a NumPy array"
    if rows.ndim != 2 or rows.dtype != np.float32:
        return f"an array of shape {rows.shape} and type {rows.dtype}, not float32 (crops, width)"
    return "" if len(rows) == n else f"{len(rows)} rows for {n} crops"


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
