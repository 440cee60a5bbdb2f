"""Pulling weights: from a real server that is slow of wit, from folders, and what is said when something is wrong."""

import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from tests import tiny_foundation
from vap_core import hub
from vap_core.errors import MissingWeights, UnknownName

NAME = "dinov2-base"
SOURCE = hub.MODELS[NAME]


def silent(line: str) -> None:
    """Say nothing."""


@pytest.fixture
def origin(tmp_path: Path) -> Path:
    """A folder owner/name with the files of one model."""
    tiny_foundation.placeholder(tmp_path / "origin" / SOURCE.repo, SOURCE)
    return tmp_path / "origin"


@pytest.fixture
def pinned(origin: Path, monkeypatch: pytest.MonkeyPatch) -> hub.Source:
    """The model's pin, as it would be if the small file were the real one."""
    digest = hashlib.sha256((origin / SOURCE.repo / hub.TENSORS).read_bytes()).hexdigest()
    small = hub.Source(SOURCE.repo, SOURCE.revision, digest)
    monkeypatch.setitem(hub.MODELS, NAME, small)
    return small


class Hub(ThreadingHTTPServer):
    """A hub that serves `origin` at one revision, and breaks off `cuts` downloads of tensors half way."""

    daemon_threads = True

    def __init__(self, origin: Path, cuts: int = 0) -> None:
        super().__init__(("127.0.0.1", 0), Answer)
        self.origin, self.cuts = origin, cuts
        self.asked: list[tuple[str, str | None]] = []


