"""A recording of a failure says why, and opens with the evidence."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from tests.drawn import ROW, SIDE, SUCCESS, K, columns, entities, frame, opening, rerun
from vap_core.base.pictures import object_labels
from vap_core.base.types import Track
from vap_core.recording import Recorder, read_summary
from vap_core.recording.entities.curves import LINE_CHARACTERS
from vap_core.recording.entities.pictures import OTHER_CLASS, YOURS_CLASS
from vap_core.recording.texts import verdict_line
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
    heading, _, about = str(verdict[0]).partition("\n\n")  # type: ignore[index]
    assert heading.startswith("### FAILURE · ")
    assert f"({case.capitalize()}): " in heading
    assert "owl_a" not in heading, "the target is called yours"
    assert f"decided at step {frame_index} · vap" in about
    assert {f"{case}: {sub_case}", "everything"} <= tabs(path)
    assert rerun("rrd", "verify", path).returncode == 0


def test_a_target_that_is_left_out_has_no_distance_from_the_gripper(tmp_path: Path) -> None:
    left_out = replace(ROW, start=replace(ROW.start, absent=True))
    path = tmp_path / "one.rrd"
    fail(path, "owl_b", row=left_out)
    drawn = entities(path)
    assert "/vap/hand/gripper_to_target" not in drawn
    assert {"/vap/hand/nearest_other", "/vap/hand/deciding_frame"} <= drawn
    nearest = columns(path, "/vap/hand/nearest_other", "Scalars:scalars")
    assert columns(path, "/vap/hand/deciding_frame", "Scalars:scalars") == {0: nearest[0]}


def test_objects_keep_their_pixels_and_wear_an_outline_with_a_name(tmp_path: Path) -> None:
    fail(tmp_path / "one.rrd", "owl_b")
    entity = "/observation.images.front/identity"
    buffer = columns(tmp_path / "one.rrd", entity, "SegmentationImage:buffer")[3]
    image = np.frombuffer(bytes(buffer[0]), np.uint8).reshape(SIDE, SIDE)  # type: ignore[index]
    masks = frame(3, opening(1)).truth.masks["front"]
    assert set(np.unique(image)) == {0, OTHER_CLASS, YOURS_CLASS}
    assert not any(image[mask].any() for mask in masks.values())
    names = columns(tmp_path / "one.rrd", f"{entity}/labels", "Points2D:labels")[3]
    assert set(names) == {"yours", "owl_b", "owl_c"}  # type: ignore[call-overload]


def test_every_object_is_called_what_it_is_to_the_user() -> None:
    names = ["cup-personal", "cup-lookalike-3", "mug-lookalike-1", "coke-can-prop"]
    said = object_labels(names, "cup-personal")
    assert list(said.values()) == ["yours", "look-alike 3", "mug lookalike 1", "coke can"]


def test_a_success_says_who_what_and_how_it_ended() -> None:
    line = verdict_line(opening(1), SUCCESS, None)
    rewritten = opening(1).rewritten
    assert line == f'SUCCESS · picked your owl in {SUCCESS.steps} steps · "{rewritten}"'
