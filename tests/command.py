"""Commands as `./vap` runs them: in this process, or in one of their own."""

import os
import subprocess
import sys
import warnings
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import pytest

from vap_core.cli import main


@dataclass(frozen=True)
class Done:
    """A command that ended: its status and what it printed."""

    returncode: int
    stdout: str
    stderr: str


def vap(*words: str | Path, env: Mapping[str, str] | None = None) -> Done:
    """Run `./vap WORDS` in this process."""
    out, err = StringIO(), StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        warnings.catch_warnings(),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        warnings.simplefilter("ignore")
        patch.setattr(sys, "argv", ["vap_core", *map(str, words)])
        for name, value in (env or {}).items():
            patch.setenv(name, value)
        try:
            main()
            status: object = 0
        except SystemExit as stop:
            status = stop.code
    if not isinstance(status, int):
        status = int(status is not None)
    return Done(status, out.getvalue(), err.getvalue())


def refused(*words: str | Path) -> str:
    """Run a command that must fail with one line the user can act on, and return that line."""
    done = vap(*words)
    assert done.returncode == 2, done.stdout + done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("error: ")
    assert "Traceback" not in done.stderr
    return last


def process(*words: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run `./vap WORDS` in a process of its own, which logs its readings in `cwd`."""
    return subprocess.run(
        [sys.executable, "-m", "vap_core", *map(str, words)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(Path.cwd())},
        capture_output=True,
        text=True,
        timeout=500,
    )


def here(work, jobs, workers, mend):  # type: ignore[no-untyped-def]
    """The engine's jobs, done in this process."""
    return ((job, work(job)) for job in jobs)
