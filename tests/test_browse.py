"""A run's recordings as a table, as films and as a page; a click on a candidate."""

import io
import shutil
import socket
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from PIL import Image

from tests.command import vap
from tests.drawn import ROW, K, opening, record
from tests.test_why import fail
from vap_core.base.errors import BadOutput, BadRecording, BadStudy
from vap_core.base.video import frames as video_frames
from vap_core.recording import (
    Correction,
    Votes,
    browser,
    clicks,
    reading,
    serve_run,
    write_correction,
    write_film,
)
from vap_core.recording.entities.votes import _drawing_order
from vap_core.recording.film import read_verdict
from vap_core.recording.reading import read_chunks
from vap_core.recording.stored_pictures import _decode_jpeg, prompted_entities, read_pictures


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A failure, a success, and a file that is no recording."""
    folder = tmp_path_factory.mktemp("browsed") / "recordings"
    fail(folder / "wrong.rrd", "owl_b", after=4, row=replace(ROW, episode=4))
    record(folder / "fine.rrd", opening(2))
    (folder / "noise.rrd").write_bytes(b"noise" * 99)
    return folder.parent


def test_the_browser_links_every_recording_to_its_deciding_frame(run: Path) -> None:
    import rerun as rr

    with serve_run(run, "outcome = 'failure'") as browser:
        assert browser.url.startswith("rerun+http://127.0.0.1:")
        assert [path.name for path in browser.unreadable] == ["noise.rrd"]
        client = rr.catalog.CatalogClient(browser.url.partition("/entry")[0])
        rows = client.get_table("episodes").reader().to_pandas()
        assert list(rows.file) == ["wrong.rrd", "fine.rrd"], "failures first"
        assert rows.case[0] == "case 1"
        assert rows.deciding_frame[0] == 4
        assert "frame_index" in rows.link[0]
        assert rows.link[0].startswith("rerun+http://127.0.0.1:")
        assert client.get_table("episodes").blueprints()
        assert client.get_dataset("recordings").default_blueprint()
    none = run / "recordings" / "none"
    with pytest.raises(BadRecording, match="there is no recording in"), serve_run(none):
        pass


def test_recordings_open_with_every_camera_that_any_of_them_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "recordings"
    fail(folder / "one.rrd", "owl_b")
    start = replace(opening(2), row=replace(ROW, episode=5))
    record(folder / "two.rrd", start, steps=2)
    drawn: list[str] = []

    def coverage(camera: str) -> Any:
        drawn.append(camera)
        return browser.events_view()

    monkeypatch.setattr(browser, "coverage_view", coverage)
    with serve_run(tmp_path):
        pass
    assert drawn == ["front", "side"]
    assert list(prompted_entities(folder / "one.rrd")) == ["front"], "which is the first row"


def test_the_browser_shows_corrected_cases_and_leaves_a_damaged_layer_out(
    run: Path, tmp_path: Path
) -> None:
    shutil.copytree(run / "recordings", tmp_path / "recordings")
    recording = tmp_path / "recordings" / "wrong.rrd"
    layer = write_correction(recording, Correction("case 3", "slip", "it held"), 4)
    with serve_run(tmp_path) as browser:
        (row,) = [row for row in browser.rows if row["file"] == "wrong.rrd"]
        assert (row["case"], row["sub_case"], row["case_sentence"]) == ("case 3", "slip", "it held")
    layer.write_bytes(b"noise" * 99)
    with serve_run(tmp_path) as browser:
        assert layer in browser.unreadable
        assert {row["case"] for row in browser.rows} == {"case 1", ""}


def test_a_port_that_is_taken_is_one_line(run: Path) -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        pytest.raises(BadOutput, match="cannot be served .* choose another by --port"),
        serve_run(run, port=taken.getsockname()[1]),
    ):
        pass


def test_a_query_wants_a_condition_or_a_server(run: Path) -> None:
    done = vap("query", run)
    assert done.returncode == 2
    assert "or add --serve" in done.stderr


def test_without_a_display_the_server_says_how_to_reach_it_from_elsewhere(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`python -m rerun` opens a window, which cannot be opened here."""

    class Interrupted:
        def wait(self) -> bool:
            raise KeyboardInterrupt

    monkeypatch.setattr("vap_core.cli.recordings.threading", SimpleNamespace(Event=Interrupted))
    monkeypatch.setattr("vap_core.recording.viewer.has_display", lambda: False)
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    done = vap("query", run, "--serve", "--port", port)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    tunnel = lines.index(f"  ssh -N -L {port}:127.0.0.1:{port} HOST")
    assert "no display here; on a machine that has one" in lines[tunnel - 1]
    assert lines[tunnel + 1].startswith(f"  python -m rerun rerun+http://127.0.0.1:{port}/entry/")


