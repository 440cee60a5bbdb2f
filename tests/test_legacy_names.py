"""Recordings, indexes and corrections written before properties were named like table columns."""

from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from tests.drawn import ROW, SUCCESS, entities, frame, opening
from tests.test_why import fail
from vap_core.recording import (
    Correction,
    ensure_index,
    load_steps,
    read_corrections,
    read_summary,
    write_correction,
)
from vap_core.recording.catalog import PROPERTY_COLUMNS
from vap_core.recording.query import format_result, run_query
from vap_core.recording.stream import finish_stream, log_properties, open_stream
from vap_core.rollout.failure import NO_DIAGNOSIS
from vap_core.rollout.types import Episode

STEPS = 30
SENTENCE = "front: right at first, from step 4 on the track is on owl_b"


def write_old_recording(path: Path) -> None:
    """A failed episode of 30 steps with the former property names."""
    rec = open_stream(path, f"old.{path.stem}")
    log_properties(
        rec,
        "rollout",
        rr.AnyValues(
            suite="tabletop", task="pick-owl", episode=9, method="vap", policy="p", seed=7, hz=10.0
        ),
    )
    index = [rr.TimeColumn("frame_index", sequence=np.arange(STEPS))]
    for entity in ("/observation.state", "/vap/vote_margin/front"):
        rec.send_columns(entity, index, rr.Scalars.columns(scalars=np.full(STEPS, 0.6)))
    log_properties(
        rec,
        "outcome",
        rr.AnyValues(
            status="failure",
            success=False,
            length=STEPS,
            failure_case="case 1",
            sub_case="drift",
            deciding_frame=np.int64(4),
            deciding_camera="front",
            confidence=0.75,
            why=SENTENCE,
        ),
    )
    finish_stream(rec, path)


def write_old_correction(recording: Path) -> None:
    layer = recording.parent.parent / "corrections" / recording.name
    rec = open_stream(layer, f"old.{recording.stem}")
    log_properties(
        rec,
        "correction",
        rr.AnyValues(failure_case="case 3", sub_case="slip", why="it fell", was="case 1"),
    )
    finish_stream(rec, layer)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A failure recorded before the properties were renamed, and one recorded since."""
    write_old_recording(tmp_path / "recordings" / "old.rrd")
    fail(tmp_path / "recordings" / "new.rrd", "owl_b")
    return tmp_path


def test_the_summary_has_current_names(run: Path) -> None:
    old = run / "recordings" / "old.rrd"
    assert "/__properties/outcome" in entities(old)
    for path in (old, ensure_index(old)):
        summary = read_summary(path)
        assert summary["outcome"] == "failure"
        assert summary["steps"] == STEPS
        assert (summary["case"], summary["sub_case"]) == ("case 1", "drift")
        assert (summary["case_confidence"], summary["case_sentence"]) == (0.75, SENTENCE)
        assert not {"status", "length", "failure_case", "confidence", "why"} & set(summary)


def test_one_condition_finds_old_and_new_recordings(run: Path) -> None:
    result = run_query(run, "outcome = 'failure' and case = 'case 1'")
    assert [Path(file).name for file in result.matches["file"]] == ["new.rrd", "old.rrd"]
    assert result.matches["matching_steps"].tolist() == [12, STEPS]
    assert "drift" in format_result(result)
    result = run_query(run, "case = 'case 1' and steps > 20")
    assert [Path(file).name for file in result.matches["file"]] == ["old.rrd"]
    table = load_steps(run / "recordings").table.drop_duplicates("file").set_index("episode")
    assert table["steps"].to_dict() == {ROW.episode: 11, 9: STEPS}
    assert table.loc[9, "case_confidence"] == 0.75
    assert table.loc[9, "case_sentence"] == SENTENCE


def test_a_run_of_old_recordings_alone_is_queried(run: Path) -> None:
    (run / "recordings" / "new.rrd").unlink()
    result = run_query(run, "case = 'case 1' and steps > 20 and case_confidence > 0.7")
    assert result.matches["outcome"].tolist() == ["failure"]


def test_old_corrections_count_and_are_replaced(run: Path) -> None:
    old = run / "recordings" / "old.rrd"
    write_old_correction(old)
    assert read_corrections(run) == {"old.rrd": Correction("case 3", "slip", "it fell")}
    corrected = run_query(run, "corrected").matches
    assert corrected[["case", "sub_case"]].to_numpy().tolist() == [["case 3", "slip"]]
    assert run_query(run, "case_sentence = 'it fell'").matches["file"].tolist() == [str(old)]
    write_correction(old, Correction("case 1", "poor mask", "half of it"), 0)
    assert read_corrections(run) == {"old.rrd": Correction("case 1", "poor mask", "half of it")}
    new = run / "recordings" / "new.rrd"
    write_correction(new, Correction("case 3", "slip"), 0)
    assert set(run_query(run, "corrected").matches["sub_case"]) == {"poor mask", "slip"}


def test_a_query_has_the_columns_of_a_results_table() -> None:
    header = opening(1)
    episode = Episode(header, (frame(0, header),), SUCCESS, {})
    columns = {*episode.summary(), *NO_DIAGNOSIS}
    for names in PROPERTY_COLUMNS.values():
        assert set(names) <= columns
