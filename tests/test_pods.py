"""PODS in the form of measure photos: from a hub on this machine, whose files are laid out as the public ones."""

import hashlib
import io
import json
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from tests.command import refused
from tests.local_server import running
from vap_core.base.errors import BadPhotoSet
from vap_core.base.photos import load_mask
from vap_core.evaluation.photos import pods
from vap_core.evaluation.photos.folder import read_photo_set
from vap_core.perception.foundation import downloads

COMMIT = "0123456789abcdef0123456789abcdef01234567"
KINDS = {"mugs_red": "mug", "totes_a_1": "tote", "mugs_other": "mug"}
BOX = (10, 4, 30, 20)


def picture(seed: int, how: str) -> bytes:
    """Noise of 48 x 32 pixels."""
    out = io.BytesIO()
    rgb = np.random.default_rng(seed).integers(0, 255, (32, 48, 3), dtype=np.uint8)
    Image.fromarray(rgb).save(out, how)
    return out.getvalue()


def drawn(bright: int, mode: str) -> bytes:
    """A mask of `BOX`."""
    mask = np.zeros((32, 48), np.uint8)
    mask[BOX[1] : BOX[3], BOX[0] : BOX[2]] = bright
    out = io.BytesIO()
    Image.fromarray(mask).convert(mode).save(out, "PNG")
    return out.getvalue()


def parquet(path: Path, rows: list[tuple[str, bytes, bytes]]) -> None:
    """As `datasets` writes pictures: bytes and a name."""
    columns = {
        "image": [{"bytes": image, "path": None} for _, image, _ in rows],
        "mask": [{"bytes": mask, "path": None} for _, _, mask in rows],
        "label": [label for label, _, _ in rows],
        "scene_type": ["train"] * len(rows),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns), path)


@pytest.fixture
def origin(tmp_path: Path) -> Path:
    """Three references and two scenes of each object, of which one is not for reporting."""
    folder = tmp_path / "origin"
    mask = drawn(255, "L")
    train = [(name, picture(i, "JPEG"), mask) for name in KINDS for i in range(3)]
    parquet(folder / "data/train-00000-of-00001.parquet", train)
    for k, bright in enumerate((255, 1)):  # of 255 levels, or of two
        dense = [(name, picture(9 + k, "PNG"), drawn(bright, "RGB")) for name in KINDS]
        parquet(folder / f"data/test_dense-0000{k}-of-00002.parquet", dense)
    parquet(folder / "data/test-00000-of-00001.parquet", train)
    split = {name: "val" if name == "mugs_other" else "test" for name in KINDS}
    about = {"classes": list(KINDS), "class_to_sc": KINDS, "class_to_split": split}
    (folder / "pods_info.json").write_text(json.dumps(about))
    return folder


class Hub(ThreadingHTTPServer):
    """The two answers of the hub that are needed; `wrong` names a file whose checksum is another's."""

    daemon_threads = True

    def __init__(self, origin: Path, wrong: str = "") -> None:
        super().__init__(("127.0.0.1", 0), Answer)
        self.origin, self.wrong = origin, wrong
        self.paths: list[str] = []

    def listing(self) -> dict[str, object]:
        files = []
        for path in sorted(self.origin.rglob("*")):
            if path.is_file():
                name = path.relative_to(self.origin).as_posix()
                entry: dict[str, object] = {"rfilename": name, "size": path.stat().st_size}
                if path.suffix == ".parquet":
                    data = b"" if name == self.wrong else path.read_bytes()
                    digest = hashlib.sha256(data).hexdigest()
                    entry["lfs"] = {"sha256": digest, "size": len(data), "pointerSize": 1}
                files.append(entry)
        return {"id": pods.REPO, "sha": COMMIT, "siblings": files}


class Answer(BaseHTTPRequestHandler):
    server: Hub

    def log_message(self, format: str, *args: object) -> None:
        """Quiet."""

    def do_GET(self) -> None:
        path, _, _ = self.path.partition("?")
        self.server.paths.append(path)
        if path == f"/api/datasets/{pods.REPO}":
            data = json.dumps(self.server.listing()).encode()
        else:
            prefix = f"/datasets/{pods.REPO}/resolve/{COMMIT}/"
            data = (self.server.origin / path.removeprefix(prefix)).read_bytes()
        self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)


@contextmanager
def serving(origin: Path, monkeypatch: pytest.MonkeyPatch, wrong: str = "") -> Iterator[Hub]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with Hub(origin, wrong) as server:
        monkeypatch.setenv(downloads.ENDPOINT_VARIABLE, f"http://127.0.0.1:{server.server_port}")
        with running(server):
            yield server


def silent(line: str) -> None:
    """Say nothing."""


