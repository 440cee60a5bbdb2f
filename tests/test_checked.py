"""The check of signatures that every test runs under refuses what the annotations do not say."""

import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Float32

from tests.checked import _checked
from vap_core.base.errors import device_name
from vap_core.base.types import EVERY_STEP

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


def test_outside_of_tests_all_is_checked_but_what_a_loop_builds_at_every_step() -> None:
    code = (
        "import numpy as np\n"
        "from vap_core.base.types import Boxes, Track\n"
        "Track('not a mask', 0.5)\n"
        "Boxes(np.zeros((1, 4)) + [0, 0, 1, 1], np.ones(1, np.float32), 'cup')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "TypeCheckError" in done.stderr
    assert "called with argument xyxy" in done.stderr or "xyxy" in done.stderr
    core = "".join(path.read_text() for path in Path("vap_core").rglob("*.py"))
    for name in EVERY_STEP:
        assert f"@value\nclass {name}:" in core
