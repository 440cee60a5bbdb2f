"""Pulling weights: from a small hub on this machine, from folders, and the errors when it fails."""

import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from tests import tiny_foundation
from tests.command import vap
from tests.local_server import running
from vap_core.base.errors import MissingWeights, UnknownName
from vap_core.perception.foundation import weights as hub
from vap_core.perception.foundation.weights import LOCK, TENSORS, Source, find_problem, pull

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
def pinned(origin: Path, monkeypatch: pytest.MonkeyPatch) -> Source:
    """The model's pin, as it would be if the small file were the real one."""
    digest = hashlib.sha256((origin / SOURCE.repo / TENSORS).read_bytes()).hexdigest()
    small = Source(SOURCE.repo, SOURCE.revision, digest)
    monkeypatch.setitem(hub.MODELS, NAME, small)
    return small


class Hub(ThreadingHTTPServer):
    """A hub that serves `origin` at one revision, and breaks off `cuts` downloads of tensors half way.

    `requests` holds the path and the range of each.
    """

    daemon_threads = True

    def __init__(self, origin: Path, cuts: int = 0, revision: str = SOURCE.revision) -> None:
        super().__init__(("127.0.0.1", 0), Answer)
        self.origin, self.cuts, self.revision = origin, cuts, revision
        self.requests: list[tuple[str, str | None]] = []

    def downloads(self, file: str) -> list[str | None]:
        """The ranges in which a file was downloaded."""
        return [span for path, span in self.requests if path.endswith(f"/{file}")]


