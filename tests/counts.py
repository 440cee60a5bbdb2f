"""Writes what tests tried into docs/reliability.json: `pytest -p tests.counts ...`.

A test says how many cases it tried, and what came of them, by pytest's own `record_property`:
`cases` is a number, every other name is a count of its own. Without it a test is one case.
Tests that were not run keep the entries that they have.
"""

import json
import os
from collections.abc import Mapping
from datetime import date
from pathlib import Path

import pytest

FILE = Path(__file__).resolve().parents[1] / "docs" / "reliability.json"
_found: dict[str, dict[str, object]] = {}


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    item.user_properties.append(("sweep", item.get_closest_marker("sweep") is not None))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Keep one entry per test: its outcome over set-up, call and tear-down, its cases, its time."""
    seconds = report.duration
    before = _found.get(report.nodeid)
    outcome = report.outcome
    if before is not None:
        seconds += float(str(before["seconds"]))
        if before["outcome"] != "passed":
            outcome = before["outcome"]  # type: ignore[assignment]
    _found[report.nodeid] = {
        "outcome": outcome,
        "seconds": round(seconds, 1),
        "on": date.today().isoformat(),
        "cases": 1,
        **dict(report.user_properties),
    }
    if report.when == "teardown":
        _save()


def _save() -> None:
    """Write after every test: a session that is killed keeps what it has counted."""
    kept = json.loads(FILE.read_text()) if FILE.exists() else {}
    kept.update(_found)
    scratch = FILE.with_suffix(f".{os.getpid()}")
    scratch.write_text(encode(kept))
    os.replace(scratch, FILE)


def encode(counts: Mapping[str, Mapping[str, object]]) -> str:
    """As JSON with a line for every test, sorted."""
    lines = [f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in sorted(counts.items())]
    return "{\n" + ",\n".join(lines) + "\n}\n"
