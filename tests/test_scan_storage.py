"""A scan's folder is replaced whole: killed at any moment, the former or the new scan is there."""

import io
import json
import subprocess
import sys
import zlib
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trimesh

from tests.command import vap
from tests.test_media import claims
from vap_core.base import files
from vap_core.base.errors import BadObject, BadOutput
from vap_core.simulation.assets.scans import storage
from vap_core.simulation.assets.scans.storage import Scan, ScanMetadata
from vap_core.simulation.assets.shapes import Hull, Mesh

METADATA = ScanMetadata("mug", "cup", 0.2, "mug.glb", "0" * 64, "", "0")
KILLED_BETWEEN = """
import os, pathlib, sys
from vap_core.simulation.assets.scans import storage
folder = pathlib.Path(sys.argv[1])
metadata, scan = storage.load_scan(folder / "mug")
rename, calls = os.replace, []
def killed(*paths):
    calls.append(paths)
    if len(calls) == 2:
        os._exit(9)
    rename(*paths)
storage.os.replace = killed
storage.save_scan(folder, metadata, scan, replace=True)
"""


def cube() -> Scan:
    solid = trimesh.creation.box((0.06, 0.05, 0.08))
    vertex, normal = np.asarray(solid.vertices), np.asarray(solid.vertex_normals)
    form = Mesh(vertex=vertex, normal=normal, uv=vertex[:, :2], face=np.asarray(solid.faces))
    return Scan(form=form, hulls=(Hull(vertex, 2.4e-4),), image=np.zeros((4, 4, 3), np.uint8))


@pytest.fixture
def shelf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("VAP_OBJECTS", str(tmp_path))
    storage.save_scan(tmp_path, METADATA, cube())
    return tmp_path


@pytest.mark.parametrize("kind", ["nothing", "a file"])
def test_a_variable_that_names_no_folder_is_told(tmp_path: Path, kind: str) -> None:
    """Else an object in the folder that was meant would be unknown, or not be listed."""
    place = tmp_path / "objects"
    if kind == "a file":
        place.write_bytes(b"no folder")
    for words in (("list",), ("photograph", "my-mug", "--out", tmp_path / "photos")):
        done = vap("objects", *words, env={"VAP_OBJECTS": str(place)})
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.strip().startswith(f"error: objects: VAP_OBJECTS={place} is no folder; ")


def test_an_empty_variable_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VAP_OBJECTS", "")
    assert storage.scans_folder() == Path("data/objects")


def test_a_replacement_killed_between_its_renames_loses_nothing(shelf: Path) -> None:
    done = subprocess.run([sys.executable, "-c", KILLED_BETWEEN, shelf], check=False)
    assert done.returncode == 9
    assert not (shelf / "mug").exists()
    folders = storage.scan_folders()
    assert folders.keys() == {"mug"}
    metadata, _ = storage.load_scan(folders["mug"])
    assert metadata.name == "mug"
    with pytest.raises(BadOutput, match="mug exists; choose another --name or pass --replace"):
        storage.save_scan(shelf, METADATA, cube())
    heavier = replace(METADATA, mass_kg=0.3)
    storage.save_scan(shelf, heavier, cube(), replace=True)
    assert storage.scan_folders() == {"mug": shelf / "mug"}
    assert storage.load_scan(shelf / "mug")[0].mass_kg == 0.3
    assert not (shelf / ".mug.old").exists()


@pytest.mark.parametrize(
    "kind", [zlib.error, NotImplementedError, EOFError, SyntaxError, RuntimeError]
)
def test_whatever_a_decoder_raises_is_one_line(
    shelf: Path, monkeypatch: pytest.MonkeyPatch, kind: type[Exception]
) -> None:
    def decode(data: bytes) -> None:
        raise kind("odd")

    monkeypatch.setitem(storage.DECODERS, storage.MESH_FILE, decode)
    with pytest.raises(BadObject, match=r"mesh.npz lacks what an object needs \(odd\)"):
        storage._load_version(shelf / "mug", -1)


def unpacked(**arrays: np.ndarray) -> bytes:
    whole = io.BytesIO()
    np.savez_compressed(whole, **arrays)
    return whole.getvalue()


@pytest.mark.parametrize(
    ("file", "data", "words"),
    [
        ("mesh.npz", unpacked(vertex=np.zeros(3_000_000)), "over 20 MB unpacked"),  # it was read
        ("hulls.npz", unpacked(a=np.zeros(3_000_000)), "over 20 MB unpacked"),
        ("mesh.npz", unpacked(vertex=np.full((3, 3), np.nan)), "numbers that are not finite"),
        ("hulls.npz", unpacked(a=np.zeros(3)), "no hulls"),
        ("texture.png", claims(8000), "texture.png cannot be read as an image, it is none of PNG"),
    ],
)
def test_a_file_of_a_stranger_is_read_within_limits(
    shelf: Path, monkeypatch: pytest.MonkeyPatch, file: str, data: bytes, words: str
) -> None:
    monkeypatch.setattr(storage, "UNPACKED_BYTES", 20_000_000)
    about = json.loads((shelf / "mug" / "object.json").read_text())
    about["sha256"][file] = sha256(data).hexdigest()
    (shelf / "mug" / "object.json").write_text(json.dumps(about))
    (shelf / "mug" / file).write_bytes(data)
    with pytest.raises(BadObject, match=f"{file} lacks what an object needs .{words}"):
        storage.load_scan(shelf / "mug")


def test_a_table_is_read_within_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """2 MB of zeros took 3 GB."""
    monkeypatch.setattr(files, "LARGEST_BYTES", 1_000_000)
    pd.DataFrame({"a": np.zeros(1_000_000)}).to_parquet(tmp_path / "a.parquet")
    assert (tmp_path / "a.parquet").stat().st_size < 100_000
    with pytest.raises(BadOutput, match=r"a\.parquet cannot be opened \(over 0\.001 GB unpacked"):
        files.read_arrow(tmp_path / "a.parquet", "report", "publish it again")


def test_metadata_nested_too_deep_is_damaged(shelf: Path) -> None:
    (shelf / "mug" / "object.json").write_bytes(b"[" * 100_000)
    with pytest.raises(BadObject, match=r"object.json is damaged"):
        storage._read_metadata(shelf / "mug")


def test_another_process_may_take_the_name_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    encode = storage._encode_scan

    def encode_late(scan: Scan) -> dict[str, bytes]:
        monkeypatch.setattr(storage, "_encode_scan", encode)
        storage.save_scan(tmp_path, replace(METADATA, mass_kg=0.4), cube())
        return encode(scan)

    monkeypatch.setattr(storage, "_encode_scan", encode_late)
    with pytest.raises(BadOutput, match="mug exists; choose another --name or pass --replace"):
        storage.save_scan(tmp_path, METADATA, cube())
    assert storage.load_scan(tmp_path / "mug")[0].mass_kg == 0.4
    assert [path.name for path in tmp_path.iterdir()] == ["mug"]


def test_a_write_that_fails_leaves_no_scratch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(storage.os, "replace", full)
    with pytest.raises(BadOutput, match="No space left on device"):
        storage.save_scan(tmp_path, METADATA, cube())
    assert not list(tmp_path.iterdir())
