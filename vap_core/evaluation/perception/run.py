"""Runs the whole survey in local processes.

What a killed run had finished is found again in its folder.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import BadOutput, one_of
from vap_core.base.extras import require
from vap_core.base.files import write_atomic, writing
from vap_core.base.parquet import read_parquet
from vap_core.evaluation import measurements, store
from vap_core.evaluation.perception import tracking
from vap_core.evaluation.perception.episodes import survey
from vap_core.evaluation.perception.first_frames import (
    KS,
    TableRow,
    Tables,
    opening_views,
    registered_object,
)
from vap_core.evaluation.processes import results
from vap_core.evaluation.study import Study
from vap_core.perception.stacks import check_stack, checksums, load_stack
from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

EPISODES = {"simpler-fractal": 30, "simpler-bridge": 16, "vlabench": 8, "tabletop": 5}
"""Opening frames a task, as episodes spread evenly over its list.

Suites with three cameras need fewer.
"""
QUICK = 2
"""Episodes a task of a quick survey.

It tracks one episode of each suite, and hides its target once.
"""
CHUNK = 6
"""Episodes of one job: little is lost when a run is killed."""
TABLES = (
    "views",
    "objects",
    "detections",
    "choices",
    "agreements",
    "references",
    "tracks",
    "speed",
)
WORLD = ("version", "lists", "world")
"""What a survey's configuration takes from a study's."""


@dataclass(frozen=True)
class Survey:
    """What is asked for.

    `episodes` None takes `EPISODES` opening frames a task, and tracking.plan's episodes.

    Raises: UnknownName for a suite that is no benchmark, or a stack that does not exist.
    """

    stack: str = "embedded"
    suites: tuple[str, ...] = tuple(suites.BENCHMARKS)
    episodes: int | None = None
    quick: bool = False

    def __post_init__(self) -> None:
        for name in self.suites:
            if name not in suites.BENCHMARKS:
                raise one_of("Survey: suite", name, suites.BENCHMARKS)
        check_stack(self.stack, "Survey")

    def n_openings(self, suite: str) -> int:
        """Opening frames a task."""
        if self.episodes:
            return self.episodes
        return QUICK if self.quick else EPISODES[suite]

    def n_tracked(self, suite: str) -> int:
        """Episodes a task that are tracked to their end."""
        usual = 1 if self.quick else tracking.EPISODES[suite]
        return min(usual, self.episodes or usual)

    def configuration(self) -> dict[str, Any]:
        """What the results depend on, as JSON: the world, weights and lists by their checksums.

        Raises: BadSuite, as `Study.configuration`; MissingWeights: the stack's models are not here.
        """
        counts = {}
        for name in self.suites:
            counts[name] = {"openings": self.n_openings(name), "tracks": self.n_tracked(name)}
        study = Study(
            tasks=suites.tasks_of(self.suites),
            methods=("generic",),
            policy="expert",
            stack=self.stack,
        )
        of_study = study.configuration()
        configuration: dict[str, Any] = {
            "survey": "perception",
            "stack": self.stack,
            "episodes": counts,
            "ks": list(KS),
            "seed": 0,
        }
        for key in WORLD:
            configuration[key] = of_study[key]
        return configuration | checksums(self.stack)


@dataclass(frozen=True)
class Job:
    """A piece of work for one process; its name is its file's.

    `what` are the episodes whose opening frames are surveyed, or an episode to track.
    """

    name: str
    stack: str
    what: tuple[EpisodeRow, ...] | tracking.Job


def plan(asked: Survey) -> list[Job]:
    """Every job, the long ones first, so that processes finish together.

    Raises: BadSuite for a damaged list.
    """
    return [*_tracking_jobs(asked), *_opening_jobs(asked)]


def run_job(job: Job) -> Tables:
    """Do one job in this process, and return its part of the tables.

    Raises: as `tracking.track_episode`, `opening_views` and `survey`.
    """
    stack = _load_stack(job.stack)
    if isinstance(job.what, tracking.Job):
        return {"tracks": tracking.track_episode(job.what, stack)}
    tables: Tables = {}
    for episode in opening_views(job.what):
        for name, rows in survey(episode, stack).items():
            tables.setdefault(name, []).extend(rows)
    first = job.what[0]
    tables["references"] = []
    for k in KS:
        _, whole_photos = registered_object(stack, first.target, k)
        reference: TableRow = {
            "suite": first.suite,
            "task": first.task,
            "target": first.target,
            "k": k,
            "whole": len(whole_photos),
        }
        tables["references"].append(reference)
    return tables


def run_survey(
    asked: Survey, folder: Path, *, jobs: int = 2, progress: bool = True
) -> "dict[str, pd.DataFrame]":
    """Do what `folder` lacks of the survey, write a parquet table each and return them.

    Speed is measured last and alone, so that nothing of this run disturbs it.

    Raises: BadOutput when the folder holds another run, or is in use; WorkerDied; MissingPart.
    """
    require("foundation", "the unit of speed, a pass of the backbone by torch,")
    store.open_run(folder, asked.configuration())
    with store.locked(folder):
        planned = plan(asked)
        parts = folder / "parts"
        with writing(folder, "survey"):
            parts.mkdir(exist_ok=True)
        missing = []
        paths = []
        for job in planned:
            path = _part_path(parts, job.name)
            paths.append(path)
            if not path.exists():
                missing.append(job)
        _run_missing(missing, parts=parts, total=len(planned), jobs=jobs, progress=progress)
        speed_path = _part_path(parts, "speed")
        paths.append(speed_path)
        if not speed_path.exists():
            speed = {"speed": _measure_speed(asked)}
            measurements.write_json_part(speed_path, speed, caller="survey", default=_to_number)
        return _write_tables(folder, paths)


def read(folder: Path) -> "dict[str, pd.DataFrame]":
    """The tables of a finished survey. Raises: BadOutput."""
    store.read_manifest(folder)
    missing = [name for name in TABLES if not _table_path(folder, name).exists()]
    if missing:
        raise BadOutput(
            f"survey: {folder} lacks {', '.join(missing)}; run the same measure perception again "
            "to finish it."
        )
    return _read_tables(folder)


def publish(folder: Path, to: Path) -> list[Path]:
    """Keep the tables of a finished survey in `to` as perception_NAME.parquet.

    Their configuration is in their metadata. Raises: BadOutput.
    """
    read(folder)
    stack = store.read_manifest(folder)["configuration"]["stack"]
    prefix = "perception"
    if stack != "embedded":
        prefix = f"perception_{stack}"
    tables = {}
    for name in TABLES:
        tables[f"{prefix}_{name}.parquet"] = _table_path(folder, name).read_bytes()
    return measurements.publish_tables(tables, to, caller="survey")


_load_stack = cache(load_stack)


def _tracking_jobs(asked: Survey) -> list[Job]:
    """A job per episode to track."""
    counts = {}
    for suite in asked.suites:
        counts[suite] = asked.n_tracked(suite)
    tracked = tracking.plan(counts, asked.suites)
    if asked.quick:
        tracked = _first_of_each_suite(tracked, asked.suites)
    jobs = []
    for what in tracked:
        row = what.row
        hidden = "-".join(map(str, what.hidden))
        name = f"tracks.{row.suite}.{row.task}.{row.episode}.{what.kind}.{what.every}.{hidden}"
        jobs.append(Job(name, asked.stack, what))
    return jobs


def _first_of_each_suite(
    tracked: Sequence[tracking.Job], names: Sequence[str]
) -> list[tracking.Job]:
    """The first episode of each suite, with its target hidden once."""
    first: dict[str, tracking.Job] = {}
    for job in tracked:
        first.setdefault(job.row.suite, job)
    return [replace(first[name], hidden=(tracking.HIDDEN,)) for name in names]


def _opening_jobs(asked: Survey) -> list[Job]:
    """A job per CHUNK opening frames of one task."""
    jobs = []
    for suite in asked.suites:
        for task in suites.suite(suite).tasks:
            rows = suites.rows(suite, task.name, asked.n_openings(suite))
            for first in range(0, len(rows), CHUNK):
                part = rows[first : first + CHUNK]
                episodes = f"{part[0].episode}-{part[-1].episode}"
                jobs.append(Job(f"openings.{suite}.{task.name}.{episodes}", asked.stack, part))
    return jobs


def _run_missing(
    missing: Sequence[Job], *, parts: Path, total: int, jobs: int, progress: bool
) -> None:
    """Do the jobs in `jobs` processes, and write each one's part when it is finished."""
    from tqdm import tqdm

    with tqdm(
        total=total,
        initial=total - len(missing),
        unit="job",
        desc="perception",
        disable=not progress,
    ) as bar:
        for job, tables in results(run_job, missing, workers=jobs, remedy="--jobs"):
            path = _part_path(parts, job.name)
            measurements.write_json_part(path, tables, caller="survey", default=_to_number)
            bar.update()


