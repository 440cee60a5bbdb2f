"""The log of readings: a run enters once, to publish copies its lines, and a run of one's own
leaves the repository as it is."""

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from vap_core.base.errors import BadOutput
from vap_core.base.files import DATA, SHIPPED
from vap_core.evaluation import readings
from vap_core.evaluation.engine import _open_run
from vap_core.evaluation.policy_names import shipped
from vap_core.evaluation.publish import read_published
from vap_core.evaluation.readings import Reading, all_readings, append, publish_readings, read_log
from vap_core.evaluation.report.sections import readings_section
from vap_core.evaluation.store import read_manifest
from vap_core.evaluation.study import Study
from vap_core.policies.lerobot.checkpoints import fingerprint
from vap_core.simulation import suites

TASKS = (("simpler-bridge", "pick-shaver"), ("simpler-bridge", "put-camera"))
PUBLISHED = [
    path.stem
    for path in sorted((DATA / "results").glob("*.parquet"))
    if "configuration" in pq.read_schema(path).names
]
"""Every table that `publish` wrote, by its schema."""


@pytest.fixture(autouse=True)
def logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """This machine's log and the published one, neither begun."""
    local, published = tmp_path / "runs" / "readings.csv", tmp_path / "results" / "readings.csv"
    monkeypatch.setattr(readings, "LOCAL", local)
    monkeypatch.setattr(readings, "PUBLISHED", published)
    return local, published


def test_a_run_enters_once_with_what_it_reads(tmp_path: Path, logs: tuple[Path, Path]) -> None:
    study = Study(TASKS, ("generic", "vap"), episodes=6, seeds=2, policy="mini-pi0")
    for _ in range(2):
        _open_run(study, tmp_path / "run", "a look")
    (line,) = read_log(logs[0])
    assert (line.rows, line.listed, line.seeds, line.whole) == (12, 96, 2, False)
    assert (line.methods, line.policy, line.what_for) == ("generic vap", "mini-pi0", "a look")
    assert suites.lists.digest("simpler-bridge").startswith(line.list)
    assert len(line.weights) == len(line.list) == readings.SHORT
    _open_run(Study((("widowx-pick", "pick-cup"),), ("generic",)), tmp_path / "warm-up", "")
    assert len(read_log(logs[0])) == 1, "a warm-up suite has no list"


def test_a_run_whose_reading_could_not_be_logged_is_logged_by_its_next_start(
    tmp_path: Path, logs: tuple[Path, Path]
) -> None:
    logs[0].parent.mkdir()
    logs[0].write_text("date,suite\n2026-11-26,x\n")
    study = Study(TASKS, ("generic",), episodes=6)
    with pytest.raises(BadOutput, match="restore it, or delete it to begin anew"):
        _open_run(study, tmp_path / "run", "a look")
    _open_run(Study((("widowx-pick", "pick-cup"),), ("generic",)), tmp_path / "no list", "")
    logs[0].unlink()
    _open_run(study, tmp_path / "run", "a look")
    assert [line.what_for for line in read_log(logs[0])] == ["a look"]


def test_to_publish_copies_the_lines_of_a_run_once(tmp_path: Path, logs: tuple[Path, Path]) -> None:
    local, published = logs
    for name, seed in (("kept", 0), ("private", 1)):
        _open_run(Study(TASKS, ("generic",), seed=seed), tmp_path / name, name)
    assert not published.exists(), "a run changes nothing in the repository"
    manifest = read_manifest(tmp_path / "kept")
    for _ in range(2):
        publish_readings([manifest], published)
    assert [line.what_for for line in read_log(published)] == ["kept"]
    assert sorted(line.what_for for line in all_readings()) == ["kept", "private"]
    local.unlink()
    publish_readings([read_manifest(tmp_path / "private")], published)
    assert [line.what_for for line in read_log(published)] == ["kept", readings.UNLOGGED]


def test_readings_are_counted_by_weights() -> None:
    lines = []
    for weights, rows, day in (
        ("aa", 96, "01"),
        ("aa", 4, "03"),
        ("bb", 96, "02"),
        ("bb", 0, "01"),
    ):
        lines.append(
            Reading(
                date=f"2026-01-{day}",
                suite="simpler-bridge",
                list="e160",
                weights=weights,
                policy="mini-pi0",
                methods="vap",
                rows=rows,
                listed=96 if rows else 0,
                seeds=1,
                run=f"{weights}{day}",
                what_for="x, y",
            )
        )
    append(lines, readings.PUBLISHED)
    assert read_log(readings.PUBLISHED) == lines
    header, first, second = readings.readings_rows(lines)
    assert first[header.index("readings") :] == ["2", "1", "2026-01-03", "x, y"]
    assert second[header.index("weights") :] == ["bb", "2", "1", "2026-01-02", "x, y"]
    assert "| bb " in readings_section(lines)
    assert readings_section([]) == ""