def test_a_film_shows_the_policys_input_and_holds_where_it_was_decided(
    run: Path, tmp_path: Path
) -> None:
    path = run / "recordings" / "wrong.rrd"
    n = write_film(path, tmp_path / "film.mp4")
    assert n == 12 + 15 + 25, "12 steps at 10 Hz, 1.5 s at the deciding frame, 2.5 s at the end"
    pictures = list(video_frames(tmp_path / "film.mp4"))
    assert len(pictures) == n
    below = slice(pictures[0].shape[0] - 50, None)
    before, after = pictures[2][below, :600], pictures[10][below, :600]
    assert before.std() < 10 < after.std(), "the verdict comes with the deciding frame"
    assert read_verdict(path).startswith("✗ FAILURE · Case 1 · drift")
    assert read_verdict(run / "recordings" / "fine.rrd") == "✓ SUCCESS · 12 steps"


def test_pictures_come_back_from_jpeg_and_from_video(tmp_path: Path) -> None:
    from tests.drawn import SUCCESS, frame
    from vap_core.recording import Recorder

    start = opening(1)
    with Recorder(tmp_path / "video.rrd", start, video=True) as recorder:
        for step in range(6):
            recorder.frame(frame(step, start))
        recorder.close(SUCCESS)
    record(tmp_path / "still.rrd", start, steps=6)
    for name in ("video", "still"):
        path = tmp_path / f"{name}.rrd"
        (entity,) = prompted_entities(path).values()
        pictures = read_pictures(path, {entity})[entity]
        assert sorted(pictures) == list(range(6))
        true = frame(5, start).prompted["front"].astype(int)
        assert np.abs(pictures[5].astype(int) - true).mean() < 6


def test_a_film_that_cannot_be_written_is_one_line(run: Path, tmp_path: Path) -> None:
    path = run / "recordings" / "wrong.rrd"
    (tmp_path / "file").write_text("")
    with pytest.raises(BadOutput, match="cannot be written"):
        write_film(path, tmp_path / "file" / "film.mp4")
    with pytest.raises(BadOutput, match=r"is a folder; name a file that ends with \.mp4"):
        write_film(path, tmp_path)
    assert [one.name for one in tmp_path.iterdir()] == ["file"]


def test_a_condition_is_checked_before_it_is_served(run: Path) -> None:
    with serve_run(run, "outcome = 'failure'") as browser:
        assert (browser.n_matching, len(browser.rows)) == (1, 2)
    with pytest.raises(BadStudy, match="its columns are link, outcome"), serve_run(run, "colour"):
        pass


def test_what_is_no_recording_has_no_votes(run: Path) -> None:
    for name in ("noise", "absent"):
        with pytest.raises(BadRecording, match=r"rerun rrd optimize|there is no recording at"):
            Votes(run / "recordings" / f"{name}.rrd")


