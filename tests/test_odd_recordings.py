"""A recording with odd properties or damaged bytes is one line, and its neighbours are read."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
import rerun as rr

from tests.drawn import ROW, opening, record
from tests.test_why import fail
from vap_core.recording import isolated, load_steps
from vap_core.recording.catalog import PROPERTY_COLUMNS
from vap_core.recording.query import run_query
from vap_core.recording.reading import KINDS, property_group, read_chunks, read_properties
from vap_core.recording.stream import finish_stream, log_row, open_stream

GROUP_OF = {name: group for group, names in PROPERTY_COLUMNS.items() for name in names}
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
    for name in GROUP_OF:
        odd[tmp_path / f"a-{name}.rrd"] = name
        rewrite(whole / "fine.rrd", tmp_path / f"a-{name}.rrd", {name: ODD[KINDS.get(name, bool)]}, name)
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
