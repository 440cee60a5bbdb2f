"""Recordings and corrections without rights are named as such: none is damaged, none is missing.

The tests may run as root, who may read everything: the system's refusal is put in its place.
"""

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.test_why import fail
from vap_core.base.errors import BadRecording
from vap_core.recording import (
    Correction,
    ensure_index,
    load_steps,
    read_corrections,
    read_summary,
    serve_run,
    write_correction,
)
from vap_core.recording.index import find_indexes
from vap_core.recording.layers import read_correction
from vap_core.recording.query import run_query

REFUSED = r"cannot be read \(Permission denied\); check its path and its permissions"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A failure that is corrected."""
    recording = tmp_path / "recordings" / "wrong.rrd"
    fail(recording, "owl_b")
    write_correction(recording, Correction("case 3", "slip"), 3)
    return tmp_path


def refuse(
    monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, refused: Callable[[Path], bool]
) -> None:
    """Make one function of the file system refuse some paths."""
    real = getattr(owner, name)

    def guarded(path: Any = ".", *args: Any, **kwargs: Any) -> Any:
        if not isinstance(path, int) and refused(Path(path)):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return real(path, *args, **kwargs)

    monkeypatch.setattr(owner, name, guarded)


def test_corrections_without_rights_are_not_passed_over(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = run / "corrections"
    refuse(monkeypatch, os, "scandir", lambda path: path == folder)
    with pytest.raises(BadRecording, match=f"{folder} {REFUSED}"):
        read_corrections(run)
    with pytest.raises(BadRecording, match=f"{folder} {REFUSED}"):
        load_steps(run / "recordings")
    with pytest.raises(BadRecording, match=f"{folder} {REFUSED}"), serve_run(run):
        pass


def test_a_correction_without_rights_is_not_to_be_deleted(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layer = run / "corrections" / "wrong.rrd"
    refuse(monkeypatch, Path, "open", lambda path: path == layer)
    with pytest.raises(BadRecording, match=f"{layer} {REFUSED}") as caught:
        read_correction(layer)
    assert "delete" not in str(caught.value)
    assert "damaged" not in str(caught.value)


def test_recordings_without_rights_are_not_missing(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = run / "recordings"
    refuse(monkeypatch, os, "scandir", lambda path: path == folder)
    with pytest.raises(BadRecording, match=f"{folder} {REFUSED}"):
        run_query(run, "frame_index = 0")
    with pytest.raises(BadRecording, match=f"{folder} {REFUSED}"), serve_run(run):
        pass


def test_a_run_without_rights_is_not_without_recordings(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse(monkeypatch, Path, "is_dir", lambda path: path.parent == run)
    with pytest.raises(BadRecording, match=f"{run} {REFUSED}"):
        run_query(run, "frame_index = 0")
    with pytest.raises(BadRecording, match=f"{run} {REFUSED}"), serve_run(run):
        pass


@pytest.mark.parametrize("step", ["is_file", "open"])
def test_a_recording_without_rights_is_not_damaged(
    run: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """Its folder refuses to say what it is, or it refuses to be opened."""
    recording = run / "recordings" / "wrong.rrd"
    refuse(monkeypatch, Path, step, lambda path: path == recording)
    with pytest.raises(BadRecording, match=f"{recording} {REFUSED}") as caught:
        read_summary(recording)
    assert "rrd optimize" not in str(caught.value)


def test_indexes_without_rights_are_none(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a folder that may be listed and not entered."""
    recording = run / "recordings" / "wrong.rrd"
    ensure_index(recording)
    assert list(find_indexes([recording])) == [recording]
    refuse(monkeypatch, Path, "stat", lambda path: run / "recordings" in path.parents)
    assert find_indexes([recording]) == {}
