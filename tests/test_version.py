"""Which code a row, a recording or a training says that it was made by."""

import subprocess
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from vap_core.base import files


def test_a_checkout_is_its_commit_and_whether_it_was_changed(tmp_path: Path) -> None:
    def git(*words: str) -> str:
        command = ["git", "-c", "user.name=a", "-c", "user.email=a@b", *words]
        done = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True)
        return done.stdout.strip()

    git("init", "-q")
    (tmp_path / "module.py").write_text("")
    git("add", ".")
    git("commit", "-qm", "first")
    commit = git("rev-parse", "--short=10", "HEAD")
    assert files.code_version(tmp_path) == commit
    (tmp_path / "module.py").write_text("changed = True\n")
    files.code_version.cache_clear()
    assert files.code_version(tmp_path) == f"{commit}+"


def test_what_is_installed_inside_another_repository_is_not_its_commit(tmp_path: Path) -> None:
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    subprocess.run(
        ["git", "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "a", "--allow-empty"],
        cwd=tmp_path,
        check=True,
    )
    installed = tmp_path / ".venv" / "vap_core"
    installed.mkdir(parents=True)
    (installed / "module.py").write_text("")
    assert files.code_version(installed) == f"vap-core {files.version('vap-core')}"


def test_a_copy_is_the_installed_version_or_unknown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert files.code_version(tmp_path) == f"vap-core {files.version('vap-core')}"

    def not_installed(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(files, "version", not_installed)
    copy = tmp_path / "copy"
    copy.mkdir()
    assert files.code_version(copy) == "unknown"
