"""A recording with odd properties or damaged bytes is one line, and its neighbours are read."""

import shutil
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr

from tests.drawn import ROW, SUCCESS, frame, opening, record
from tests.test_why import fail
from vap_core.base.errors import BadRecording
from vap_core.recording import (
    Correction,
    Recorder,
    ensure_index,
    film,
    isolated,
    load_steps,
    read_corrections,
    read_summary,
    serve_run,
    write_correction,
    write_film,
)
from vap_core.recording.catalog import PROPERTY_COLUMNS
from vap_core.recording.index import FOLDER
from vap_core.recording.query import run_query
from vap_core.recording.reading import KINDS, property_group, read_chunks, read_properties
from vap_core.recording.stored_pictures import SAMPLE, prompted_entities
from vap_core.recording.stream import finish_stream, log_row, open_stream, time_columns

QUERIED = {name: group for group, names in PROPERTY_COLUMNS.items() for name in names}
GROUP_OF = {**QUERIED, "hz": "rollout"}
ODD: dict[Any, Any] = {
    str: pa.array([7]),
    int: pa.array([3.5]),
    bool: pa.array(["maybe"]),
    (int, float): pa.array(["many"]),
}
"""A value of another type, by what KINDS expects."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recordings of a failure and of a success."""
    folder = tmp_path_factory.mktemp("whole") / "recordings"
    fail(folder / "wrong.rrd", "owl_b", after=4, row=replace(ROW, episode=4))
    record(folder / "fine.rrd", opening(2))
    return folder


def link_all(folder: Path, to: Path) -> None:
    """The recordings of a folder in another, without their indexes."""
    to.mkdir(exist_ok=True)
    for path in folder.glob("*.rrd"):
        (to / path.name).hardlink_to(path)


def rewrite(
    recording: Path, out: Path, properties: Mapping[str, pa.Array], recording_id: str = "other"
) -> None:
    """A copy of a recording with other properties and another id."""
    rec = open_stream(out, recording_id)
    for chunk in read_chunks(recording):
        group = property_group(chunk)
        if group is None and not chunk.entity_path.startswith("/__"):
            rec.send_chunks(chunk)
        if group in PROPERTY_COLUMNS:
            log_row(rec, f"/__properties/{group}", Exactly(changed(chunk, group, properties)))
    finish_stream(rec, out)


def changed(chunk: Any, group: str, properties: Mapping[str, pa.Array]) -> dict[str, pa.Array]:
    values = {
        name: pa.array([value])
        for name, value in read_properties(chunk).items()
        if value is not None
    }
    return {**values, **{name: v for name, v in properties.items() if GROUP_OF[name] == group}}


class Exactly(rr.AsComponents):
    """Properties of exactly these types, whatever their names were logged with before."""

    def __init__(self, values: Mapping[str, pa.Array]) -> None:
        self.values = values

    def as_component_batches(self) -> list[rr.DescribedComponentBatch]:
        return [
            rr.DescribedComponentBatch(Column(array), rr.ComponentDescriptor(name))
            for name, array in self.values.items()
        ]


class Column(rr.ComponentBatchMixin):
    """An Arrow array as it is."""

    def __init__(self, array: pa.Array) -> None:
        self.array = array

    def as_arrow_array(self) -> pa.Array:
        return self.array


def test_recordings_with_a_property_of_another_type_are_named(whole: Path, tmp_path: Path) -> None:
    """One of each property; first by name, so that a catalog would take their types for all."""
    link_all(whole, tmp_path)
    odd = {}
    for name in QUERIED:
        odd[tmp_path / f"a-{name}.rrd"] = name
        rewrite(
            whole / "fine.rrd", tmp_path / f"a-{name}.rrd", {name: ODD[KINDS.get(name, bool)]}, name
        )
    big = tmp_path / "a-big.rrd"
    odd[big] = "seed"
    rewrite(whole / "fine.rrd", big, {"seed": pa.array([2**63 + 5], pa.uint64())}, "big")
    result = run_query(tmp_path, "frame_index = 0 and success in (true, false)")
    assert {Path(file).name for file in result.matches["file"]} == {"fine.rrd", "wrong.rrd"}
    assert set(result.unreadable) == set(odd)
    for path, name in odd.items():
        assert f"its property {name} is" in result.unreadable[path]
    for path, summary, reason in isolated.read_summaries(list(odd)):
        assert summary is None
        assert f"its property {odd[path]} is" in reason