class Answer(BaseHTTPRequestHandler):
    """owner/name/resolve/revision/file, with the headers that the hub gives."""

    server: Hub

    def log_message(self, format: str, *args: object) -> None:
        """Quiet."""

    def do_GET(self) -> None:
        span = self.headers.get("Range")
        self.server.asked.append((self.path, span))
        repo, _, rest = self.path.strip("/").partition("/resolve/")
        revision, _, file = rest.partition("/")
        path = self.server.origin / repo / file
        if revision != SOURCE.revision or not path.is_file():
            self.send_error(404)
            return
        data = path.read_bytes()
        start = int(span.removeprefix("bytes=").split("-")[0]) if span else 0
        self.send_response(206 if span else 200)
        self.send_header("Content-Length", str(len(data) - start))
        if span:
            self.send_header("Content-Range", f"bytes {start}-{len(data) - 1}/{len(data)}")
        self.end_headers()
        cut = file == hub.TENSORS and self.server.cuts > 0
        self.server.cuts -= cut
        self.wfile.write(data[start : (start + len(data)) // 2 if cut else None])


@contextmanager
def serving(origin: Path, monkeypatch: pytest.MonkeyPatch, cuts: int = 0) -> Iterator[Hub]:
    with Hub(origin, cuts) as server:
        monkeypatch.setenv(hub.ENDPOINT, f"http://127.0.0.1:{server.server_port}")
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def test_pull_takes_the_pinned_revision_from_the_hub_and_locks_every_file(
    origin: Path, pinned: hub.Source, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tmp_path / "store"
    with serving(origin, monkeypatch) as server:
        hub.pull([NAME], store, say=silent)
        assert {path for path, _ in server.asked} == {f"/{SOURCE.repo}/resolve/{SOURCE.revision}/{file}" for file in SOURCE.files}
        asked = len(server.asked)
        said: list[str] = []
        hub.pull([NAME], store, say=said.append)
        assert len(server.asked) == asked
        assert said == [f"{NAME}: whole, in {store / pinned.folder}"]
    assert hub.problem(NAME, store) is None
    folder = store / pinned.folder
    assert sorted(path.name for path in folder.iterdir()) == sorted([*pinned.files, hub.LOCK])
    lock = json.loads((folder / hub.LOCK).read_text())
    assert (lock["repo"], lock["revision"]) == (pinned.repo, pinned.revision)
    assert lock["sha256"] == {file: hashlib.sha256((folder / file).read_bytes()).hexdigest() for file in pinned.files}


def test_a_broken_download_goes_on_where_it_stopped(origin: Path, pinned: hub.Source, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = (origin / SOURCE.repo / hub.TENSORS).stat().st_size
    with serving(origin, monkeypatch, cuts=2) as server:
        hub.pull([NAME], tmp_path / "store", say=silent)
        spans = [span for path, span in server.asked if path.endswith(hub.TENSORS)]
    half = size // 2
    assert spans == [None, f"bytes={half}-", f"bytes={(half + size) // 2}-"]
    assert hub.problem(NAME, tmp_path / "store") is None


def test_an_interrupted_pull_goes_on_in_the_next_one(origin: Path, pinned: hub.Source, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tensors = origin / SOURCE.repo / hub.TENSORS
    data, store = tensors.read_bytes(), tmp_path / "store"
    tensors.unlink()
    with serving(origin, monkeypatch) as server:
        with pytest.raises(MissingWeights, match=rf"http://127.*{hub.TENSORS} cannot be had \(HTTP 404\); run it again to go on.*--from"):
            hub.pull([NAME], store, say=silent)
        assert hub.problem(NAME, store) == f"lacks {hub.TENSORS}"
        tensors.write_bytes(data)
        (store / pinned.folder / f".{hub.TENSORS}.{pinned.revision[:8]}.part").write_bytes(data[:10])
        hub.pull([NAME], store, say=silent)
        assert server.asked[-1] == (f"/{SOURCE.repo}/resolve/{SOURCE.revision}/{hub.TENSORS}", "bytes=10-")
    assert hub.problem(NAME, store) is None


def test_other_bytes_than_the_pinned_ones_are_refused_and_removed(origin: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(origin, monkeypatch), pytest.raises(MissingWeights, match=rf"{SOURCE.sha256[:12]}\.\. is pinned; it was removed"):
        hub.pull([NAME], tmp_path / "store", say=silent)
    assert not (tmp_path / "store" / SOURCE.folder / hub.TENSORS).exists()
    assert hub.problem(NAME, tmp_path / "store") is not None


def test_no_network_is_one_line_that_names_the_other_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(hub.ENDPOINT, "http://127.0.0.1:9")
    with pytest.raises(MissingWeights, match=r"http://127\.0\.0\.1:9/.* cannot be had \(.*refused.*--from") as caught:
        hub.pull([NAME], tmp_path, say=silent)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("layout", ["{folder}", "models--{folder}/snapshots/{revision}", "{repo}"])
def test_pull_from_a_folder_finds_stores_caches_and_plain_copies(pinned: hub.Source, origin: Path, tmp_path: Path, layout: str) -> None:
    other = tmp_path / "other"
    place = other / layout.format(folder=pinned.folder, revision=pinned.revision, repo=pinned.repo)
    place.parent.mkdir(parents=True)
    (origin / pinned.repo).rename(place)
    (place / "pytorch_model.bin").write_bytes(b"never copied")
    hub.pull([NAME], tmp_path / "store", origin=other, say=silent)
    assert sorted(path.name for path in (tmp_path / "store" / pinned.folder).iterdir()) == sorted([*pinned.files, hub.LOCK])
    assert hub.problem(NAME, tmp_path / "store") is None


def test_pull_from_a_folder_says_what_it_lacks(origin: Path, tmp_path: Path) -> None:
    (origin / SOURCE.repo / "config.json").unlink()
    with pytest.raises(MissingWeights, match="lacks config.json of facebook/dinov2-base; copy all of config.json, model.safetensors"):
        hub.pull([NAME], tmp_path / "store", origin=origin, say=silent)
    with pytest.raises(MissingWeights, match="no model.safetensors of facebook/dinov2-base in .*looked into facebook--dinov2-base, models--"):
        hub.pull([NAME], tmp_path / "store", origin=tmp_path, say=silent)


def test_a_store_taken_in_place_needs_its_lock_only(pinned: hub.Source, origin: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    hub.pull([NAME], store, origin=origin, say=silent)
    (store / pinned.folder / hub.LOCK).unlink()
    assert hub.problem(NAME, store) == f"lock.json lacks {', '.join(pinned.files)}"
    hub.pull([NAME], store, origin=store, say=silent)
    assert hub.problem(NAME, store) is None


@pytest.mark.parametrize("file", ["config.json", hub.TENSORS])
def test_a_changed_file_is_noticed_before_it_is_loaded(origin: Path, tmp_path: Path, file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(hub.KINDS, "alone", (NAME,))
    store = tmp_path / "store"
    hub.pull([NAME], store, origin=origin, unpinned=True, say=silent)
    (weights,) = hub.ready("alone", store)
    assert weights.folder == store / SOURCE.folder
    assert weights.identity.startswith(f"{NAME}-")
    assert json.loads((weights.folder / hub.LOCK).read_text())["revision"] is None
    changed = bytearray((weights.folder / file).read_bytes())
    changed[-1] ^= 1
    (weights.folder / file).write_bytes(bytes(changed))
    with pytest.raises(MissingWeights, match=rf"--stack alone: {NAME} \(SHA-256 of {file} differs from lock.json\) not usable"):
        hub.ready("alone", store)


def test_pinned_weights_carry_the_models_name_and_sizes_differ(
    pinned: hub.Source, origin: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(hub.KINDS, "alone", (NAME,))
    hub.pull([NAME], tmp_path / "store", origin=origin, say=silent)
    assert hub.ready("alone", tmp_path / "store")[0].identity == NAME
    assert len({encoder for _, encoder, _ in (hub.KINDS[kind] for kind in ("foundation", "foundation-small"))}) == 2


def test_pins_are_commits_and_hashes_of_safe_files() -> None:
    for source in hub.MODELS.values():
        assert len(source.revision) == 40
        assert len(source.sha256) == 64
        assert int(source.revision + source.sha256, 16)
        assert all(Path(file).suffix in (".safetensors", ".json", ".txt") for file in source.files)
    assert {name for models in hub.KINDS.values() for name in models} == set(hub.MODELS)
    with pytest.raises(UnknownName, match="known: foundation, foundation-small"):
        hub.names("embedded")


def vap(*words: str | Path, store: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, hub.VARIABLE: str(store)}
    return subprocess.run([sys.executable, "-m", "vap_core", *map(str, words)], capture_output=True, text=True, timeout=120, env=environment)


def test_commands_pull_and_list(tmp_path: Path) -> None:
    for name in hub.KINDS["foundation-small"]:
        tiny_foundation.placeholder(tmp_path / "usb" / hub.MODELS[name].folder, hub.MODELS[name])
    store = tmp_path / "store"
    done = vap("weights", "pull", "--stack", "foundation-small", "--from", tmp_path / "usb", "--unpinned", store=store)
    assert done.returncode == 0, done.stderr
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == list(hub.KINDS["foundation-small"])
    listed = vap("weights", "list", store=store)
    assert listed.stdout == hub.table(store) + "\n"
    assert "facebook/sam2.1-hiera-large@665f8e2a: lacks config.json, model.safetensors" in listed.stdout
    assert "facebook/sam2.1-hiera-tiny@de431c40: here" in listed.stdout
    assert "foundation: run `python -m vap_core weights pull --stack foundation`" in listed.stdout
    assert "foundation-small: run" not in listed.stdout
