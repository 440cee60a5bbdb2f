"""Ended anywhere, a command leaves whole files alone, and the same command then ends as if nothing had happened.

Runs of episodes are killed in test_engine, trainings end in test_policy_training.
"""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import nbformat
import pandas as pd
import pytest
from PIL import Image

from tests import random_kills
from tests.deaths import die_before_each_rename
from tests.random_kills import Server, kill_in, serving
from tests.test_report import run
from tests.test_scan_storage import METADATA, cube
from tests.toys import MeanColour, SameColour, detector, scene, segmenter
from vap_core.base import media
from vap_core.memory import remember, save
from vap_core.perception import stacks
from vap_core.perception.protocols import Stack
from vap_core.recording import read_summary
from vap_core.simulation.assets.scans import storage
from vap_core.study.grounding import ground_clip
from vap_core.study.report import report


def named(folder: Path) -> dict[str, bytes]:
    """The files that have their names; hidden ones are scratch."""
    return {
        file.name: file.read_bytes() for file in folder.iterdir() if not file.name.startswith(".")
    }


def test_a_report_that_is_ended_keeps_or_replaces_each_file_of_an_earlier_one(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    one, other = run(tmp_path / "one"), run(tmp_path / "other", episodes=4)
    torn, whole = tmp_path / "torn", tmp_path / "whole"
    report([other], torn)
    before = named(torn)
    report([one], whole)
    after = named(whole)
    assert before != after

    def each_is_of_one_report() -> None:
        for name, content in named(torn).items():
            assert content in (before.get(name), after.get(name)), f"{name} is torn"

    ends = die_before_each_rename(lambda: report([one], torn), each_is_of_one_report)
    assert ends == len(after)
    record_property("cases", ends)
    assert {name: named(torn)[name] for name in after} == after


RED = (250, 0, 0)


def make_clip(folder: Path) -> tuple[Path, Path]:
    """A clip of twelve frames, and a memory that knows the mug in it."""
    bank, clip = folder / "bank", folder / "clip"
    save(bank, remember("mug", "cup", [scene([(26, 26, RED)])], MeanColour()))
    clip.mkdir()
    for i in range(12):
        Image.fromarray(scene([(20 + i, 20, RED)])).save(clip / f"{i:03}.png")
    return clip, bank


def check_films(folder: Path) -> int:
    """Every film and recording that has its name is whole; returns the number of films."""
    films = list(folder.glob("[!.]*.mp4"))
    for film in films:
        assert len(list(media.frames(film))) == 12
    for recording in folder.glob("[!.]*.rrd"):
        read_summary(recording)
    return len(films)


def test_a_clip_that_is_ended_leaves_no_half_film(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    record_property: Callable[[str, object], None],
) -> None:
    stack = Stack("toy", detector, MeanColour(), segmenter, SameColour())
    monkeypatch.setitem(stacks.STACKS, "toy", lambda: stack)
    (clip, bank), torn = make_clip(tmp_path), tmp_path / "torn"
    torn.mkdir()
    ends = die_before_each_rename(
        lambda: ground_clip(clip, "bring my cup", bank, "toy", torn), lambda: check_films(torn)
    )
    record_property("cases", ends)
    assert ends
    assert check_films(torn)


CELLS = (
    """import os
from pathlib import Path
Path("kernel").write_text(str(os.getpid()))
import pandas as pd
from matplotlib.figure import Figure
from vap_core.notebook import kept_figure, kept_table""",
    """for i in range(8):
    kept_table(Path(f"table{i}.parquet"), lambda: pd.DataFrame({"n": range(20_000 + i)}), again=True)
    kept_figure(Path(f"figure{i}.png"), lambda: Figure(figsize=(4, 3)), again=True)""",
    """kept_table(Path("table3.parquet"), lambda: None).n.sum()""",
)
"""What notebooks do with what takes them long: it is kept in files."""


def is_alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def wait_until_it_ends(pid: int, seconds: float) -> bool:
    end = time.monotonic() + seconds
    while is_alive(pid):
        if time.monotonic() > end:
            return False
        time.sleep(0.2)
    return True


@pytest.mark.slow
@pytest.mark.parametrize("kills", [2, pytest.param(12, marks=pytest.mark.sweep)])
@pytest.mark.timeout(1200)
def test_a_notebook_that_is_killed_leaves_whole_files_and_no_kernel(
    tmp_path: Path, kills: int, record_property: Callable[[str, object], None]
) -> None:
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(c) for c in CELLS])
    source = tmp_path / "a.ipynb"
    nbformat.write(notebook, source)
    kernel = tmp_path / "kernel"
    command = [sys.executable, "-m", "nbconvert", "--to", "notebook", "--execute", str(source)]
    command += ["--output", "done.ipynb"]
    environment = {**os.environ, "PYTHONPATH": str(Path.cwd()), "OMP_NUM_THREADS": "1"}

    def execute(after_s: float | None) -> bool:
        kernel.unlink(missing_ok=True)
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        with subprocess.Popen(
            command, cwd=tmp_path, env=environment, start_new_session=True, **quiet
        ) as process:
            try:
                process.wait(after_s)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                if kernel.exists() and kernel.read_text():
                    pid = int(kernel.read_text())
                    assert wait_until_it_ends(pid, 30), "the kernel outlives its notebook"
                return True
        assert process.returncode == 0
        return False

    def results() -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in sorted(tmp_path.glob("[ft][ia]*[0-9].*"))}

    start = time.monotonic()
    assert not execute(None)
    seconds = time.monotonic() - start
    whole = results()
    assert len(whole) == 24
    for path in tmp_path.glob("[ft][ia]*[0-9].*"):
        path.unlink()
    for _ in kill_in(seconds, execute, kills, random.Random(kills)):
        for path in tmp_path.glob("table*.parquet"):
            assert len(pd.read_parquet(path)) >= 20_000
        for path in tmp_path.glob("figure*.png"):
            with Image.open(path) as picture:
                picture.load()
    assert not execute(None)
    assert results() == whole
    record_property("cases", kills)


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving() as started:
        yield started


