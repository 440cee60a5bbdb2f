"""Clips made of photos: the window's path, where a mask lies, and the report."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from tests.toys import MeanColour, SameColour, detector, scene, segmenter
from vap_core.perception.protocols import Stack
from vap_core.study.photos import (
    FRAMES,
    PhotoSet,
    Scene,
    Subject,
    clip_report,
    follow_scene,
    frames_of,
    lies_on,
    pan_over,
    visible_share,
)

RED, GREEN = (250, 0, 0), (0, 250, 0)


def test_the_window_goes_from_the_photo_to_its_copy_and_back():
    rgb = scene([(4, 4, RED), (40, 40, GREEN)])
    pan = pan_over(rgb)
    frames = list(frames_of(rgb, pan))
    assert len(frames) == FRAMES
    assert (frames[0] == frames[-1]).all()
    assert (frames[0][:, :64] == rgb).all()
    middle = np.abs(pan.left - pan.left.max()).argmin()
    assert (frames[middle][:, -64:] == rgb).all()
    box = np.array([[4.0, 4, 16, 16], [68, 4, 80, 16]])
    assert pan.boxes(0, box)[0].tolist() == [4, 4, 16, 16]
    for number in (0, 9, 17, int(middle)):
        for here in pan.boxes(number, box):
            if visible_share(here, frames[number]) == 1:
                x0, y0, x1, y1 = here.astype(int).tolist()
                assert (frames[number][y0:y1, x0:x1] == RED).all()


def test_where_a_mask_lies():
    pair = np.array([[4.0, 4, 16, 16], [40, 4, 52, 16]])
    mask = np.zeros((64, 64), bool)
    assert lies_on(None, pair) == lies_on(mask, pair) == ""
    mask[6:14, 6:14] = True
    assert lies_on(mask, pair) == "object"
    assert lies_on(np.roll(mask, 36, axis=1), pair) == "twin"
    assert lies_on(np.roll(mask, 36, axis=0), pair) == "other"
    outside = pair - [60, 0, 60, 0]
    assert lies_on(mask, outside) == "other"


@pytest.mark.parametrize("x", [25, 2])
def test_an_object_of_its_own_colour_is_followed(tmp_path: Path, x):
    Image.fromarray(scene([(x, 8, RED)])).save(tmp_path / "a.png")
    boxes = {
        "mug": np.array([[x, 8, x + 12, 20]], np.float32),
        "plant": np.zeros((0, 4), np.float32),
    }
    photo_set = PhotoSet(
        subjects=(Subject("mug", "cup", ()), Subject("plant", "plant", ())),
        scenes=(),
        categories={"mug": "cup", "plant": "plant"},
        sha256="",
    )
    stack = Stack("toy", detector, MeanColour(), segmenter, SameColour())
    (row,) = follow_scene(Scene("a.png", tmp_path / "a.png", boxes), photo_set, stack)
    assert row["object"] == "mug"
    assert row["frames"] == FRAMES
    assert 0 < row["in_view"] < FRAMES
    assert 0 < row["on_object"] <= row["in_view"]
    assert row["end"] in ("object", "twin", "other")


def test_the_report_counts_ends_and_frames():
    rows = []
    for end in ("object", "object", "twin", ""):
        rows.append(
            {"scene": f"{len(rows)}", "object": "mug", "frames": 48, "in_view": 30,
             "on_object": 20, "on_twin": 5, "end": end}
        )  # fmt: skip
    text = clip_report(pd.DataFrame(rows))
    line = next(line for line in text.splitlines() if line.startswith("at the end"))
    assert "50 [15, 85] 4" in line
    assert line.count("25 [") == 2
    assert "in 80 of 120 frames that show it, its twin's in 20 of 192 frames" in text
    assert "no object" in clip_report(pd.DataFrame())