def _measure_speed(asked: Survey) -> list[TableRow]:
    from vap_core.evaluation.perception import speed

    return speed.measure(_load_stack(asked.stack), repeat=5 if asked.quick else 25)


def _part_path(parts: Path, name: str) -> Path:
    return parts / f"{name}.json"


def _table_path(folder: Path, name: str) -> Path:
    return folder / f"{name}.parquet"


def _to_number(scalar: Any) -> Any:
    """A NumPy scalar as a Python number."""
    return scalar.item()


def _write_tables(folder: Path, parts: Sequence[Path]) -> "dict[str, pd.DataFrame]":
    """All parts as one table of each kind, with the run's configuration in every file's metadata.

    Raises: BadOutput for a damaged part, or when the disk is full.
    """
    tables: Tables = {name: [] for name in TABLES}
    for path in parts:
        for name, rows in measurements.read_json_part(path, caller="survey").items():
            tables[name] += rows
    tables["references"] = _unique_rows(tables["references"])
    manifest = json.dumps(store.read_manifest(folder), sort_keys=True)
    for name, rows in tables.items():
        table = _arrow_table(rows).replace_schema_metadata({b"run": manifest.encode()})
        data = measurements.encode_table(table)
        with writing(folder, "survey"):
            write_atomic(_table_path(folder, name), data)
    return _read_tables(folder)


def _unique_rows(rows: Sequence[TableRow]) -> list[TableRow]:
    unique: list[TableRow] = []
    for row in rows:
        if row not in unique:
            unique.append(row)
    return unique


def _arrow_table(rows: list[TableRow]) -> "pa.Table":
    """The rows as a table; one without rows has a column of suites nevertheless."""
    import pyarrow as pa

    if rows:
        return pa.Table.from_pylist(rows)
    return pa.table({"suite": pa.array([], pa.string())})


def _read_tables(folder: Path) -> "dict[str, pd.DataFrame]":
    tables = {}
    for name in TABLES:
        path = _table_path(folder, name)
        tables[name] = read_parquet(
            path, "measure perception", "delete it and run the same command again"
        )
    return tables
