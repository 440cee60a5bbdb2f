"""weights verify: every stage of a stack is held against hand-drawn boxes of known photos."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.command import vap
from vap_core.evaluation.photos import verify
from vap_core.evaluation.photos.verify import ELECTED, FILLED, LEAD, Check, verify_stack
from vap_core.perception import stacks
from vap_core.perception.protocols import Stack


def test_the_embedded_stack_holds(capsys: pytest.CaptureFixture[str]) -> None:
    done = vap("weights", "verify", "--stack", "embedded")
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert lines[-1].startswith("5 of 5 hold; ")
    assert all(line.startswith("ok ") and "stored" in line for line in lines[:-1])


@pytest.mark.parametrize(
    ("part", "failed"),
    [
        ("encoder", LEAD),
        ("segmenter", FILLED),
    ],
)
def test_a_stage_that_does_nonsense_is_named(
    part: str, failed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    stack = stacks.load_stack("embedded")
    monkeypatch.setitem(stacks.STACKS, "embedded", lambda: with_nonsense(stack, part))
    checks, _ = verify_stack("embedded")
    assert failed in [check.what for check in checks if not check.holds]


def test_without_stored_figures_the_drawn_boxes_are_the_measure() -> None:
    assert Check(ELECTED, 0.6, None, 0.5).holds
    assert not Check(ELECTED, 0.4, None, 0.5).holds
    assert str(Check(ELECTED, 0.4, None, 0.5)).startswith("FAILED")
    assert not Check(ELECTED, 0.9, 0.24, 0.5).holds, "another answer than elsewhere"


def test_a_stack_without_stored_figures_is_said_to_have_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert set(verify.STORED) == {"embedded"}, "a foundation stack was measured: docs/stacks.md"
    monkeypatch.setattr(verify, "STORED", {})
    done = vap("weights", "verify", "--stack", "embedded")
    *checks, said, _ = done.stdout.splitlines()
    assert said.startswith("no figures of this stack are stored")
    assert all("at least" in check for check in checks)


def with_nonsense(stack: Stack, part: str) -> Stack:
    """The stack with an encoder that tells nothing apart, or a segmenter of the upper left corner."""
    if part == "segmenter":

        def corner(image: np.ndarray, boxes: object) -> np.ndarray:
            masks = np.zeros((len(boxes), *image.shape[:2]), bool)  # type: ignore[arg-type]
            masks[:, :9, :9] = True
            return masks

        return replace(stack, segmenter=corner)

    class Same:
        name = "same"

        def __call__(self, crops: list) -> np.ndarray:
            return np.tile(np.array([1, 0], np.float32), (len(crops), 1))

    return replace(stack, encoder=Same(), unfamiliar_encoder=None)


def test_without_weights_it_says_how_to_get_them(tmp_path: Path) -> None:
    done = vap("weights", "verify", "--stack", "foundation", env={"VAP_WEIGHTS": str(tmp_path)})
    assert done.returncode == 2
    assert "weights pull --stack foundation" in done.stderr