def test_reported_objects_become_references_scenes_boxes_and_masks(
    origin: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with serving(origin, monkeypatch) as server:
        folder = pods.pods(tmp_path / "pods", say=silent)
        assert not any("/data/test-" in path for path in server.paths)  # 1 GB that is not needed
        n = len(server.paths)
        assert pods.pods(tmp_path / "pods", say=silent) == folder
        assert len(server.paths) == n
    photo_set = read_photo_set(folder)
    assert {s.name: s.category for s in photo_set.subjects} == {"mugs_red": "mug", "totes_a_1": "tote"}  # fmt: skip
    for subject in photo_set.subjects:
        assert [photo.path.suffix for photo in subject.photos] == [".jpg"] * 3
        assert all(photo.box.tolist() == list(BOX) for photo in subject.photos)
    assert [scene.name for scene in photo_set.scenes] == [
        "mugs_red-00.png", "mugs_red-01.png", "totes_a_1-00.png", "totes_a_1-01.png",
    ]  # fmt: skip
    for scene in photo_set.scenes:
        ((name, boxes),) = scene.boxes.items()
        assert scene.name.startswith(name)
        assert boxes.tolist() == [list(BOX)]
        mask = load_mask(scene.masks[name])
        assert mask.sum() == (BOX[2] - BOX[0]) * (BOX[3] - BOX[1])
        assert mask[BOX[1], BOX[0]]


def test_a_copy_takes_the_place_of_the_hub(origin: Path, tmp_path: Path) -> None:
    folder = pods.pods(tmp_path / "pods", origin, say=silent)
    assert len(read_photo_set(folder).scenes) == 4


def test_without_the_hub_one_line_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(downloads.ENDPOINT_VARIABLE, "http://127.0.0.1:9")
    with pytest.raises(BadPhotoSet, match=r"cannot be had from http://127.0.0.1:9 .*hf download chaenayo/PODS --repo-type dataset --local-dir DIR`, and pass --from DIR") as caught:  # fmt: skip
        pods.pods(tmp_path / "pods", say=silent)
    assert "\n" not in str(caught.value)


def test_other_bytes_than_the_hubs_are_refused(
    origin: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = "data/train-00000-of-00001.parquet"
    with (
        serving(origin, monkeypatch, wrong),
        pytest.raises(BadPhotoSet, match="the SHA-256 of data/train-.* is not the hub's"),
    ):
        pods.pods(tmp_path / "pods", say=silent)
    assert not list((tmp_path / "pods").rglob("train*"))


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        ("info", "does not tell objects from kinds"),
        ("label", "names no objects, or"),
        ("mask", "is empty"),
        ("size", r"has \(8, 8\) pixels, the upright photo \(32, 48\)"),
        ("image", "is no image"),
        ("parquet", "cannot be read"),
        ("few", "photos of 1 of the 2 objects"),
    ],
)
def test_what_is_not_as_published_is_one_line(
    origin: Path, tmp_path: Path, broken: str, words: str
) -> None:
    train = origin / "data/train-00000-of-00001.parquet"
    good = ("mugs_red", picture(0, "JPEG"), drawn(255, "L"))
    match broken:
        case "info":
            (origin / "pods_info.json").write_text('{"classes": ["mugs_red"]}')
        case "label":
            about = {"classes": ["../x"], "class_to_sc": {"../x": "mug"}, "class_to_split": {"../x": "test"}}  # fmt: skip
            (origin / "pods_info.json").write_text(json.dumps(about))
        case "mask":
            parquet(train, [(*good[:2], drawn(0, "L"))])
        case "size":
            out = io.BytesIO()
            Image.new("L", (8, 8), 255).save(out, "PNG")
            parquet(train, [(*good[:2], out.getvalue())])
        case "image":
            parquet(train, [(good[0], b"no picture", good[2])])
        case "parquet":
            train.write_bytes(b"PAR1 and no more")
        case "few":
            parquet(train, [good])
    with pytest.raises(BadPhotoSet, match=words) as caught:
        pods.pods(tmp_path / "pods", origin, say=silent)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "pods" / "scenes.csv").exists()


def test_the_command_takes_a_folder_or_a_benchmark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pods, "FOLDER", tmp_path / "pods")
    for options, words in (
        ((), "give a folder or --benchmark pods"),
        ((tmp_path, "--benchmark", "pods"), "give a folder or --benchmark pods"),
        (("--benchmark", "coco"), "benchmark 'coco' is unknown; known: pods"),
        (("--benchmark", "pods", "--from", tmp_path), "does not tell objects from kinds"),
    ):
        assert words in refused("measure", "photos", *options)


@pytest.mark.parametrize(
    "words", [("measure", "perception", "--quick"), ("measure", "photos", "--benchmark", "pods")]
)
def test_missing_weights_are_named_before_anything_is_fetched_or_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.setenv("VAP_WEIGHTS", str(tmp_path / "none"))
    monkeypatch.setattr(pods, "FOLDER", tmp_path / "pods")
    for stack, remedy in (
        ("foundation", "weights pull --stack foundation`"),
        ("embedded:tracker=sam3", "weights pull --stack embedded:tracker=sam3 --unpinned`"),
    ):
        line = refused(*words, "--stack", stack, "--out", tmp_path / "out")
        assert remedy in line
        assert "--from DIR" in line
    assert "stack 'fast' is unknown" in refused(*words, "--stack", "fast")
    assert not list(tmp_path.iterdir())
