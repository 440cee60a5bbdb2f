"""Mutated files of every kind are read, or refused in one line: some cases every day, CASES in the sweep."""

import json
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from tests.scanned import RED, box, mug
from tests.test_scan_storage import METADATA, cube
from tests.toys import personal
from vap_core.base.errors import VapError
from vap_core.base.files import rows_matching
from vap_core.base.media import load_photo
from vap_core.instruction import parse
from vap_core.memory import load as load_object
from vap_core.memory import save as save_object
from vap_core.policies.lerobot.checkpoints import PIPELINES, refuse_code
from vap_core.policies.mini_pi0 import learned_token
from vap_core.simulation.assets.scans import mesh_file, storage
from vap_core.simulation.assets.scans.mesh_file import read_mesh_file
from vap_core.simulation.suites import lists
from vap_core.study import store
from vap_core.study.photos import _read_csv
from vap_core.study.results import read_published

CASES, DAILY = 10_000, 30
TABLE = pd.DataFrame({"suite": ["a", "b"], "steps": [3, 40], "margin": [0.1, None]})
WORDS = (
    b"and or not ( ) = < > + - * / % suite steps margin 1 0 -1 1e9 null 'a' abs( my cup on".split()
)


@dataclass(frozen=True)
class Parser:
    """How a whole file of the kind is made, and how a mutated one is written and read."""

    seeds: Callable[[Path], list[bytes]]
    read: Callable[[Path, bytes], object]


