"""What a recording draws: labels of boxes, rims of masks, and the still picture of one."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drawn import SIDE
from vap_core.base.errors import MissingGL
from vap_core.recording import screenshot
from vap_core.recording.entities.pictures import class_image
from vap_core.recording.entities.votes import are_disjoint, place_labels
from vap_core.rollout.types import EpisodeHeader, Frame


@given(st.lists(st.tuples(st.integers(0, 200), st.integers(0, 200)), min_size=1, max_size=8))
@settings(max_examples=60, deadline=None)
def test_labels_never_overlap(corners: list[tuple[int, int]]) -> None:
    xyxy = np.array([[x, y, x + 20, y + 20] for x, y in corners], np.float32)
    labels = [f"#{i} v1" for i in range(len(corners) - 1)] + ["#7 0.71 · votes 4 of 5 · cos 0.80"]
    spots = place_labels(xyxy, labels, (SIDE, SIDE))
    unit = SIDE / 170
    wide = {i: (6.6 * len(labels[i]) + 12) * unit for i in spots}
    rects = [(x - wide[i] / 2, y, x + wide[i] / 2, y + 21 * unit) for i, (x, y) in spots.items()]
    assert len(labels) - 1 in spots
    assert all(
        are_disjoint(a, (b[0] + 1e-6, b[1] + 1e-6, b[2] - 1e-6, b[3] - 1e-6))
        for i, a in enumerate(rects)
        for b in rects[:i]
    )


def test_class_image_marks_inside_and_rim() -> None:
    mask = np.zeros((9, 9), bool)
    mask[2:7, 2:7] = True
    image = class_image(mask, 3, 1)
    assert (image[3:6, 3:6] == 3).all()
    assert (image > 0).sum() == 25
    assert (image == 4).sum() == 16


def test_screenshot_draws_the_recording(
    tmp_path: Path, three: tuple[Path, EpisodeHeader, list[Frame]]
) -> None:
    try:
        screenshot(three[0], tmp_path / "one.png", frame_index=6, size=(800, 500))
    except MissingGL:
        pytest.skip("no graphics driver on this machine")
    picture = cv2.imread(str(tmp_path / "one.png"))
    assert picture.shape == (500, 800, 3)
    assert picture.std() > 15


def test_screenshot_without_a_driver_names_the_package(
    tmp_path: Path, three: tuple[Path, EpisodeHeader, list[Frame]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VK_DRIVER_FILES", "/nonexistent.json")
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nonexistent.json")
    with pytest.raises(MissingGL, match="apt-get install -y mesa-vulkan-drivers") as caught:
        screenshot(three[0], tmp_path / "one.png")
    assert "\n" not in str(caught.value)


def test_screenshot_asks_for_a_driver_before_a_viewer_is_started(
    tmp_path: Path, three: tuple[Path, EpisodeHeader, list[Frame]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It started one, and waited until that failed."""
    monkeypatch.setattr("vap_core.recording.show.has_driver", lambda: False)
    monkeypatch.setattr("vap_core.recording.show.subprocess", None)
    with pytest.raises(MissingGL, match="apt-get install -y mesa-vulkan-drivers"):
        screenshot(three[0], tmp_path / "one.png")


def test_a_user_without_a_name_and_a_home_is_told_of_the_driver() -> None:
    """`Path.home` raised."""
    code = (
        "import os, pwd; pwd.getpwuid = {}.__getitem__; import vap_core.recording.show as show; "
        "os.environ.pop('VK_DRIVER_FILES', 0); show.has_driver(); print(os.environ['HOME'])"
    )
    environment = {name: value for name, value in os.environ.items() if name != "HOME"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "/\n"), done.stderr
