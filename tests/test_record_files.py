"""Recordings as files: how large they are, and how they survive."""

import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.command import refused, vap
from tests.drawn import SUCCESS, frame, opening, record, rerun
from vap_core.base.errors import BadOutput, BadRecording
from vap_core.recording import Recorder, read_summary, recover, stream
from vap_core.recording.entities.pictures import encode_jpeg
from vap_core.recording.stream import LEFTOVER, temporary_path
from vap_core.rollout.types import EpisodeHeader, Frame
from vap_core.study.diagnosis import explain


def test_a_killed_episode_keeps_all_flushed_steps(tmp_path: Path) -> None:
    path = tmp_path / "killed.rrd"
    program = (
        f"import sys, os, signal, pathlib; sys.path.insert(0, {str(Path(__file__).parents[1])!r})\n"
        "from tests import drawn as t\n"
        "start = t.opening(1)\n"
        f"recorder = t.Recorder(pathlib.Path({str(path)!r}), start, flush_every=5)\n"
        "for step in range(13): recorder.frame(t.frame(step, start))\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], check=False)
    assert done.returncode == -signal.SIGKILL
    (leftover,) = tmp_path.iterdir()
    assert re.fullmatch(r"\.killed\.rrd\.\d+\.tmp", leftover.name)
    with pytest.raises(BadRecording, match="rerun rrd optimize"):
        read_summary(leftover)
    assert recover(leftover) == path
    summary = read_summary(path)
    assert (summary["frames"], summary["task"], "outcome" in summary) == (
        10,
        "pick-owl",
        False,
    )
    assert rerun("rrd", "verify", path).returncode == 0
    assert [p.name for p in tmp_path.iterdir()] == ["killed.rrd"]


def test_an_exception_keeps_every_step_under_the_temporary_name(tmp_path: Path) -> None:
    def crash() -> None:
        with Recorder(tmp_path / "one.rrd", opening(1)) as recorder:
            recorder.frame(frame(0, opening(1)))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        crash()
    leftover = temporary_path(tmp_path / "one.rrd")
    assert list(tmp_path.iterdir()) == [leftover]
    assert read_summary(recover(leftover))["frames"] == 1


def test_view_names_the_mend_of_a_leftover_and_makes_a_recording_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Path] = []
    monkeypatch.setattr("vap_core.recording.open_viewer", lambda path, **_: shown.append(path))
    with Recorder(tmp_path / "one.rrd", opening(1)) as recorder:
        recorder.frame(frame(0, opening(1)))
    whole = next(tmp_path.iterdir()).read_bytes()
    (tmp_path / "of a").mkdir()
    leftover = tmp_path / "of a" / ".two.rrd.7.tmp"
    leftover.write_bytes(whole[: len(whole) - 300])
    for words in (("view", leftover), ("view", leftover, "--png", tmp_path / "a.png")):
        message = refused(*words)
        assert "is a recording that was not finished" in message
        assert f"./vap view {shlex.quote(str(leftover))} --recover" in message
    done = vap("view", leftover, "--recover")
    path = leftover.with_name("two.rrd")
    assert (done.returncode, done.stdout) == (0, f"wrote {path}\n"), done.stderr
    assert shown == [path]
    assert read_summary(path)["frames"] == 1
    assert not leftover.exists()
    assert "is no leftover of a recording" in refused("view", path, "--recover")
    (tmp_path / "noise.rrd").write_bytes(b"noise")
    assert "--recover" not in refused("view", tmp_path / "noise.rrd")


def test_a_process_that_records_much_keeps_neither_threads_nor_memory(tmp_path: Path) -> None:
    def held() -> tuple[int, float]:
        told = Path("/proc/self/status").read_text()
        threads, kilobytes = (
            int(re.search(rf"^{name}:\s*(\d+)", told, re.MULTILINE)[1])
            for name in ("Threads", "VmRSS")
        )
        return threads, kilobytes / 1024

    start = opening(3)
    frames = [frame(step, start) for step in range(6)]
    after = []
    for n in range(24):
        with Recorder(tmp_path / f"{n}.rrd", start, explain=explain) as recorder:
            for one in frames:
                recorder.frame(one)
            recorder.close(replace(SUCCESS, status="failure", success=False) if n % 2 else SUCCESS)
        del recorder
        after.append(held())
    assert after[-1][0] <= after[3][0] + 1, "threads"
    assert after[-1][1] < after[11][1] + 12, "megabytes"


def test_sixty_steps_of_three_cameras_stay_small_and_quick(tmp_path: Path) -> None:
    """The CPU of recording against that of encoding the same pictures once, in the same run: what `bench step` measures against a whole rollout."""
    start = opening(3)
    frames = [frame(step, start) for step in range(60)]
    record(tmp_path / "warm.rrd", start, steps=2)

    def encodes(n: int) -> None:
        for one in frames:
            for picture in (*one.images.values(), *one.prompted.values()):
                encode_jpeg(picture, 85)

    def records(n: int) -> None:
        recorder = Recorder(tmp_path / f"{n}.rrd", start, explain=explain)
        for one in frames:
            recorder.frame(one)
        recorder.close(SUCCESS)

    def cpu_s(work: Callable[[int], None], n: int) -> float:
        began = time.process_time()
        work(n)
        return time.process_time() - began

    ratios = [cpu_s(records, n) / cpu_s(encodes, n) for n in range(3)]
    assert (tmp_path / "0.rrd").stat().st_size < 4.2e6
    assert np.median(ratios) < 10, ratios


