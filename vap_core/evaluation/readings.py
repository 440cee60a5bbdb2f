"""The log of how often every shipped episode list was read, and with which weights.

    2026-11-24,simpler-bridge,e160becf5906,00c47015fce7,mini-pi0,generic vap,96,96,1,RUN,main table

A list that was read while something was tuned is no test of it any more; development lists are read
for that, and not logged. A run is entered once, when it begins, with what it will read:
`data/runs/readings.csv`, which stays on its machine. To publish a run copies its lines to
`readings.csv` beside the published table.
"""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from vap_core.base.errors import BadOutput
from vap_core.base.files import DATA, folder_locked, read_file, write_atomic, writing
from vap_core.simulation import suites

FILE = "readings.csv"
LOCAL = Path("data/runs") / FILE
"""The log of this machine's runs."""
PUBLISHED = DATA / "results" / FILE
"""The log that ships: every reading behind a published table, and what is known of earlier ones."""
SHORT = 12
"""Digits of a digest in the log."""
UNLOGGED = "published; begun unlogged"
"""What for: a run that began before there was a log, or elsewhere."""


@dataclass(frozen=True)
class Reading:
    """One reading of one list: `rows` of `listed` rows, under every method and `seeds` seeds.

    `list` and `weights` begin SHA-256 digests, "" where a policy has no weights; `run` is the
    digest of the run's configuration. `methods` are separated by spaces.
    """

    date: str
    suite: str
    list: str
    weights: str
    policy: str
    methods: str
    rows: int
    listed: int
    seeds: int
    run: str
    what_for: str

    @property
    def whole(self) -> bool:
        return 0 < self.rows == self.listed


COLUMNS = tuple(field.name for field in fields(Reading))


def readings_of(configuration: Mapping[str, Any], run: str, what_for: str = "") -> list[Reading]:
    """What a run reads: one line for each of its suites that has a shipped list to report.

    Raises: UnknownName for a task that its suite does not have; BadSuite for a damaged list.
    """
    found = []
    weights = weights_by_suite(configuration)
    split = configuration.get("split", "")
    tasks_by_suite: dict[str, list[str]] = {}
    for suite, task in configuration["tasks"]:
        tasks_by_suite.setdefault(suite, []).append(task)
    for suite, tasks in tasks_by_suite.items():
        if not suites.is_listed(suite) or suites.is_development(suite):
            continue
        n_rows = 0
        for task in tasks:
            n_rows += len(suites.rows(suite, task, configuration["episodes"], split=split))
        found.append(
            Reading(
                date=datetime.now(UTC).date().isoformat(),
                suite=suite,
                list=str(configuration.get("lists", {}).get(suite, ""))[:SHORT],
                weights=weights.get(suite, ""),
                policy=Path(str(configuration.get("policy", ""))).name,
                methods=" ".join(configuration["methods"]),
                rows=n_rows,
                listed=len(suites.benchmark(suite)),
                seeds=configuration.get("seeds") or 1,
                run=run,
                what_for=what_for,
            )
        )
    return found


def read_log(path: Path) -> list[Reading]:
    """The lines of a log, none where it does not exist. Raises: BadOutput."""
    try:
        text = read_file(path).decode()
        lines = list(csv.DictReader(io.StringIO(text), strict=True))
        return [_parse(line) for line in lines]
    except FileNotFoundError:
        return []
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise BadOutput(
            f"readings: {path} is damaged ({type(error).__name__}); restore it, or delete it to "
            "begin anew."
        ) from error


def append(readings: Sequence[Reading], path: Path) -> None:
    """Add lines to a log, which is begun where it does not exist.

    Runs that begin at the same time wait for each other. Raises: BadOutput.
    """
    if not readings:
        return
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(COLUMNS)
    with writing(
        path, "readings", "make room, or run the command in a folder where data/runs can be written"
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        with folder_locked(path.parent):
            for reading in (*read_log(path), *readings):
                writer.writerow(astuple(reading))
            write_atomic(path, table.getvalue().encode())


def publish_readings(manifests: Iterable[Mapping[str, Any]], target: Path) -> None:
    """Copy the readings of some runs to the log `target`, which keeps what it has.

    A run that was not logged is entered as read today.

    Raises: BadOutput.
    """
    local = read_log(LOCAL)
    known = {reading.run for reading in read_log(target)}
    added: list[Reading] = []
    for manifest in manifests:
        run = manifest["digest"]
        if run in known:
            continue
        known.add(run)
        logged = [reading for reading in local if reading.run == run]
        added += logged or readings_of(manifest["configuration"], run, UNLOGGED)
    append(added, target)


def readings_rows(readings: Sequence[Reading]) -> list[list[str]]:
    """How often every list was read, by its weights: text cells, header first."""
    by_list: dict[tuple[str, str], list[Reading]] = {}
    for reading in readings:
        by_list.setdefault((reading.suite, reading.list), []).append(reading)
    table = [["list", "digest", "policy", "weights", "readings", "whole", "last", "for"]]
    for (suite, digest), of_list in sorted(by_list.items()):
        by_weights: dict[tuple[str, str], list[Reading]] = {}
        for reading in of_list:
            by_weights.setdefault((reading.policy, reading.weights), []).append(reading)
        for (policy, weights), part in by_weights.items():
            whole = sum(reading.whole for reading in part)
            last = max(reading.date for reading in part)
            purposes = "; ".join(dict.fromkeys(r.what_for for r in part if r.what_for))
            cells = [suite, digest, policy, weights or "-", str(len(part)), str(whole), last]
            table.append([*cells, purposes or "-"])
    return table


def all_readings() -> list[Reading]:
    """The published log and this machine's, every run once. Raises: BadOutput, as `read_log`."""
    published = read_log(PUBLISHED)
    known = {reading.run for reading in published if reading.run}
    return [*published, *(r for r in read_log(LOCAL) if r.run not in known)]


def readings_of_lists(digests: Iterable[str]) -> list[Reading]:
    """All readings of the lists with these digests. Raises: BadOutput, as `read_log`."""
    wanted = {digest[:SHORT] for digest in digests}
    return [reading for reading in all_readings() if reading.list in wanted]


def weights_by_suite(configuration: Mapping[str, Any]) -> dict[str, str]:
    """The beginning of the weights' digest of every suite of a run's configuration."""
    names = {suite for suite, _ in configuration["tasks"]}
    if "checkpoint" in configuration:
        return dict.fromkeys(names, str(configuration["checkpoint"])[:SHORT])
    digests = configuration.get("checkpoints", [])
    benchmarks = sorted(set(map(suites.benchmark_name, names)))
    if len(digests) != len(benchmarks):
        return {}
    by_benchmark = dict(zip(benchmarks, digests, strict=True))
    return {name: str(by_benchmark[suites.benchmark_name(name)])[:SHORT] for name in names}


def _parse(line: Mapping[str, str]) -> Reading:
    cells: dict[str, Any] = {name: line[name] for name in COLUMNS}
    for name in ("rows", "listed", "seeds"):
        cells[name] = int(cells[name])
    return Reading(**cells)