class Answer(BaseHTTPRequestHandler):
    """owner/name/resolve/revision/file, with the headers that the hub gives."""

    server: Hub

    def log_message(self, format: str, *args: object) -> None:
        """Quiet."""

    def do_GET(self) -> None:
        span = self.headers.get("Range")
        self.server.requests.append((self.path, span))
        repo, _, rest = self.path.strip("/").partition("/resolve/")
        revision, _, file = rest.partition("/")
        path = self.server.origin / repo / file
        if revision != self.server.revision or not path.is_file():
            self.send_error(404)
            return
        data = path.read_bytes()
        start = int(span.removeprefix("bytes=").split("-")[0]) if span else 0
        self.send_response(206 if span else 200)
        self.send_header("Content-Length", str(len(data) - start))
        if span:
            self.send_header("Content-Range", f"bytes {start}-{len(data) - 1}/{len(data)}")
        self.end_headers()
        cut = file == TENSORS and self.server.cuts > 0
        self.server.cuts -= cut
        self.wfile.write(data[start : (start + len(data)) // 2 if cut else None])


@contextmanager
def serving(
    origin: Path,
    monkeypatch: pytest.MonkeyPatch,
    cuts: int = 0,
    revision: str = SOURCE.revision,
) -> Iterator[Hub]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with Hub(origin, cuts, revision) as server:
        url = f"http://127.0.0.1:{server.server_port}"
        monkeypatch.setenv(hub.ENDPOINT_VARIABLE, url)
        with running(server):
            yield server


def test_pull_takes_the_pinned_revision_from_the_hub_and_locks_every_file(
    origin: Path, pinned: Source, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "store"
    with serving(origin, monkeypatch) as server:
        pull([NAME], place, say=silent)
        assert {path for path, _ in server.requests} == {
            f"/{SOURCE.repo}/resolve/{SOURCE.revision}/{file}" for file in SOURCE.files
        }
        n = len(server.requests)
        said: list[str] = []
        pull([NAME], place, say=said.append)
        assert len(server.requests) == n
        assert said == [f"{NAME}: whole, in {place / pinned.folder}"]
    assert find_problem(NAME, place) is None
    folder = place / pinned.folder
    assert sorted(path.name for path in folder.iterdir()) == sorted([*pinned.files, LOCK])
    lock = json.loads((folder / LOCK).read_text())
    assert (lock["repo"], lock["revision"]) == (pinned.repo, pinned.revision)
    assert lock["sha256"] == {
        file: hashlib.sha256((folder / file).read_bytes()).hexdigest() for file in pinned.files
    }


def test_a_broken_download_goes_on_where_it_stopped(
    origin: Path, pinned: Source, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "huggingface_hub.constants.DOWNLOAD_CHUNK_SIZE", 1
    )  # half a chunk is not kept
    size = (origin / SOURCE.repo / TENSORS).stat().st_size
    with serving(origin, monkeypatch, cuts=2) as server:
        pull([NAME], tmp_path / "store", say=silent)
        spans = server.downloads(TENSORS)
    half = size // 2
    assert spans == [None, f"bytes={half}-", f"bytes={(half + size) // 2}-"]
    assert find_problem(NAME, tmp_path / "store") is None


def test_an_interrupted_pull_goes_on_in_the_next_one(
    origin: Path, pinned: Source, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tensors = origin / SOURCE.repo / TENSORS
    data, place = tensors.read_bytes(), tmp_path / "store"
    tensors.unlink()
    with serving(origin, monkeypatch) as server:
        with pytest.raises(
            MissingWeights,
            match=rf"http://127.*{TENSORS} cannot be had \(HTTP 404\); run it again to go on.*--from",
        ):
            pull([NAME], place, say=silent)
        assert find_problem(NAME, place) == f"lacks {TENSORS}"
        tensors.write_bytes(data)
        part = place / pinned.folder / f".{TENSORS}.{pinned.revision[:8]}.part"
        part.write_bytes(data[:10])
        pull([NAME], place, say=silent)
        assert server.downloads(TENSORS) == [None, "bytes=10-"]
    assert find_problem(NAME, place) is None


def test_a_second_pull_waits_and_then_has_nothing_to_do(
    origin: Path, pinned: Source, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "store"
    said: list[str] = []
    with serving(origin, monkeypatch, cuts=1) as server:
        pulls = [
            threading.Thread(target=pull, args=([NAME], place), kwargs={"say": said.append})
            for _ in range(2)
        ]
        for thread in pulls:
            thread.start()
        for thread in pulls:
            thread.join()
        assert len(server.downloads("config.json")) == 1
    assert sorted(line.split(" in ")[0].split(",")[0] for line in said)[1] == f"{NAME}: whole"
    assert find_problem(NAME, place) is None


def test_other_bytes_than_the_pinned_ones_are_refused_and_removed(
    origin: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        serving(origin, monkeypatch),
        pytest.raises(MissingWeights, match=rf"{SOURCE.sha256[:12]}\.\. is pinned; it was removed"),
    ):
        pull([NAME], tmp_path / "store", say=silent)
    assert not (tmp_path / "store" / SOURCE.folder / TENSORS).exists()
    assert find_problem(NAME, tmp_path / "store") is not None


def test_no_network_is_one_line_that_names_the_other_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("huggingface_hub.file_download.time.sleep", lambda seconds: None)
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setenv(hub.ENDPOINT_VARIABLE, "http://127.0.0.1:9")
    with pytest.raises(
        MissingWeights, match=r"http://127\.0\.0\.1:9/.* cannot be had \(.*refused.*--from"
    ) as caught:
        pull([NAME], tmp_path, say=silent)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("layout", ["{folder}", "models--{folder}/snapshots/{revision}", "{repo}"])
def test_pull_from_a_folder_finds_stores_caches_and_plain_copies(
    pinned: Source, origin: Path, tmp_path: Path, layout: str
) -> None:
    other = tmp_path / "other"
    place = other / layout.format(folder=pinned.folder, revision=pinned.revision, repo=pinned.repo)
    place.parent.mkdir(parents=True)
    (origin / pinned.repo).rename(place)
    (place / "pytorch_model.bin").write_bytes(b"never copied")
    pull([NAME], tmp_path / "store", origin=other, say=silent)
    assert sorted(path.name for path in (tmp_path / "store" / pinned.folder).iterdir()) == sorted(
        [*pinned.files, LOCK]
    )
    assert find_problem(NAME, tmp_path / "store") is None


def test_pull_from_a_folder_says_what_it_lacks(origin: Path, tmp_path: Path) -> None:
    (origin / SOURCE.repo / "config.json").unlink()
    with pytest.raises(
        MissingWeights,
        match="lacks config.json of facebook/dinov2-base; copy all of config.json, model.safetensors",
    ):
        pull([NAME], tmp_path / "store", origin=origin, say=silent)
    with pytest.raises(
        MissingWeights,
        match="no model.safetensors of facebook/dinov2-base in .*looked into facebook--dinov2-base, models--",
    ):
        pull([NAME], tmp_path / "store", origin=tmp_path, say=silent)


def test_a_folder_that_will_not_do_leaves_the_store_as_it_is(
    pinned: Source, origin: Path, tmp_path: Path
) -> None:
    """Whole weights survive a wrong, a damaged and an incomplete folder, and a store pulled twice."""
    place = tmp_path / "store"
    pull([NAME], place, origin=origin, say=silent)
    kept = contents(place / pinned.folder)
    other = tmp_path / "other"
    tiny_foundation.placeholder(other / pinned.folder, pinned)
    with (other / pinned.folder / TENSORS).open("ab") as file:
        file.write(b"more")
    with pytest.raises(
        MissingWeights, match=r"in .*other.* is expected; nothing was changed\. Copy"
    ):
        pull([NAME], place, origin=other, say=silent)
    assert contents(place / pinned.folder) == kept

    (origin / pinned.repo / "config.json").unlink()
    for folder in (origin, tmp_path):
        with pytest.raises(MissingWeights, match=r"lacks config\.json|no model\.safetensors"):
            pull([NAME], place, origin=folder, say=silent)
    assert contents(place / pinned.folder) == kept
    assert find_problem(NAME, place) is None


def test_a_damaged_small_file_of_another_store_is_noticed(
    pinned: Source, origin: Path, tmp_path: Path
) -> None:
    """The lock of the store that is copied says what it should be."""
    pull([NAME], tmp_path / "usb", origin=origin, say=silent)
    (tmp_path / "usb" / pinned.folder / "config.json").write_bytes(b"{")
    with pytest.raises(
        MissingWeights, match=r"config\.json of .* is expected; nothing was changed"
    ):
        pull([NAME], tmp_path / "store", origin=tmp_path / "usb", say=silent)


def test_a_copy_that_breaks_off_leaves_the_store_as_it_is(
    pinned: Source, origin: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "store"
    pull([NAME], place, origin=origin, say=silent)
    kept = contents(place / pinned.folder)

    def full(source: Path, target: Path) -> None:
        target.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("shutil.copyfile", full)
    with pytest.raises(MissingWeights, match="cannot be written .No space left on device"):
        pull([NAME], place, origin=origin, say=silent)
    assert contents(place / pinned.folder) == kept


def test_a_store_with_other_weights_is_not_emptied_by_a_pull_from_itself(
    origin: Path, tmp_path: Path
) -> None:
    place = tmp_path / "store"
    pull([NAME], place, origin=origin, unpinned=True, say=silent)
    kept = contents(place / SOURCE.folder)
    with pytest.raises(MissingWeights, match="pass --unpinned to use other weights on purpose"):
        pull([NAME], place, origin=place, say=silent)
    assert contents(place / SOURCE.folder) == kept


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_store_taken_in_place_needs_its_lock_only(
    pinned: Source, origin: Path, tmp_path: Path
) -> None:
    place = tmp_path / "store"
    pull([NAME], place, origin=origin, say=silent)
    (place / pinned.folder / LOCK).unlink()
    assert find_problem(NAME, place) == f"lock.json lacks {', '.join(pinned.files)}"
    pull([NAME], place, origin=place, say=silent)
    assert find_problem(NAME, place) is None


@pytest.mark.parametrize("file", ["config.json", TENSORS])
def test_a_changed_file_is_noticed_before_it_is_loaded(
    origin: Path, tmp_path: Path, file: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(hub.KINDS, "alone", (NAME,))
    place = tmp_path / "store"
    pull([NAME], place, origin=origin, unpinned=True, say=silent)
    (weights,) = hub.verify_stack("alone", place)
    assert weights.folder == place / SOURCE.folder
    assert weights.identity.startswith(f"{NAME}-")
    assert json.loads((weights.folder / LOCK).read_text())["revision"] is None
    changed = bytearray((weights.folder / file).read_bytes())
    changed[-1] ^= 1
    (weights.folder / file).write_bytes(bytes(changed))
    with pytest.raises(
        MissingWeights,
        match=rf"--stack alone: {NAME} \(SHA-256 of {file} differs from lock.json\) not usable",
    ):
        hub.verify_stack("alone", place)


def test_pinned_weights_carry_the_models_name_and_sizes_differ(
    pinned: Source, origin: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(hub.KINDS, "alone", (NAME,))
    pull([NAME], tmp_path / "store", origin=origin, say=silent)
    assert hub.verify_stack("alone", tmp_path / "store")[0].identity == NAME
    assert (
        len(
            {
                encoder
                for _, encoder, _ in (
                    hub.KINDS[kind] for kind in ("foundation", "foundation-small")
                )
            }
        )
        == 2
    )


def test_pins_are_commits_and_hashes_of_safe_files() -> None:
    """The stacks' models are pinned; an option outside of them, which nobody has pulled here, is not."""
    pinned = {name for models in hub.KINDS.values() for name in models} | {hub.TEXT}
    options = {name for models in hub.PARTS.values() for name in models}
    assert pinned | options == set(hub.MODELS)
    for name, source in hub.MODELS.items():
        assert all(Path(file).suffix in (".safetensors", ".json", ".txt") for file in source.files)
        if name not in pinned:
            assert (source.revision, source.sha256) == ("main", "")
            continue
        assert len(source.revision) == 40
        assert len(source.sha256) == 64
        assert int(source.revision + source.sha256, 16)
    assert hub.models_of("embedded") == (hub.TEXT,)
    with pytest.raises(UnknownName, match="known: embedded, foundation, foundation-small"):
        hub.models_of("huge")


def test_commands_pull_and_list(tmp_path: Path) -> None:
    for name in hub.KINDS["foundation-small"]:
        tiny_foundation.placeholder(tmp_path / "usb" / hub.MODELS[name].folder, hub.MODELS[name])
    place = tmp_path / "store"
    done = vap(
        "weights",
        "pull",
        "--stack",
        "foundation-small",
        "--from",
        tmp_path / "usb",
        "--unpinned",
        env={hub.VARIABLE: str(place)},
    )
    assert done.returncode == 0, done.stderr
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == list(
        hub.KINDS["foundation-small"]
    )
    listed = vap("weights", "list", env={hub.VARIABLE: str(place)})
    assert listed.stdout == hub.weights_table(place) + "\n"
    assert (
        "facebook/sam2.1-hiera-large@665f8e2a: lacks config.json, model.safetensors"
        in listed.stdout
    )
    assert "facebook/sam2.1-hiera-tiny@de431c40: here" in listed.stdout
    assert "foundation: run `./vap weights pull --stack foundation`" in listed.stdout
    assert "foundation-small: run" not in listed.stdout