def test_nothing_is_ever_overwritten(
    tmp_path: Path, three: tuple[Path, EpisodeHeader, list[Frame]]
) -> None:
    (tmp_path / "one.rrd").write_bytes(b"precious")
    with pytest.raises(BadOutput, match="never overwritten; choose another"):
        Recorder(tmp_path / "one.rrd", three[1])
    with Recorder(tmp_path / "two.rrd", three[1]) as recorder:
        (tmp_path / "two.rrd").write_bytes(b"precious")
        with pytest.raises(BadOutput, match="kept as"):
            recorder.close(SUCCESS)
    with pytest.raises(BadOutput, match="left as it is"):
        recover(temporary_path(tmp_path / "two.rrd"))
    assert {p.read_bytes() for p in tmp_path.glob("*.rrd")} == {b"precious"}


def test_two_that_record_one_episode_leave_one_whole(tmp_path: Path) -> None:
    path, start = tmp_path / "one.rrd", opening(1)
    program = (
        f"import sys, pathlib; sys.path.insert(0, {str(Path(__file__).parents[1])!r})\n"
        "from tests import drawn as t\n"
        "start = t.opening(1)\n"
        f"with t.Recorder(pathlib.Path({str(path)!r}), start) as other:\n"
        "    other.frame(t.frame(0, start))\n"
    )
    recorder = Recorder(path, start)
    for step in range(3):
        recorder.frame(frame(step, start))
    subprocess.run([sys.executable, "-c", program], check=True)
    (other,) = {*tmp_path.iterdir()} - {temporary_path(path)}
    assert LEFTOVER.fullmatch(other.name)["name"] == "one.rrd"
    recorder.close(SUCCESS)
    assert read_summary(path)["frames"] == 3
    assert other.exists(), "it is young: its process may be alive"


def test_on_a_full_disk_nothing_is_left_of_a_recording_and_the_next_one_is_whole(
    tmp_path: Path,
) -> None:
    names = ("early", "late", "whole")
    early, late, whole = (tmp_path / f"{name}.rrd" for name in names)
    program = (
        f"import sys, pathlib, resource, signal; sys.path.insert(0, {str(Path(__file__).parents[1])!r})\n"
        "from tests import drawn as t\n"
        "from vap_core.base.errors import BadOutput\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]\n"
        "kept = []\n"
        "def record(path, limit):\n"
        "    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))\n"
        "    start = t.opening(1)\n"
        "    try:\n"
        "        kept.append(recorder := t.Recorder(path, start, flush_every=500))\n"
        "        for step in range(30): recorder.frame(t.frame(step, start))\n"
        "        recorder.close(t.SUCCESS)\n"
        "    except BadOutput as error: print(error, sorted(p.name for p in path.parent.iterdir()))\n"
        f"for name, limit in zip({names!r}, (30_000, 200_000, hard)):\n"
        f"    record(pathlib.Path({str(tmp_path)!r}, name + '.rrd'), limit)\n"
    )
    try:
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=90
        )
    except subprocess.TimeoutExpired:
        pytest.xfail("about once in 60 times rerun 0.41 waits forever for a write that failed")
    assert done.stdout == "".join(
        f"record: {path} cannot be written; make room and run the same command again. []\n"
        for path in (early, late)
    )
    assert read_summary(whole)["frames"] == 30
    assert list(tmp_path.iterdir()) == [whole]


def test_a_disk_with_little_room_ends_a_recording_before_rerun_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(tmp_path)
    full = usage._replace(free=stream.ROOM_BYTES - 1)
    path, start = tmp_path / "full.rrd", opening(1)
    said = f"record: {path} cannot be written; make room and run the same command again."
    recorder = Recorder(path, start, flush_every=3)
    recorder.frame(frame(0, start))
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: full)
    with pytest.raises(BadOutput, match=re.escape(said)):
        recorder.close(SUCCESS)
    assert not list(tmp_path.iterdir())
    with pytest.raises(BadOutput, match=re.escape(said)):
        Recorder(path, start)
    monkeypatch.undo()
    with Recorder(path, start) as again:
        again.frame(frame(0, start))
        again.close(SUCCESS)
    assert read_summary(path)["frames"] == 1


def test_a_folder_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(BadOutput, match="choose a folder you may write to"):
        Recorder(tmp_path / "file" / "one.rrd", opening(1))


def test_a_damaged_recording_says_how_to_mend_it(
    tmp_path: Path, three: tuple[Path, EpisodeHeader, list[Frame]]
) -> None:
    whole = three[0].read_bytes()
    for name, data in (
        ("noise", b"noise" * 99),
        ("half", whole[: len(whole) // 2]),
        ("empty", b""),
    ):
        (tmp_path / f"{name}.rrd").write_bytes(data)
        with pytest.raises(BadRecording, match="rerun rrd optimize") as caught:
            read_summary(tmp_path / f"{name}.rrd")
        assert "\n" not in str(caught.value)
    with pytest.raises(BadRecording, match="there is no recording"):
        read_summary(tmp_path / "missing.rrd")
    (tmp_path / ".noise2.rrd.tmp").write_bytes(b"noise" * 99)
    with pytest.raises(BadRecording):
        recover(tmp_path / ".noise2.rrd.tmp")
