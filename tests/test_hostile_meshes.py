"""Mesh files that are broken or hostile give one line, in bounded time and memory."""

import json
import os
import struct
import time
from contextlib import suppress
from pathlib import Path

import pytest
import trimesh

from tests.scanned import RED, box, mug, put
from vap_core.base.errors import BadObject, bounded
from vap_core.simulation.assets.scans import import_scan as importing
from vap_core.simulation.assets.scans import mesh_file
from vap_core.simulation.assets.scans.import_scan import import_scan
from vap_core.simulation.assets.scans.mesh_file import read_mesh_file

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def refused(path: Path, message: str, colour: str | None = "#aa3322") -> None:
    with pytest.raises(BadObject, match=message) as caught:
        read_mesh_file(path, colour)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) <= 300 + len(str(path))


def rewrite_glb(path: Path, change: object) -> None:
    """Apply `change` to the JSON of a GLB."""
    data = path.read_bytes()
    (size,) = struct.unpack("<I", data[12:16])
    tree = json.loads(data[20 : 20 + size])
    change(tree)  # type: ignore[operator]
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    path.write_bytes(head + text + rest)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SQUARE + "f 1 2 9\n", "vertices that are not there|cannot be read"),
        (SQUARE + "f 1 2 3 4\nf 1 2 3 4 5 6 7\n", "cannot be read|not there|no triangles"),
        ("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "is no surface"),
        ("v 0 0 0\nv 1e-30 0 0\nv 0 1e-30 0\nf 1 2 3\n", "is no surface"),
        ("v 0 0 0\nv 1e200 0 0\nv 0 1e200 0\nf 1 2 3\n", "is no surface|not numbers"),
        ("v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "not numbers|no triangles"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\nf 1 1 2\n", "is no surface"),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_broken_surface_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.obj").write_text(text)
    refused(tmp_path / "a.obj", message)


def test_indices_beyond_the_vertices_are_refused(tmp_path: Path) -> None:
    file = put(tmp_path, "a.ply", box(rgb=RED))
    data = bytearray(file.read_bytes())
    data[-4:] = struct.pack("<i", 1792)
    file.write_bytes(data)
    refused(file, "vertices that are not there|cannot be read", None)


def test_fewer_texture_coordinates_than_vertices_are_refused(tmp_path: Path) -> None:
    file = put(tmp_path, "mug.glb", mug())

    def fewer(tree: dict) -> None:
        (mesh,) = tree["meshes"]
        uv = mesh["primitives"][0]["attributes"]["TEXCOORD_0"]
        tree["accessors"][uv]["count"] = 7

    rewrite_glb(file, fewer)
    refused(file, "texture coordinates that do not fit|cannot be read", None)


def test_a_mesh_placed_a_million_times_is_counted_before_it_is_copied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vap_core.simulation.assets.scans.mesh_file.MAX_FACES", 100)
    monkeypatch.setattr(trimesh.Scene, "dump", lambda _: pytest.fail("copied"))
    scene = trimesh.Scene()
    for i in range(10):
        scene.add_geometry(box(rgb=RED), geom_name="box", node_name=f"node {i}")
    refused(put(tmp_path, "many.glb", scene), "has 120 faces, over 100; decimate", None)


@pytest.mark.parametrize("name", ["material.mtl", "material_0.png"])
def test_a_pipe_beside_an_obj_is_not_waited_for(tmp_path: Path, name: str) -> None:
    file = put(tmp_path, "mug.obj", mug())
    (tmp_path / name).unlink()
    os.mkfifo(tmp_path / name)
    refused(file, f"refers to '{name}', and there is no such file beside it", None)


def test_a_mesh_that_is_a_pipe_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.glb")
    refused(tmp_path / "a.glb", "is no regular file")


def test_an_import_has_a_limit_of_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importing, "MEMORY_BYTES", 200_000_000)
    monkeypatch.setattr(mesh_file, "SAMPLES", 100_000_000)
    file = put(tmp_path, "box.ply", box(rgb=RED))
    with pytest.raises(BadObject, match="takes over 0 GB|cannot be read .MemoryError|ArrayMemory"):
        import_scan(file, "my-box", "box", report=lambda _: None)


def test_an_import_has_a_limit_of_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def endless(*_: object) -> None:
        while True:
            with suppress(Exception):  # what a reader that goes on after anything does
                time.sleep(0)

    monkeypatch.setattr(importing, "CPU_LIMIT_S", 0.05)
    monkeypatch.setattr(importing, "read_mesh_file", endless)
    with pytest.raises(BadObject, match=r"or 0\.05 s of CPU; decimate"):
        import_scan(tmp_path / "a.stl", "a", "box", report=lambda _: None)


def test_limits_end_with_their_block() -> None:
    with pytest.raises(MemoryError), bounded(100_000_000, 10.0):
        bytearray(300_000_000)
    assert len(bytearray(300_000_000)) == 300_000_000
    with bounded(10**9, 0.05):
        pass
    stop = time.process_time() + 0.1
    while time.process_time() < stop:
        pass