def test_properties_of_other_widths_are_read(whole: Path, tmp_path: Path) -> None:
    link_all(whole, tmp_path)
    values = {
        "a-short": ("episode", pa.array([3], pa.int16())),
        "a-large": ("task", pa.array(["pick-owl"], pa.large_string())),
        "a-whole": ("case_confidence", pa.array([1])),
        "a-single": ("case_confidence", pa.array([0.5], pa.float32())),
    }
    for file, (name, value) in values.items():
        rewrite(whole / "fine.rrd", tmp_path / f"{file}.rrd", {name: value}, file)
    held = load_steps(tmp_path)
    assert held.unreadable == {}
    assert held.table["file"].nunique() == 2 + len(values)
    for file, (name, value) in values.items():
        mine = held.table[held.table["file"] == str(tmp_path / f"{file}.rrd")]
        assert set(mine[name]) == set(value.to_pylist())


def test_a_rate_that_no_film_can_have_is_refused(whole: Path, tmp_path: Path) -> None:
    for number, hz in enumerate((1e7, 1001.0, -1.0, np.nan)):
        path = tmp_path / f"{number}.rrd"
        rewrite(whole / "fine.rrd", path, {"hz": pa.array([hz])})
        with pytest.raises(BadRecording, match="its property hz is"):
            read_summary(path)
    rewrite(whole / "fine.rrd", tmp_path / "fast.rrd", {"hz": pa.array([1000.0])})
    assert read_summary(tmp_path / "fast.rrd")["hz"] == 1000


