"""A pipe where a file is expected is refused at once: to open it would wait for its writer."""

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from vap_core.base.errors import VapError
from vap_core.base.files import read_file
from vap_core.base.media import frame_rate, frames, load_photo
from vap_core.memory import load as load_object
from vap_core.perception.foundation.weights import read_lock
from vap_core.policies.lerobot.checkpoints import locate
from vap_core.policies.mini_pi0.learned_token import load as load_token
from vap_core.recording import read_summary
from vap_core.simulation.assets.scans.mesh_file import read_mesh_file
from vap_core.simulation.assets.scans.storage import load_scan
from vap_core.simulation.suites import lists
from vap_core.study import logs, store
from vap_core.study.objects import read_source
from vap_core.study.photos import _read_csv
from vap_core.study.results import read_published
from vap_make.films import dataset

READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "photo": ("a.jpg", lambda folder: load_photo(folder / "a.jpg")),
    "video": ("a.mp4", lambda folder: next(frames(folder / "a.mp4"))),
    "frame rate": ("a.mp4", lambda folder: frame_rate(folder / "a.mp4")),
    "object": ("a.object.safetensors", lambda f: load_object(f / "a.object.safetensors")),
    "word": ("a.token.safetensors", lambda folder: load_token(folder, "a", "")),
    "mesh": ("a.glb", lambda folder: read_mesh_file(folder / "a.glb")),
    "scan": ("object.json", load_scan),
    "list": ("a.jsonl", lambda folder: lists.read("a", folder)),
    "lists' hashes": ("manifest.json", lambda folder: lists.digest("a", folder)),
    "run": ("run.json", store.read_manifest),
    "episodes": ("parts/a.parquet", store.read),
    "traces": ("traces/a.parquet", lambda folder: list(logs.read_states(folder))),
    "published": ("a.parquet", lambda folder: read_published(folder / "a.parquet")),
    "own objects": ("objects.csv", read_source),
    "boxes": ("a.csv", lambda folder: _read_csv(folder / "a.csv", ("photo",))),
    "recording": ("a.rrd", lambda folder: read_summary(folder / "a.rrd")),
    "checkpoint": ("config.json", locate),
    "demonstrations": (str(dataset.ABOUT), dataset.read),
}


class Waits(BaseException):
    """Nothing that a reader catches."""


@pytest.fixture(autouse=True)
def _two_seconds() -> Iterator[None]:
    """Ends the test when it waits."""

    def waits(*_: object) -> None:
        raise Waits

    former = signal.signal(signal.SIGALRM, waits)
    signal.alarm(2)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, former)


@pytest.mark.parametrize("name", READERS)
def test_a_pipe_is_not_waited_for(tmp_path: Path, name: str) -> None:
    file, read = READERS[name]
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    os.mkfifo(tmp_path / file)
    with pytest.raises(VapError) as caught:
        read(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_lock_that_is_a_pipe_is_none(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "lock.json")
    assert read_lock(tmp_path) == {}


def test_a_device_is_no_file() -> None:
    with pytest.raises(OSError, match="no regular file"):
        read_file(Path("/dev/zero"))