KILLS = [2, pytest.param(20, marks=[pytest.mark.sweep, pytest.mark.timeout(1800)])]


@pytest.mark.parametrize("kills", KILLS)
@pytest.mark.parametrize("name", random_kills.FILES)
def test_work_that_is_killed_at_random_moments_leaves_whole_files(
    server: Server,
    tmp_path: Path,
    name: str,
    kills: int,
    monkeypatch: pytest.MonkeyPatch,
    record_property: Callable[[str, object], None],
) -> None:
    torn, whole = tmp_path / "torn", tmp_path / "whole"
    monkeypatch.setenv("VAP_OBJECTS", str(torn))
    torn.mkdir()
    paths: tuple[Path, ...] = ()
    if name == "report":
        paths = (run(tmp_path / "one"),)
        report([run(tmp_path / "other", episodes=4)], torn)
    elif name == "ground":
        paths = make_clip(tmp_path)
    before = named(torn) if name == "report" else {}
    server.whole(name, *paths, whole)  # the first one loads what the later ones have
    seconds = server.whole(name, *paths, whole)
    after = named(whole) if name == "report" else {}
    if name == "import":
        storage.save_scan(torn, METADATA, cube())

    def is_whole() -> None:
        for file, content in named(torn).items() if name == "report" else ():
            assert content in (before.get(file), after.get(file)), f"{file} is torn"
        if name == "ground":
            check_films(torn)
        if name == "import":
            (place,) = storage.scan_folders().values()
            storage.load_scan(place)

    for _ in kill_in(
        seconds,
        lambda after_s: server.killed(after_s, name, *paths, torn),
        kills,
        random.Random(kills),
    ):
        is_whole()
    server.whole(name, *paths, torn)
    is_whole()
    if name == "report":
        assert {file: named(torn)[file] for file in after} == after
    if name == "ground":
        assert check_films(torn)
    record_property("cases", kills)
