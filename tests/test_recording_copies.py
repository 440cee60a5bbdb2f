"""Which recording a query reads of several, what a correction is of, and what has no outcome."""

import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.drawn import ROW, frame, opening, record
from tests.test_why import fail
from vap_core.base.errors import BadRecording
from vap_core.recording import (
    Correction,
    Recorder,
    combine_recordings,
    ensure_index,
    isolated,
    load_steps,
    recording_name,
    recover,
    serve_run,
    write_correction,
    write_film,
)
from vap_core.recording.file import temporary_path
from vap_core.recording.query import format_result, run_query


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two failures and a success."""
    folder = tmp_path_factory.mktemp("asked") / "recordings"
    fail(folder / "wrong.rrd", "owl_b")
    fail(folder / "apart.rrd", "owl_a", "owl_b", after=4, row=replace(ROW, episode=4))
    record(folder / "fine.rrd", replace(opening(2), row=replace(ROW, episode=5)))
    return folder.parent


def cases(folder: Path) -> dict[str, str]:
    """The case of every recording, as a query and as its server have it."""
    table = load_steps(folder).table.drop_duplicates("file")
    queried = {}
    for row in table.to_dict("records"):
        queried[Path(row["file"]).name] = row["case"] or ""
    with serve_run(folder) as browser:
        served = {row["file"]: row["case"] for row in browser.rows}
    assert queried == served
    return served


def test_of_a_recording_and_its_copy_the_one_with_its_own_name_is_read(
    run: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    own = recording_name(ROW, "vap")
    for name in (own, "backup.rrd", "a-copy.rrd"):
        shutil.copy(run / "recordings" / "wrong.rrd", folder / name)
    shutil.copy(run / "recordings" / "apart.rrd", folder)
    assert cases(folder) == {own: "case 1", "apart.rrd": "case 2"}
    assert load_steps(folder).unreadable == {
        folder / name: f"it holds the same episode as {own}; move one of them away"
        for name in ("a-copy.rrd", "backup.rrd")
    }
    write_correction(folder / own, Correction("case 3", "slip"), 3)
    result = run_query(tmp_path, "corrected and frame_index = 0")
    assert [Path(file).name for file in result.matches["file"]] == [own]


def test_of_a_recording_and_its_copy_the_corrected_one_is_read(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    for name in ("wrong.rrd", "a-copy.rrd"):
        shutil.copy(run / "recordings" / "wrong.rrd", folder / name)
    write_correction(folder / "wrong.rrd", Correction("case 3", "slip"), 3)
    assert cases(folder) == {"wrong.rrd": "case 3"}


def test_a_correction_is_of_its_own_recording_and_of_a_failure(run: Path, tmp_path: Path) -> None:
    """Not of another failure under whose name it is copied, nor of a success that came after."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    for name in ("wrong", "apart"):
        shutil.copy(run / "recordings" / f"{name}.rrd", folder)
    layer = write_correction(folder / "wrong.rrd", Correction("case 3", "slip"), 3)
    shutil.copy(layer, layer.with_name("apart.rrd"))
    assert cases(folder) == {"wrong.rrd": "case 3", "apart.rrd": "case 2"}
    (folder / "wrong.rrd").unlink()
    record(folder / "wrong.rrd", opening(2))
    assert cases(folder) == {"wrong.rrd": "", "apart.rrd": "case 2"}


def test_a_recovered_recording_is_unfinished(run: Path, tmp_path: Path) -> None:
    path = tmp_path / "recordings" / "one.rrd"
    start = opening(1)
    with suppress(KeyboardInterrupt), Recorder(path, start) as recorder:
        for step in range(4):
            recorder.frame(frame(step, start))
        raise KeyboardInterrupt
    recover(temporary_path(path))
    result = run_query(tmp_path, "outcome = 'unfinished'")
    assert result.matches["outcome"].tolist() == ["unfinished"]
    assert "nan" not in format_result(result)
    shutil.copy(run / "recordings" / "fine.rrd", path.parent / "fine.rrd")
    both = run_query(tmp_path, "frame_index = 0")
    assert sorted(both.matches["outcome"]) == ["success", "unfinished"]


def test_a_folder_that_cannot_be_written_is_read_through_the_indexes_that_are_there(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("wrong", "fine"):
        shutil.copy(run / "recordings" / f"{name}.rrd", tmp_path)
    ensure_index(tmp_path / "wrong.rrd")
    asked: list[Path] = []

    def index(recordings: list[Path], folder: Path | None) -> Any:
        asked.extend(recordings)
        assert folder is not None
        return isolated.index_isolated(recordings, folder)

    monkeypatch.setattr("vap_core.recording.catalog.os.access", lambda path, mode: False)
    monkeypatch.setattr("vap_core.recording.catalog.index_isolated", index)
    assert load_steps(tmp_path).table["file"].nunique() == 2
    assert asked == [tmp_path / "fine.rrd"]


def test_a_film_is_of_one_recording(run: Path, tmp_path: Path) -> None:
    wrong = run / "recordings" / "wrong.rrd"
    together = tmp_path / "together.rrd"
    combine_recordings({"generic": wrong, "vap": wrong}, together)
    with pytest.raises(BadRecording, match="lays several recordings side by side"):
        write_film(together, tmp_path / "film.mp4")
