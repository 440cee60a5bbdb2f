"""All recordings of a run asked at once, corrections as layers beside them, and files that are no recordings."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.command import vap
from tests.drawn import ROW, SUCCESS, columns, entities, frame, opening, rerun
from tests.test_why import fail
from vap_core.base.errors import BadOutput, BadRecording, BadStudy, UnknownName
from vap_core.evaluation.diagnosis import explain
from vap_core.recording import (
    Correction,
    Recorder,
    combine_recordings,
    ensure_index,
    isolated,
    load_steps,
    read_corrections,
    read_summary,
    write_correction,
)
from vap_core.recording.browser import serve_run
from vap_core.recording.catalog import PROPERTY_COLUMNS, register_files
from vap_core.recording.index import FOLDER
from vap_core.recording.query import first_match, format_result, run_query
from vap_core.rollout.failure import NO_DIAGNOSIS
from vap_core.rollout.types import Episode


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two failures and a success, and beside them what is no recording of an episode."""
    folder = tmp_path_factory.mktemp("asked") / "recordings"
    fail(folder / "wrong.rrd", "owl_b")
    fail(folder / "apart.rrd", "owl_a", "owl_b", after=4, row=replace(ROW, episode=4))
    start = replace(opening(1), row=replace(ROW, episode=5))
    with Recorder(folder / "fine.rrd", start, explain=explain) as recorder:
        for step in range(30):
            recorder.frame(frame(step + 31, start))
        recorder.close(replace(SUCCESS, steps=30))
    whole = (folder / "wrong.rrd").read_bytes()
    for name, data in (
        ("noise", b"noise" * 99),
        ("half", whole[: len(whole) // 2]),
        ("empty", b""),
    ):
        (folder / f"{name}.rrd").write_bytes(data)
    (folder / "z-copy.rrd").write_bytes(whole)
    program = "import rerun as rr, sys; r = rr.RecordingStream('other'); r.save(sys.argv[1]); r.log('x', rr.Scalars(1.0)); r.flush(); r.disconnect()"
    subprocess.run([sys.executable, "-c", program, str(folder / "foreign.rrd")], check=True)
    return folder.parent


def test_every_step_is_a_row_and_what_cannot_be_read_is_named(run: Path) -> None:
    held = load_steps(run / "recordings")
    counted = held.table.groupby("file")["frame_index"].agg(list)
    assert {Path(file).name: len(rows) for file, rows in counted.items()} == {
        "apart.rrd": 12,
        "fine.rrd": 30,
        "wrong.rrd": 12,
    }
    assert {path.name for path in held.unreadable} == {
        "noise.rrd",
        "half.rrd",
        "empty.rrd",
        "foreign.rrd",
        "z-copy.rrd",
    }
    assert all("\n" not in why for why in held.unreadable.values())
    wrong = held.table[held.table["file"].str.endswith("wrong.rrd")]
    assert set(wrong["margin"]) == {0.6}
    assert wrong["track_score"].tolist() == pytest.approx([0.9] * 12)
    assert (wrong["gap_cm"] > 0).all()
    assert set(wrong["case"]) == {"case 1"}


def test_a_correction_without_its_recording_is_left_out(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    for name in ("wrong", "apart"):
        (folder / f"{name}.rrd").write_bytes((run / "recordings" / f"{name}.rrd").read_bytes())
        write_correction(folder / f"{name}.rrd", Correction("case 3", "slip"), 3)
    (folder / "apart.rrd").unlink()
    held = load_steps(folder)
    assert set(held.table["file"]) == {str(folder / "wrong.rrd")}
    assert set(held.table["case"]) == {"case 3"}
    (tmp_path / "corrections" / "apart.rrd").write_bytes(b"noise")
    assert not load_steps(folder).unreadable
    shutil.rmtree(tmp_path / "corrections")
    assert set(load_steps(folder).table["case"]) == {"case 1"}
    assert read_corrections(tmp_path) == {}


POISON = """
import os
import vap_core.recording.isolated as isolated
index = isolated.ensure_index
isolated.ensure_index = lambda path, folder: os.abort() if path.stem in ("b", "c") else index(path, folder)
isolated.main()
"""


def test_a_recording_that_ends_its_reader_is_named_and_the_others_are_read(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some wrong bytes stop the process that reads them (the sweep finds such bytes)."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    data = (run / "recordings" / "fine.rrd").read_bytes()
    (folder / "a.rrd").write_bytes(data)
    for name in ("b", "c"):
        (folder / f"{name}.rrd").write_bytes(data + b"0")
    monkeypatch.setattr(isolated, "START", POISON)
    held = load_steps(folder)
    assert set(held.table["file"]) == {str(folder / "a.rrd")}
    assert held.unreadable == {folder / f"{name}.rrd": isolated.ENDED_READER for name in ("b", "c")}


POISONED_SUMMARY = POISON.replace("isolated.ensure_index", "isolated.read_summary").replace(
    "path, folder", "path"
)


def test_a_recording_that_ends_its_reader_is_no_part_of_a_browser_and_cannot_be_opened(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b"):
        shutil.copy(run / "recordings" / "fine.rrd", tmp_path / f"{name}.rrd")
    monkeypatch.setattr(isolated, "START", POISONED_SUMMARY)
    with serve_run(tmp_path) as browser:
        assert [row["file"] for row in browser.rows] == ["a.rrd"]
        assert browser.unreadable == {tmp_path / "b.rrd": isolated.ENDED_READER}
    isolated.check_recording(tmp_path / "a.rrd")
    with pytest.raises(BadRecording, match=isolated.ENDED_READER):
        isolated.check_recording(tmp_path / "b.rrd")
    with pytest.raises(BadRecording, match="there is no recording at"):
        isolated.check_recording(tmp_path / "absent.rrd")


@pytest.mark.sweep
def test_flipped_bits_leave_a_query_its_other_recordings(
    run: Path, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    data = (run / "recordings" / "fine.rrd").read_bytes()
    (folder / "whole.rrd").write_bytes((run / "recordings" / "wrong.rrd").read_bytes())
    for at in range(1600, 2400, 8):
        flipped = bytearray(data)
        flipped[at] ^= 1
        (folder / f"flip-{at}.rrd").write_bytes(flipped)
    held = load_steps(folder)
    assert str(folder / "whole.rrd") in set(held.table["file"])
    ended = list(held.unreadable.values()).count(isolated.ENDED_READER)
    assert ended, "no flip ended its reader"
    record_property("cases", len(range(1600, 2400, 8)))
    record_property("unreadable", len(held.unreadable))
    record_property("ended_their_reader", ended)


def test_from_inside_the_folder_its_recordings_have_short_names(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run.parent)
    result = run_query(Path(run.name), "frame_index >= 0")
    assert result.matches["file"].tolist() == [
        f"{run.name}/recordings/{name}.rrd" for name in ("apart", "fine", "wrong")
    ]


def test_from_inside_the_recordings_corrections_count_and_are_written_beside_them(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    shutil.copy(run / "recordings" / "wrong.rrd", folder)
    monkeypatch.chdir(folder)
    layer = write_correction(Path("wrong.rrd"), Correction("case 3", "slip"), 3)
    assert layer.resolve() == tmp_path / "corrections" / "wrong.rrd"
    assert set(run_query(Path(), "frame_index >= 0").matches["case"]) == {"case 3"}


def test_a_damaged_index_is_made_again(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    for name in ("wrong", "fine"):
        shutil.copy(run / "recordings" / f"{name}.rrd", folder)
    whole = load_steps(folder).table
    for damage in (b"", b"noise" * 99, ensure_index(folder / "wrong.rrd").read_bytes()[:3000]):
        ensure_index(folder / "wrong.rrd").write_bytes(damage)
        held = load_steps(folder)
        assert held.unreadable == {}
        assert held.table.equals(whole)


class Reordered:
    """A data set whose files are done in another order than they were named."""

    def register(self, urls: list[str], layer_name: str) -> "Reordered":
        self.urls = urls
        return self

    def iter_results(self) -> list[SimpleNamespace]:
        error = "Registration failed for the segments below.\n- Segment a: already exists"
        return [
            SimpleNamespace(uri=url, error=error if "copy" in url else None)
            for url in reversed(self.urls)
        ]


def test_the_file_that_is_no_part_of_a_catalog_is_named_with_the_reason(tmp_path: Path) -> None:
    files = [tmp_path / f"{name}.rrd" for name in ("a é copy", "b", "c")]
    unreadable: dict[Path, str] = {}
    register_files(Reordered(), {path: path for path in files}, unreadable)  # type: ignore[arg-type]
    assert unreadable == {files[0]: "- Segment a: already exists"}


def test_a_condition_leads_to_recordings_and_frames(run: Path) -> None:
    result = run_query(run, "success = false and margin < 0.7 and frame_index >= 7")
    assert [
        (Path(match.file).name, match.matching_steps, match.first_step, match.last_step)
        for match in result.matches.itertuples()
    ] == [
        ("apart.rrd", 5, 7, 11),
        ("wrong.rrd", 5, 7, 11),
    ]
    assert first_match(result, 1) == (run / "recordings" / "wrong.rrd", 7)
    text = format_result(result, limit=1)
    assert text.startswith("2 of 3 recordings, 10 steps")
    assert "and 1 more" in text
    assert text.count("was left out") == 5
    assert run_query(run, "lift_cm > 5 and success").matches["file"].tolist() == [
        str(run / "recordings" / "fine.rrd")
    ]
    assert format_result(run_query(run, "margin > 2")).startswith("0 of 3 recordings, 0 steps")
    with pytest.raises(BadStudy, match="no recording #2; 2 were found"):
        first_match(result, 2)
    with pytest.raises(BadStudy, match="is none on this table"):
        run_query(run, "margin <")


def test_an_index_says_what_the_recording_says_and_is_made_anew_when_that_changes(
    tmp_path: Path,
) -> None:
    path = tmp_path / "recordings" / "one.rrd"
    fail(path, "owl_a", "owl_b", after=4)
    made = ensure_index(path)
    assert made.parent.parent == path.parent
    assert rerun("rrd", "verify", made).returncode == 0
    assert read_summary(made)["case_sentence"] == read_summary(path)["case_sentence"]
    told = {
        name: [value[0] for _, value in sorted(columns(made, "/steps", name).items())]
        for name in ("margin", "track_score", "gap_cm", "lift_cm")
    }
    views = [
        columns(path, f"/vap/track_score/{cam}", "Scalars:scalars") for cam in ("front", "side")
    ]
    assert told["track_score"] == [min(view[step][0] for view in views) for step in range(12)]  # type: ignore[index]
    gaps = columns(path, "/vap/hand/gripper_to_target", "Scalars:scalars")
    assert told["gap_cm"] == [gaps[step][0] for step in range(12)]  # type: ignore[index]
    assert made.stat().st_size < path.stat().st_size / 2
    before = made.stat().st_mtime_ns
    assert ensure_index(path).stat().st_mtime_ns == before
    path.unlink()
    fail(path, "owl_b")
    assert read_summary(ensure_index(path))["sub_case"] == "distractor vote"


def test_without_a_prompt_the_numbers_are_missing_and_the_steps_are_not(tmp_path: Path) -> None:
    start = replace(opening(1), groundings={})
    with Recorder(tmp_path / "one.rrd", start, explain=explain) as recorder:
        for step in range(5):
            recorder.frame(replace(frame(step, opening(1)), tracks={}))
        recorder.close(SUCCESS)
    table = load_steps(tmp_path).table
    assert table["frame_index"].tolist() == list(range(5))
    assert table[["margin", "track_score"]].isna().all(axis=None)


def test_a_folder_that_cannot_be_written_is_asked_all_the_same(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = load_steps(run / "recordings").table
    for path in (run / "recordings" / FOLDER).iterdir():
        path.unlink()
    (run / "recordings" / FOLDER).rmdir()
    monkeypatch.setattr("vap_core.recording.catalog.os.access", lambda path, mode: False)
    assert load_steps(run / "recordings").table.equals(whole)
    assert not (run / "recordings" / FOLDER).exists()


@pytest.mark.sweep
def test_what_a_query_costs_is_told() -> None:
    done = vap("bench", "query", "--quick")
    assert done.returncode == 0, done.stderr
    assert "20 found" in done.stdout
    assert done.stdout.count("recordings read whole") >= 2


def test_a_folder_without_recordings_says_so(run: Path, tmp_path: Path) -> None:
    with pytest.raises(BadRecording, match="there is no recording in .*; run eval with --record"):
        load_steps(tmp_path)
    (tmp_path / "noise.rrd").write_bytes(b"noise" * 99)
    with pytest.raises(BadRecording, match="none of 1 files"):
        load_steps(tmp_path)


def test_a_correction_is_a_layer_and_leaves_the_recording_alone(run: Path) -> None:
    path = run / "recordings" / "wrong.rrd"
    before = path.read_bytes()
    for part, note in (("missed grasp", ""), ("slip", "it held for a moment")):
        layer = write_correction(path, Correction("case 3", part, note), 5)
    assert path.read_bytes() == before
    assert layer == run / "corrections" / "wrong.rrd"
    assert [p.name for p in layer.parent.iterdir()] == ["wrong.rrd"], (
        "the second replaced the first"
    )
    assert read_corrections(run) == {
        "wrong.rrd": Correction("case 3", "slip", "it held for a moment")
    }
    assert rerun("rrd", "verify", layer).returncode == 0
    assert "/vap/events" in entities(layer)
    table = load_steps(run / "recordings").table
    mine = table[table["file"].str.endswith("wrong.rrd")].iloc[0]
    assert (mine.case, mine.sub_case, mine.case_sentence, mine.corrected) == (
        "case 3",
        "slip",
        "it held for a moment",
        True,
    )
    assert not table[table["file"].str.endswith("apart.rrd")]["corrected"].any()
    assert read_summary(path)["case"] == "case 1"
    layer.unlink()


def test_what_cannot_be_corrected(run: Path) -> None:
    with pytest.raises(UnknownName, match="case 3"):
        Correction("case 4", "slip")
    with pytest.raises(UnknownName, match="missed grasp"):
        Correction("case 3", "drift")
    with pytest.raises(BadStudy, match="ended in success; only failures have a case"):
        write_correction(run / "recordings" / "fine.rrd", Correction("case 3", "slip"), 0)
    with pytest.raises(BadRecording, match="cannot be read"):
        write_correction(run / "recordings" / "noise.rrd", Correction("case 3", "slip"), 0)


def test_a_damaged_layer_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "corrections").mkdir()
    (tmp_path / "corrections" / "a.rrd").write_bytes(b"noise")
    with pytest.raises(BadRecording, match="is damaged .*; delete it") as caught:
        read_corrections(tmp_path)
    assert "\n" not in str(caught.value)


def test_two_methods_share_a_time_line(run: Path, tmp_path: Path) -> None:
    folder = run / "recordings"
    combine_recordings(
        {"mine": folder / "wrong.rrd", "theirs": folder / "z-copy.rrd"}, tmp_path / "both.rrd"
    )
    assert rerun("rrd", "verify", tmp_path / "both.rrd").returncode == 0
    alone = {name for name in entities(folder / "wrong.rrd") if not name.startswith("/__")}
    assert {
        f"/{name}{entity.rstrip('/')}" for name in ("mine", "theirs") for entity in alone
    } <= entities(tmp_path / "both.rrd")
    one = columns(folder / "wrong.rrd", "/vap/hand/gripper_to_target", "Scalars:scalars")
    assert (
        columns(tmp_path / "both.rrd", "/theirs/vap/hand/gripper_to_target", "Scalars:scalars")
        == one
    )
    with pytest.raises(
        BadStudy,
        match="not recordings of one episode: mine tabletop pick-owl 3 7; other tabletop pick-owl 4 7",
    ):
        combine_recordings(
            {"mine": folder / "wrong.rrd", "other": folder / "apart.rrd"}, tmp_path / "more.rrd"
        )
    with pytest.raises(BadOutput, match="never overwritten"):
        combine_recordings({"mine": folder / "wrong.rrd"}, tmp_path / "both.rrd")


def test_a_query_has_the_columns_of_a_results_table() -> None:
    header = opening(1)
    episode = Episode(header, (frame(0, header),), SUCCESS, {})
    columns = {*episode.summary(), *NO_DIAGNOSIS}
    for names in PROPERTY_COLUMNS.values():
        assert set(names) <= columns