def test_a_timeline_that_no_film_can_have_is_refused(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recording that says no rate has that of its timeline."""
    recording = whole / "fine.rrd"
    without = {name: value for name, value in read_summary(recording).items() if name != "hz"}
    monkeypatch.setattr(film, "read_summary", lambda path: without)
    monkeypatch.setattr(film, "_frame_rate", lambda *_: 1e9)
    with pytest.raises(BadRecording, match="steps a second by its timeline; 1000 are the most"):
        write_film(recording, tmp_path / "film.mp4")


def test_a_film_of_a_damaged_video_is_one_line(tmp_path: Path) -> None:
    """Packets of noise, and one that holds no picture."""
    start = opening(1)
    whole = tmp_path / "whole.rrd"
    with Recorder(whole, start, video=True) as recorder:
        for step in range(6):
            recorder.frame(frame(step, start))
        recorder.close(SUCCESS)
    (entity,) = prompted_entities(whole).values()
    packets = samples(whole, entity)
    none = b"\x12\x00"
    for name, damaged, words in (
        ("noise", [none + b"junkjunk"] * 6, "a video that cannot be decoded"),
        ("short", [*packets[:5], none], "a video of 6 steps that decodes to 5 pictures"),
    ):
        path = tmp_path / f"{name}.rrd"
        with_samples(whole, path, entity, damaged)
        with pytest.raises(BadRecording, match=words) as caught:
            write_film(path, tmp_path / "film.mp4")
        assert "\n" not in str(caught.value)
    with_samples(whole, tmp_path / "same.rrd", entity, packets)
    assert write_film(tmp_path / "same.rrd", tmp_path / "film.mp4") > 6


def samples(recording: Path, entity: str) -> list[bytes]:
    """The packets of a video, in the order of the file."""
    found = []
    for chunk in read_chunks(recording):
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and SAMPLE in batch.schema.names:
            for cell in batch[SAMPLE]:
                found.append(bytes(cell.values.flatten().to_numpy().astype(np.uint8)))
    return found


def with_samples(recording: Path, out: Path, entity: str, packets: list[bytes]) -> None:
    """A copy of a recording with other packets."""
    rec = open_stream(out, out.stem)
    for chunk in read_chunks(recording):
        group = property_group(chunk)
        is_video = chunk.entity_path == entity and SAMPLE in chunk.to_record_batch().schema.names
        if not is_video and (group in PROPERTY_COLUMNS or not chunk.entity_path.startswith("/__")):
            rec.send_chunks(chunk)
    times = time_columns([(step, step / 10) for step in range(len(packets))])
    rec.send_columns(entity, times, rr.VideoStream.columns(sample=packets))
    finish_stream(rec, out)


def test_a_damaged_index_is_made_again(whole: Path, tmp_path: Path) -> None:
    """Also where the damage can be read, and only changes a number."""
    link_all(whole, tmp_path)
    table = load_steps(tmp_path).table
    for seed in range(4):
        rng = np.random.default_rng(seed)
        for path in tmp_path.glob("*.rrd"):
            index = ensure_index(path)
            flipped = np.fromfile(index, np.uint8)
            at = rng.integers(len(flipped), size=rng.choice([1, 2, 8]))
            flipped[at] ^= (1 << rng.integers(8, size=len(at))).astype(np.uint8)
            index.write_bytes(flipped.tobytes())
        held = load_steps(tmp_path)
        assert held.unreadable == {}
        assert held.table.equals(table)
    assert len(list((tmp_path / FOLDER).iterdir())) == 2, "the damaged ones are gone"


def test_a_copy_is_named_with_the_recording_that_it_repeats(whole: Path, tmp_path: Path) -> None:
    link_all(whole, tmp_path)
    copy = tmp_path / "copy.rrd"
    shutil.copy(tmp_path / "fine.rrd", copy)
    for _ in range(2):
        held = load_steps(tmp_path)
        assert held.unreadable == {
            tmp_path / "fine.rrd": "it holds the same episode as copy.rrd; move one of them away"
        }
        assert {Path(file).name for file in held.table["file"]} == {"copy.rrd", "wrong.rrd"}
        indexes = {path: path.stat().st_mtime_ns for path in (tmp_path / FOLDER).iterdir()}
        assert len(indexes) == 3
        assert load_steps(tmp_path).table.equals(held.table)
        kept = {path: path.stat().st_mtime_ns for path in (tmp_path / FOLDER).iterdir()}
        assert kept == indexes


def test_a_damaged_layer_is_one_line(whole: Path, tmp_path: Path) -> None:
    """Flipped bits end neither `diagnose` nor a query; some end the process that reads them."""
    recordings = tmp_path / "recordings"
    link_all(whole, recordings)
    layer = write_correction(recordings / "wrong.rrd", Correction("case 3", "slip"), 3)
    good = np.frombuffer(layer.read_bytes(), np.uint8)
    for case in range(60):
        rng = np.random.default_rng(case)
        at = rng.integers(len(good), size=rng.choice([1, 2, 8]))
        flipped = good.copy()
        flipped[at] ^= (1 << rng.integers(8, size=len(at))).astype(np.uint8)
        (layer.parent / f"{case}.rrd").write_bytes(flipped.tobytes())
    refused = []
    for path, correction, reason in isolated.read_layers(sorted(layer.parent.glob("*.rrd"))):
        assert "\n" not in reason
        if correction is None:
            assert f"corrections: {path} is damaged" in reason
            refused.append(path)
    assert len(refused) > 30
    assert layer not in refused


ENDS_AT_LAYERS = """
import os
import vap_core.recording.isolated as isolated
isolated.read_correction = lambda path: os.abort()
isolated.main()
"""


def test_a_layer_that_ends_its_reader_is_named(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings = tmp_path / "recordings"
    link_all(whole, recordings)
    for path in recordings.glob("*.rrd"):
        ensure_index(path)
    layer = write_correction(recordings / "wrong.rrd", Correction("case 3", "slip"), 3)
    monkeypatch.setattr(isolated, "START", ENDS_AT_LAYERS)
    result = run_query(tmp_path, "frame_index = 0")
    assert set(result.matches["case"]) == {"case 1", ""}
    with serve_run(tmp_path) as browser:
        assert {row["case"] for row in browser.rows} == {"case 1", ""}
        named = browser.unreadable
    words = f"corrections: {layer} is damaged ({isolated.ENDED_READER}); delete it"
    for unreadable in (result.unreadable, named):
        assert list(unreadable) == [layer]
        assert unreadable[layer].startswith(words)
    with pytest.raises(BadRecording, match="is damaged .*; delete it"):
        read_corrections(tmp_path)


def test_a_browser_shows_how_many_recordings_it_has_read(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link_all(whole, tmp_path)
    shutil.copy(tmp_path / "wrong.rrd", tmp_path / "z-copy.rrd")
    bars = []

    def bar(answers: Iterable[Any], doing: str, total: int, **_: Any) -> Iterable[Any]:
        bars.append((doing, total))
        return answers

    monkeypatch.setattr("tqdm.tqdm", bar)
    with serve_run(tmp_path) as browser:
        assert browser.unreadable == {
            tmp_path / "z-copy.rrd": "it holds the same episode as wrong.rrd; move one of them away"
        }
        assert {row["file"] for row in browser.rows} == {"fine.rrd", "wrong.rrd"}
    assert bars == [("read", 3)]


def test_flipped_bits_in_indexed_recordings_leave_a_browser_the_others(
    whole: Path, tmp_path: Path
) -> None:
    """The bytes of a recording change after it was indexed."""
    link_all(whole, tmp_path)
    for seed in range(20):
        path = tmp_path / f"flip-{seed}.rrd"
        rewrite(whole / "fine.rrd", path, {}, path.stem)
        data = np.fromfile(path, np.uint8)
        ensure_index(path)
        rng = np.random.default_rng(seed)
        tail = len(data) // 2 if seed % 2 else 0
        data[rng.integers(tail, len(data), size=8)] ^= 1 << 3
        path.write_bytes(data.tobytes())
    with serve_run(tmp_path) as browser:
        assert {"fine.rrd", "wrong.rrd"} <= {row["file"] for row in browser.rows}
        assert all("\n" not in reason for reason in browser.unreadable.values())