def test_a_click_shows_words_as_they_are(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import ipywidgets

    class Viewer(ipywidgets.HTML):
        def on_event(self, answer: Any) -> None:
            self.answer = answer

    monkeypatch.setattr(clicks, "view", lambda *_, **__: Viewer())
    monkeypatch.setattr(Votes, "answer", lambda *_: ("front", "<b>named</b>"))
    viewer, words, _ = clicks.inspect_votes(run / "recordings" / "fine.rrd").children
    clicked = SimpleNamespace(entity_path="/x", instance_id=0)
    viewer.answer(SimpleNamespace(type="selection_change", items=[clicked]))
    assert words.value == "&lt;b&gt;named&lt;/b&gt;"


def test_a_picture_that_is_no_jpeg_is_named() -> None:
    for blob in (np.zeros(0, np.uint8), np.zeros(99, np.uint8)):
        with pytest.raises(BadRecording, match="a picture that is no JPEG"):
            _decode_jpeg(blob)


@pytest.mark.parametrize(
    ("name", "value"),
    [("deciding_frame", "six"), ("episode", 1.5), ("hz", -1.0), ("hz", np.inf), ("outcome", 3)],
)
def test_a_recording_of_odd_properties_is_refused(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: Any
) -> None:
    monkeypatch.setattr(reading, "read_properties", lambda chunk: {name: value})
    with pytest.raises(BadRecording, match=f"its property {name} is"):
        write_film(run / "recordings" / "fine.rrd", tmp_path / "odd.mp4")


def test_of_two_votes_of_a_view_a_click_tells_the_one_that_is_shown(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sub-goals hold a vote each."""
    recording = run / "recordings" / "fine.rrd"
    entity = "/observation.images.side/candidates"
    told = Votes(recording).answer(entity, 2)
    first, *_ = [c for c in read_chunks(recording) if c.entity_path == "/vap/candidates/side"]

    class Later:
        """The same vote for another candidate, at a later step."""

        entity_path = first.entity_path

        def to_record_batch(self) -> Any:
            table = first.to_record_batch().to_pydict()
            del table["winner"]
            return pa.RecordBatch.from_pydict(table)

    chunks = [*read_chunks(recording), Later()]
    monkeypatch.setattr(clicks, "read_chunks", lambda path: chunks)
    assert Votes(recording).answer(entity, 2) == told


@pytest.mark.parametrize(("winner", "rejected"), [(2, None), (None, 1), (None, None)])
def test_candidates_are_counted_as_they_are_drawn(
    tmp_path: Path, winner: int | None, rejected: int | None
) -> None:
    """One that is chosen and not like enough is drawn on top."""
    start = opening(1)
    (grounding,) = start.groundings["front"]
    grounding = replace(grounding, winner=winner, rejected=rejected, threshold=0.9)
    path = tmp_path / "recordings" / "one.rrd"
    record(path, replace(start, groundings={"front": (grounding,)}), steps=2)
    votes = Votes(path)
    for instance, candidate in enumerate(_drawing_order(grounding)):
        told = votes.answer("/observation.images.front/candidates", instance)
        assert told is not None
        assert f"candidate #{candidate}," in told[1]


def test_a_click_on_a_candidate_says_its_cosines(run: Path) -> None:
    votes = Votes(run / "recordings" / "fine.rrd")
    assert votes.views == ["front", "side"]
    entity = "/observation.images.side/candidates"
    elected = votes.answer(entity, 2)  # the elected one is drawn last
    assert elected is not None
    name, words = elected
    assert name == "side"
    assert "candidate #0, elected: 4 of 5 votes" in words
    assert words.count("(its vote)") == 4
    assert words.count("photo ") == K
    other = votes.answer(entity, 0)
    assert other is not None
    assert "candidate #1, not elected" in other[1]
    label = votes.answer(f"{entity}/labels", 0)  # of the labels the elected one's is the first
    assert label is not None
    assert "candidate #0, elected" in label[1]
    beyond = votes.answer(f"{entity}/labels", 99)
    assert beyond is not None
    assert "click a box" in beyond[1]
    assert votes.answer("/world/table", 0) is None
    beside = votes.answer(entity, None)
    assert beside is not None
    assert "click a box" in beside[1]
    picture = votes.picture("side")
    assert picture is not None
    assert Image.open(io.BytesIO(_png(picture))).size[0] > 300


def _png(picture: np.ndarray) -> bytes:
    data = io.BytesIO()
    Image.fromarray(picture).save(data, "PNG")
    return data.getvalue()