def mutated(seed: bytes, rng: np.random.Generator) -> bytes:
    """A few bits flipped, bytes cut, doubled or inserted, or numbers set to extremes."""
    data = bytearray(seed)
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(0, max(len(data), 1)))
        kind = rng.integers(0, 7)
        if kind == 0 and data:
            data[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            data[at : at + int(rng.integers(1, 16))] = b""
        elif kind == 2:
            data[at:at] = data[at : at + int(rng.integers(1, 64))]
        elif kind == 3:
            data[at : at + 4] = rng.choice([b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f"])
        elif kind == 4:
            data[at:at] = b" " + bytes(rng.choice(WORDS)) + b" "
        elif kind == 5 and rng.random() < 0.2:
            del data[at:]
        elif data:
            data[at] = int(rng.integers(0, 256))
    return bytes(data)


def reader(name: str, read: Callable[[Path], object]) -> Callable[[Path, bytes], object]:
    def write_and_read(folder: Path, data: bytes) -> object:
        (folder / name).write_bytes(data)
        return read(folder)

    return write_and_read


def pictures(folder: Path) -> list[bytes]:
    image = Image.fromarray(np.random.default_rng(0).integers(0, 256, (9, 7, 3), np.uint8))
    found = []
    for kind in ("JPEG", "PNG", "WEBP", "BMP", "GIF", "TIFF"):
        file = BytesIO()
        image.save(file, kind)
        found.append(file.getvalue())
    return found


def memories(folder: Path) -> list[bytes]:
    return [save_object(folder, personal("mug", "cup", RED), replace=True).read_bytes()]


def words(folder: Path) -> list[bytes]:
    token = learned_token.Token("mug", np.zeros(4, np.float32), 0.5, "0" * 64)
    return [learned_token.save(folder, token).read_bytes()]


def meshes(suffix: str) -> Callable[[Path], list[bytes]]:
    def make(folder: Path) -> list[bytes]:
        found = []
        for mesh in (box(rgb=RED), mug(n=6, rows=2)):
            mesh.export(folder / f"seed.{suffix}")
            found.append((folder / f"seed.{suffix}").read_bytes())
        return found

    return make


def mesh_reader(suffix: str) -> Callable[[Path, bytes], object]:
    return reader(f"a.{suffix}", lambda folder: read_mesh_file(folder / f"a.{suffix}", "#aa3322"))


def scan_files(folder: Path) -> list[bytes]:
    """Every file of a scan, with its number first."""
    storage.save_scan(folder, METADATA, cube(), replace=True)
    names = (*storage.FILES, storage.METADATA_FILE)
    return [bytes([i]) + (folder / "mug" / name).read_bytes() for i, name in enumerate(names)]


def read_scan(folder: Path, data: bytes) -> object:
    """The checksums are set right, so that the decoders meet the mutated bytes."""
    scan = folder / "mug"
    number = data[0] if data and data[0] < 4 else 3
    if not (scan / "whole").exists():
        (scan / "whole").write_bytes((scan / storage.METADATA_FILE).read_bytes())
    about = json.loads((scan / "whole").read_bytes())
    kept = {name: (scan / name).read_bytes() for name in storage.FILES}
    if number == 3:
        (scan / storage.METADATA_FILE).write_bytes(data[1:])
    else:
        name = storage.FILES[number]
        (scan / name).write_bytes(data[1:])
        about["sha256"][name] = sha256(data[1:]).hexdigest()
        (scan / storage.METADATA_FILE).write_text(json.dumps(about))
    storage._load_version.cache_clear()
    try:
        return storage.load_scan(scan)
    finally:
        for name, whole in kept.items():
            (scan / name).write_bytes(whole)


def list_rows(folder: Path) -> list[bytes]:
    return (lists.FOLDER / "tabletop.jsonl").read_bytes().splitlines()[:2]


def manifests(folder: Path) -> list[bytes]:
    return [json.dumps({"digest": "0", "configuration": {"tasks": [["a", "b"]]}}).encode()]


def tables(folder: Path) -> list[bytes]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    notes = json.dumps([{"digest": "0", "configuration": {}}]).encode()
    table = pa.table({"configuration": ["0"], "suite": ["a"], "seed": [1]})
    sink = BytesIO()
    pq.write_table(table.replace_schema_metadata({b"runs": notes}), sink)
    return [sink.getvalue()]


def pipelines(folder: Path) -> list[bytes]:
    step = {"class": "lerobot.processor.RenameObservationsProcessorStep", "config": {}}
    (folder / PIPELINES[1]).write_text('{"steps": []}')
    return [json.dumps({"name": "a", "steps": [step, {"registry_name": "x"}]}).encode()]


def text_reader(read: Callable[[str], object]) -> Callable[[Path, bytes], object]:
    return lambda folder, data: read(data.decode(errors="replace"))


PARSERS = {
    "photo": Parser(pictures, reader("a.png", lambda f: load_photo(f / "a.png"))),
    "memory": Parser(
        memories,
        reader("mug.object.safetensors", lambda f: load_object(f / "mug.object.safetensors")),
    ),
    "learned word": Parser(
        words,
        reader("mug.token.safetensors", lambda f: learned_token.load(f, "mug", "0" * 64)),
    ),
    "GLB": Parser(meshes("glb"), mesh_reader("glb")),
    "OBJ": Parser(meshes("obj"), mesh_reader("obj")),
    "PLY": Parser(meshes("ply"), mesh_reader("ply")),
    "STL": Parser(meshes("stl"), mesh_reader("stl")),
    "imported object": Parser(scan_files, read_scan),
    "episode list": Parser(list_rows, text_reader(lambda line: lists._parse_row(line, "row 1"))),
    "run manifest": Parser(manifests, reader("run.json", store.read_manifest)),
    "published table": Parser(
        tables, reader("a.parquet", lambda f: read_published(f / "a.parquet"))
    ),
    "boxes": Parser(
        lambda _: [b"photo,x0,y0\na.jpg,1,2\nb.jpg,,\n"],
        reader("a.csv", lambda f: _read_csv(f / "a.csv", ("photo", "x0", "y0"))),
    ),
    "checkpoint pipeline": Parser(pipelines, reader(PIPELINES[0], refuse_code)),
    "condition": Parser(
        lambda _: [b"margin < 0.05 and steps = 3", b"abs(steps) > 2 or suite in ('a')"],
        text_reader(lambda text: rows_matching(TABLE, text)),
    ),
    "instruction": Parser(
        lambda _: [b"put my red cup on the plate", "pick up Anna\u2019s mug and my owl".encode()],
        text_reader(parse),
    ),
}


@contextmanager
def few_samples() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mesh_file, "SAMPLES", 500)
        yield


@cache
def quiet() -> None:
    import logging

    logging.getLogger("trimesh").disabled = True


def runs() -> Iterator[object]:
    """Every parser with its numbers of cases; what imports lerobot for seconds waits for the sweep."""
    for name in PARSERS:
        if name != "checkpoint pipeline":
            yield pytest.param(name, DAILY)
        yield pytest.param(name, CASES, marks=[pytest.mark.sweep, pytest.mark.timeout(3600)])


@pytest.mark.parametrize(("name", "cases"), list(runs()))
def test_a_mutated_file_is_read_or_refused_in_one_line(
    tmp_path: Path, name: str, cases: int, record_property: Callable[[str, object], None]
) -> None:
    quiet()
    parser = PARSERS[name]
    seeds = parser.seeds(tmp_path)
    refused = 0
    with few_samples(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for case in range(cases):
            rng = np.random.default_rng([case, 3])
            data = mutated(seeds[case % len(seeds)], rng)
            said = ""
            try:
                parser.read(tmp_path, data)
            except VapError as error:
                said = str(error)
            except Exception as error:
                raise AssertionError(f"{name}, case {case}: {data[:200]!r}") from error
            refused += bool(said)
            assert "\n" not in said, (name, case)
            assert len(said) <= 600 + len(str(tmp_path)), (name, case)
    assert refused or name in ("instruction", "photo")
    record_property("cases", cases)
    record_property("refused", refused)
