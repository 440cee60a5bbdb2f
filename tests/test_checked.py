"""The check of signatures that every test runs under refuses what the annotations do not say."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Float32

from tests.checked import _checked
from vap_core.base.errors import device_name

Points = Float32[np.ndarray, "n 2"]


@_checked
def gaps(one: Points, other: "Points") -> Float32[np.ndarray, " n"]:
    return np.linalg.norm(one - other[: len(one)], axis=1)


@_checked
def first(points: Points, n: int = 1) -> Float32[np.ndarray, " n"]:
    return points[:n, 0]


@_checked
def unknown(value: "OnlyForTypeCheckers") -> int:
    return len(value)


@_checked
@dataclass(frozen=True)
class Track:
    points: Points
    seen: Float32[np.ndarray, " n"]


def of(n: int) -> np.ndarray:
    return np.zeros((n, 2), np.float32)


def test_dimensions_of_one_name_are_compared_within_a_call_and_between_calls_not() -> None:
    assert gaps(of(3), of(3)).shape == (3,)
    assert gaps(of(2), of(2)).shape == (2,)
    with pytest.raises(BeartypeCallHintViolation):
        gaps(of(2), of(3))
    with pytest.raises(BeartypeCallHintViolation):
        first(of(3))


def test_types_of_arguments_and_results_are_checked() -> None:
    with pytest.raises(BeartypeCallHintViolation):
        gaps(of(2).astype(np.float64), of(2))
    with pytest.raises(BeartypeCallHintViolation):
        device_name(3)  # type: ignore[arg-type]
    assert unknown("abc") == 3, "what is imported for type checkers only is anything"


def test_a_dataclass_is_checked_when_it_is_built() -> None:
    track = Track(of(2), np.zeros(2, np.float32))
    with pytest.raises(BeartypeCallHintViolation):
        replace(track, seen=np.zeros(3, np.float32))
