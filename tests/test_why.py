"""A recording of a failure says why, and opens with the evidence."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from tests.drawn import ROW, SIDE, SIZES, SUCCESS, K, columns, entities, frame, opening, rerun
from vap_core.base.types import Track
from vap_core.recording import Recorder, read_summary
from vap_core.recording.entities.curves import LINE_CHARACTERS
from vap_core.rollout.types import MaskCoverage
from vap_core.simulation.types import EpisodeRow
from vap_core.study.diagnosis import explain


def fail(
    path: Path,
    shown: str,
    second: str | None = None,
    after: int = 0,
    row: EpisodeRow = ROW,
) -> dict[str, Any]:
    """A failed episode whose prompts cover `shown`, and in a second view `second`; from step `after` on."""
    start = opening(1 if second is None else 2)
    start = replace(
        start,
        row=row,
        references={"owl_a": (np.full((20, 30, 3), 99, np.uint8),) * K},
    )
    with Recorder(path, start, explain=explain) as recorder:
        for step in range(12):
            one, names = frame(step, start), ["front", "side"]
            covers = {
                cam: what if step >= after else "owl_a"
                for cam, what in zip(names, (shown, second), strict=True)
                if what is not None
            }
            tracks = {
                cam: (Track(one.truth.masks[cam][what], 0.9),) for cam, what in covers.items()
            }
            seen = tuple(
                MaskCoverage(cam, what, 0.9 * (what == "owl_a"), 500, 0.9)
                for cam, what in covers.items()
            )
            recorder.frame(replace(one, tracks=tracks, coverage=seen))
        recorder.close(replace(SUCCESS, status="failure", success=False, steps=11))
    return read_summary(path)


def tabs(path: Path) -> set[str]:
    """Names of the containers in a recording's blueprints."""
    reader = RrdReader(path)
    batches = [
        chunk.to_record_batch()
        for held in reader.blueprints()
        for chunk in reader.stream(store=held)
    ]
    name = "ContainerBlueprint:display_name"
    return {
        cell[0]
        for batch in batches
        if name in batch.schema.names
        for cell in batch[name].to_pylist()
        if cell
    }


@pytest.mark.parametrize(
    ("shown", "second", "after", "case", "sub_case", "frame_index"),
    [
        ("owl_b", None, 0, "case 1", "distractor vote", 0),
        ("owl_b", None, 4, "case 1", "drift", 4),
        ("owl_a", "owl_b", 0, "case 2", "views disagree", 0),
        ("owl_a", None, 0, "case 3", "timeout", 0),
    ],
)
def test_a_recording_says_why_and_its_blueprint_opens_there(
    tmp_path: Path,
    shown: str,
    second: str | None,
    after: int,
    case: str,
    sub_case: str,
    frame_index: int,
) -> None:
    path = tmp_path / "one.rrd"
    summary = fail(path, shown, second, after)
    assert (
        summary["case"],
        summary["sub_case"],
        summary["deciding_frame"],
    ) == (case, sub_case, frame_index)
    assert summary["case_sentence"]
    assert {
        "/observation.images.front/identity",
        "/vap/vote_picture/front",
        "/vap/verdict",
        "/vap/hand/gripper_to_target",
        "/vap/hand/nearest_other",
        "/vap/hand/deciding_frame",
    } <= entities(path)
    told = [
        text for texts in columns(path, "/vap/events", "TextLog:text").values() for text in texts
    ]
    assert f"{case}: {sub_case}" in told
    assert max(map(len, told)) <= LINE_CHARACTERS, "the list shows 60 characters of a row"
    (verdict,) = columns(path, "/vap/verdict", "TextDocument:text").values()
    heading, _, sentence = str(verdict[0]).partition("\n\n")  # type: ignore[index]
    assert heading.startswith(f"## FAILURE · {case.capitalize()} · ")
    assert sentence.startswith(summary["case_sentence"])
    assert rerun("rrd", "verify", path).returncode == 0
    assert f"{case}: {sub_case}" in tabs(path)


def test_a_target_that_is_left_out_has_no_distance_from_the_gripper(tmp_path: Path) -> None:
    left_out = replace(ROW, start=replace(ROW.start, absent=True))
    path = tmp_path / "one.rrd"
    fail(path, "owl_b", row=left_out)
    drawn = entities(path)
    assert "/vap/hand/gripper_to_target" not in drawn
    assert {"/vap/hand/nearest_other", "/vap/hand/deciding_frame"} <= drawn
    nearest = columns(path, "/vap/hand/nearest_other", "Scalars:scalars")
    assert columns(path, "/vap/hand/deciding_frame", "Scalars:scalars") == {0: nearest[0]}


def test_a_prompt_wears_the_colour_of_what_it_covers(tmp_path: Path) -> None:
    fail(tmp_path / "one.rrd", "owl_b")
    buffer = columns(
        tmp_path / "one.rrd", "/observation.images.front/identity", "SegmentationImage:buffer"
    )[3]
    image = np.frombuffer(bytes(buffer[0]), np.uint8).reshape(SIDE, SIDE)  # type: ignore[index]
    masks = frame(3, opening(1)).truth.masks["front"]
    i = list(SIZES).index("owl_b")
    assert set(np.unique(image[masks["owl_b"]])) == {10 + 2 * i, 11 + 2 * i}
    assert set(np.unique(image[masks["owl_a"]])) == {0, 10 + 2 * list(SIZES).index("owl_a") + 1}, (
        "a rim alone"
    )
