"""Writes docs/reliability.md from what the tests counted: `python -m tests.reliability_page`.

    --run       run the tests that the page names first
    --sweeps    with --run: also their long forms, which take an hour

A test that was not run again keeps the counts of its last run in docs/reliability.json.
"""

import argparse
import ast
import json
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.counts import FILE, encode
from tests.reliability_rows import ATTACKS, LEFT, TRIED

PAGE = FILE.with_suffix(".md")
ROOT = PAGE.parents[1]
COLUMNS = ("outcome", "seconds", "on", "cases", "sweep")
"""What every entry has; the rest are counts that a test makes of its own."""
HEAD = """# Reliability

What was tried against the package, how often, what happened, and what is left. The promise: files
from outside are parsed, never executed, and bounded in size and time; what fails gives one line
with a remedy; nothing that is finished is lost.

Made by `make reliability` from `docs/reliability.json`, which tests write when they run as
`pytest -p tests.counts`; `tests/reliability_page.py` also runs all that are named here. The short
forms run in `make test`, the sweeps in `make test-all`. A case is one input, one kill or one
parameter of a test.
"""
Entry = Mapping[str, Any]
Counts = Mapping[str, Entry]


def named() -> list[str]:
    """Every test that the page names, once, as pytest takes it."""
    tests: dict[str, None] = {}
    for row in (*TRIED, *ATTACKS):
        tests.update(dict.fromkeys(row.tests))
    return [path_of(test) for test in tests]


def path_of(test: str) -> str:
    file, function = test.split("::")
    return f"tests/{file}.py::{function}"


def functions_in(file: Path) -> set[str]:
    """The tests of a file."""
    if not file.exists():
        return set()
    found = set()
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            found.add(node.name)
    return found


def of_today(counts: Counts) -> dict[str, Entry]:
    """Without the counts of tests that are gone, sorted."""
    kept: dict[str, Entry] = {}
    tests: dict[str, set[str]] = {}
    for name, entry in sorted(counts.items()):
        file, _, test = name.partition("::")
        if file not in tests:
            tests[file] = functions_in(ROOT / file)
        if test.split("[")[0] in tests[file]:
            kept[name] = entry
    return kept


def entries_of(tests: Iterable[str], counts: Counts) -> list[Entry]:
    """The entries of all parameters of some tests."""
    paths = {path_of(test) for test in tests}
    return [entry for name, entry in counts.items() if name.split("[")[0] in paths]


def how_often(entries: list[Entry]) -> str:
    """The cases of the short forms and of the sweeps."""
    parts = []
    for kind, swept in (("", False), (" in the sweep", True)):
        cases = sum(entry["cases"] for entry in entries if entry["sweep"] is swept)
        if cases:
            parts.append(f"{cases:,}{kind}")
    return ", ".join(parts) or "not run"


def counted(entries: list[Entry]) -> str:
    """What the tests counted besides their cases; of a measure, the largest."""
    found: dict[str, float] = {}
    for entry in entries:
        for name, number in entry.items():
            if name in COLUMNS:
                continue
            if name.startswith("largest"):
                found[name] = max(found.get(name, 0), number)
            else:
                found[name] = found.get(name, 0) + number
    parts = []
    for name, number in found.items():
        shown = f"{number:.1e}" if name.startswith("largest") else f"{number:,}"
        parts.append(f"{name.replace('_', ' ')}: {shown}")
    return "; ".join(parts)


def last_run(tests: Sequence[str], counts: Counts) -> str:
    """When, and with which result; and how many of the tests have not been counted."""
    entries = entries_of(tests, counts)
    if not entries:
        return "not run"
    absent = [test for test in tests if not entries_of([test], counts)]
    failed = [entry for entry in entries if entry["outcome"] == "failed"]
    skipped = [entry for entry in entries if entry["outcome"] == "skipped"]
    notes = f"{len(failed)} of {len(entries)} FAILED" if failed else "passed"
    if skipped:
        notes += f", {len(skipped)} skipped"
    if absent:
        notes += f", {len(absent)} of {len(tests)} tests not run"
    return f"{notes}, {max(entry['on'] for entry in entries)}"


def names_of(tests: Iterable[str]) -> str:
    return ", ".join(f"`{path_of(test).removeprefix('tests/')}`" for test in tests)


def table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def page(counts: Counts) -> str:
    """The whole page."""
    tried = []
    for row in TRIED:
        entries = entries_of(row.tests, counts)
        more = counted(entries)
        happens = f"{row.happens} ({more})" if more else row.happens
        tried.append(
            (
                row.tried,
                how_often(entries),
                happens,
                last_run(row.tests, counts),
                names_of(row.tests),
            )
        )
    attacks = []
    for attack in ATTACKS:
        entries = entries_of(attack.tests, counts)
        state = f"mended: {attack.now}" if attack.tests else f"left: {attack.now}"
        attacks.append(
            (
                attack.number,
                attack.severity,
                attack.happened,
                state,
                how_often(entries),
                last_run(attack.tests, counts),
                names_of(attack.tests),
            )
        )
    return "\n".join(
        (
            HEAD,
            "## Tried\n",
            table(("what was tried", "how often", "what happens", "last run", "test"), tried),
            "## The first attack\n",
            "27 failures were found by hand and by fuzzing before any of this was mended. Each is"
            " mended; the tests hold what is promised now.\n",
            table(
                ("row", "severity", "what happened", "now", "how often", "last run", "test"),
                attacks,
            ),
            "## Left\n",
            table(("what", "why"), LEFT),
            "## Sweeps\n",
            "Every long test, also of what this page does not name. Seconds are of a machine that"
            " was busy with other work.\n",
            table(("file", "tests", "passed", "seconds", "last run"), sweeps(counts)),
        )
    )


def sweeps(counts: Counts) -> list[tuple[str, ...]]:
    """A row for every file that has long tests."""
    files: dict[str, list[Entry]] = {}
    for name, entry in counts.items():
        if entry["sweep"]:
            files.setdefault(name.split("::")[0].removeprefix("tests/"), []).append(entry)
    rows = []
    for file, entries in sorted(files.items()):
        passed = sum(entry["outcome"] == "passed" for entry in entries)
        seconds = sum(entry["seconds"] for entry in entries)
        day = max(entry["on"] for entry in entries)
        rows.append((f"`{file}`", str(len(entries)), str(passed), f"{seconds:.0f}", day))
    return rows


def run(swept: bool) -> int:
    """Run every test that the page names; returns pytest's status."""
    which = [] if swept else ["-m", "not sweep"]
    command = [sys.executable, "-m", "pytest", "-p", "tests.counts", *which, *named()]
    return subprocess.run(command, check=False).returncode


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--run", action="store_true", help="run the tests that the page names")
    parser.add_argument("--sweeps", action="store_true", help="with --run: also their long forms")
    asked = parser.parse_args()
    status = run(asked.sweeps) if asked.run else 0
    counts = of_today(json.loads(FILE.read_text()))
    FILE.write_text(encode(counts))
    PAGE.write_text(page(counts))
    print(f"wrote {PAGE}")
    return status


if __name__ == "__main__":
    sys.exit(main())