def test_runs_that_begin_at_once_lose_no_line(
    logs: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = readings.readings_of(Study(TASKS, ("generic",)).configuration(), "a")
    read = readings.read_log

    def slowly(path: Path) -> list[Reading]:
        lines = read(path)
        time.sleep(0.2)
        return lines

    monkeypatch.setattr(readings, "read_log", slowly)
    with ThreadPoolExecutor(4) as pool:
        for begun in [pool.submit(append, wanted, logs[0]) for _ in range(4)]:
            begun.result()
    assert len(read(logs[0])) == 4 * len(wanted)


def test_a_damaged_log_is_named(logs: tuple[Path, Path]) -> None:
    logs[0].parent.mkdir()
    logs[0].write_text("date,suite\n2026-01-01,vlabench\n")
    with pytest.raises(BadOutput, match="is damaged"):
        all_readings()


@pytest.mark.parametrize("name", PUBLISHED)
def test_every_published_run_is_in_the_log_that_ships(name: str) -> None:
    logged = {}
    for line in read_log(DATA / "results" / readings.FILE):
        logged[line.run, line.suite] = line
    for manifest, _ in read_published(DATA / "results" / f"{name}.parquet"):
        for wanted in readings.readings_of(manifest["configuration"], manifest["digest"]):
            line = logged[wanted.run, wanted.suite]
            for field in ("list", "weights", "policy", "rows", "listed", "seeds"):
                assert getattr(line, field) == getattr(wanted, field)
            methods = {*wanted.methods.split(), *manifest.get("left_out", [])}
            for note in manifest.get("superseded", []):
                methods |= set(note["methods"])
            assert set(line.methods.split()) == methods


def test_the_tables_of_runs_are_found_by_their_schema() -> None:
    assert {"mini_pi0", "token_closed_loop", "tint_share", "bounds"} <= set(PUBLISHED)
    assert "parsers" not in PUBLISHED


def test_the_docs_count_the_published_readings() -> None:
    text = " ".join((DATA.parent / "docs" / "benchmarks.md").read_text().split())
    counts = {}
    for suite in suites.BENCHMARKS:
        today = fingerprint(shipped(suite))
        weights = [
            line.weights
            for line in read_log(DATA / "results" / readings.FILE)
            if line.suite == suite
            and line.policy in ("mini-pi0", f"mini-pi0-{suite}")
            and line.rows
            and not (line.weights and today.startswith(line.weights))
        ]
        counts[suite] = len(weights), len(set(weights))
    bridge, desk = counts["simpler-bridge"], counts["tabletop"]
    fractal, vlabench = counts["simpler-fractal"], counts["vlabench"]
    assert (
        f"stand {bridge[0]} readings of simpler-bridge with {bridge[1]} weights, {desk[0]} of "
        f"tabletop with {desk[1]}, {fractal[0]} of simpler-fractal with {fractal[1]}, and "
        f"{vlabench[0]} of vlabench with {vlabench[1]}." in text
    )
    expected = {
        "simpler-bridge": (12, 110, 52),
        "simpler-bridge-red": (1, 3, 3),
        "simpler-fractal": (13, 60, 51),
        "vlabench": (6, 17, 15),
        "tabletop": (2, 10, 8),
    }
    of_default: dict[str, list[list[str]]] = {suite: [] for suite in expected}
    for line in read_log(DATA / "results" / readings.FILE):
        if line.suite not in of_default or not line.weights:
            continue
        if fingerprint(shipped(line.suite)).startswith(line.weights):
            of_default[line.suite].append(line.methods.split())
    counted = {}
    for suite, runs in of_default.items():
        read = [method for run in runs for method in run]
        counted[suite] = len(runs), len(read), len(set(read))
    assert counted == expected
    assert (
        "simpler-bridge read its list in 12 runs (110 readings of 52 methods and arms), and in one with "
        "a red look-alike (3 of 3). That of vlabench did in 6 runs (17 of 15), that of simpler-fractal in "
        "13 runs (60 of 51;"
    ) in text
    readme = " ".join((DATA.parent / "README.md").read_text().split())
    runs, _, methods = zip(*(counted[suite] for suite in suites.BENCHMARKS), strict=True)
    assert (
        f"run on its list {min(runs)} to {max(runs)} times, with {min(methods)} to {max(methods)} methods"
    ) in readme
    wide = fingerprint(SHIPPED / "mini-pi0-simpler-bridge-wide")
    of_wide = [
        line.suite
        for line in read_log(DATA / "results" / readings.FILE)
        if line.weights and wide.startswith(line.weights)
    ]
    assert (of_wide.count("simpler-bridge"), of_wide.count("simpler-bridge-red")) == (9, 1)
    page = " ".join((DATA.parent / "docs" / "policy.md").read_text().split())
    assert "by arms of ablations: in nine runs in all, and in one with a red look-alike" in page
