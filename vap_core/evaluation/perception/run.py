"""Runs the whole survey in local processes; what a killed run had finished is found again in its folder."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import BadOutput, one_of
from vap_core.base.files import write_atomic
from vap_core.evaluation import store
from vap_core.evaluation.perception import tracking as following
from vap_core.evaluation.perception.episodes import survey
from vap_core.evaluation.perception.first_frames import KS, Tables, openings, remembered
from vap_core.evaluation.processes import results
from vap_core.evaluation.study import Study
from vap_core.perception.stacks import STACKS, load_stack
from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow

if TYPE_CHECKING:
    import pandas as pd

EPISODES = {"simpler-fractal": 30, "simpler-bridge": 16, "vlabench": 8, "tabletop": 5}
"""Opening frames a task, as episodes spread evenly over its list; suites with three cameras need fewer."""
QUICK = 2
"""Episodes a task of a quick survey; it tracks one episode of each suite, and hides its target once."""
HIDDEN = 3
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


@dataclass(frozen=True)
class Survey:
    """What is asked for. `episodes` None takes `EPISODES` opening frames a task, and following.plan's episodes."""

    stack: str = "embedded"
    suites: tuple[str, ...] = tuple(suites.BENCHMARKS)
    episodes: int | None = None
    quick: bool = False

    def __post_init__(self) -> None:
        for name in self.suites:
            if name not in suites.BENCHMARKS:
                raise one_of("Survey: suite", name, suites.BENCHMARKS)
        if self.stack not in STACKS:
            raise one_of("Survey: stack", self.stack, STACKS)

    def opened(self, suite: str) -> int:
        """Opening frames a task."""
        return self.episodes or (QUICK if self.quick else EPISODES[suite])

    def followed(self, suite: str) -> int:
        """Episodes a task that are tracked to their end."""
        usual = 1 if self.quick else following.EPISODES[suite]
        return min(usual, self.episodes or usual)

    def configuration(self) -> dict[str, Any]:
        """What the results depend on, as JSON: the world, weights and lists by their checksums."""
        tasks = tuple(
            (name, task.name) for name in self.suites for task in suites.suite(name).tasks
        )
        world = Study(tasks, ("generic",), policy="expert", stack=self.stack).configuration()
        counts = {
            name: {"openings": self.opened(name), "tracks": self.followed(name)}
            for name in self.suites
        }
        return {"survey": "perception", "stack": self.stack, "episodes": counts, "ks": list(KS), "seed": 0,
                **{name: world[name] for name in ("version", "weights", "lists", "world")}}  # fmt: skip


@dataclass(frozen=True)
class Job:
    """A piece of work for one process; its name is its file's."""

    name: str
    stack: str
    what: tuple[EpisodeRow, ...] | following.Job


def plan(asked: Survey) -> list[Job]:
    """Every job, the long ones first, so that processes finish together."""
    tracks = following.plan({name: asked.followed(name) for name in asked.suites}, asked.suites)
    if asked.quick:
        tracks = [
            replace(next(j for j in tracks if j.row.suite == name), hidden=(HIDDEN,))
            for name in asked.suites
        ]
    jobs = [
        Job(
            f"tracks.{j.row.suite}.{j.row.task}.{j.row.episode}.{j.kind}.{j.every}.{'-'.join(map(str, j.hidden))}",
            asked.stack,
            j,
        )
        for j in tracks
    ]
    for name in asked.suites:
        for task in suites.suite(name).tasks:
            rows = suites.rows(name, task.name, asked.opened(name))
            for first in range(0, len(rows), CHUNK):
                part = rows[first : first + CHUNK]
                jobs.append(
                    Job(
                        f"openings.{name}.{task.name}.{part[0].episode}-{part[-1].episode}",
                        asked.stack,
                        part,
                    )
                )
    return jobs


def work(job: Job) -> Tables:
    """Do one job in this process."""
    stack = _stack(job.stack)
    if isinstance(job.what, following.Job):
        return {"tracks": following.follow(job.what, stack)}
    tables: Tables = {}
    for episode in openings(job.what):
        for name, lines in survey(episode, stack).items():
            tables.setdefault(name, []).extend(lines)
    first = job.what[0]
    tables["references"] = [
        {
            "suite": first.suite,
            "task": first.task,
            "target": first.target,
            "k": k,
            "whole": len(remembered(stack, first.target, k)[1]),
        }
        for k in KS
    ]
    return tables


def run(
    asked: Survey, folder: Path, *, jobs: int = 2, progress: bool = True
) -> "dict[str, pd.DataFrame]":
    """Do what `folder` lacks of the survey, write a parquet table each and return them.

    Speed is measured last and alone, so that nothing of this run disturbs it.
    Raises: BadOutput when the folder holds another run, or is in use; WorkerDied.
    """
    from vap_core.evaluation.perception import speed

    store.open_run(folder, asked.configuration())
    with store.locked(folder):
        planned, parts = plan(asked), folder / "parts"
        parts.mkdir(exist_ok=True)
        left = [job for job in planned if not _part(parts, job.name).exists()]
        _work(left, len(planned), parts, jobs, progress)
        if not _part(parts, "speed").exists():
            _keep(
                parts,
                "speed",
                {"speed": speed.measure(_stack(asked.stack), repeat=5 if asked.quick else 25)},
            )
        return _write(
            folder, [_part(parts, name) for name in (*(job.name for job in planned), "speed")]
        )


def read(folder: Path) -> "dict[str, pd.DataFrame]":
    """The tables of a finished survey. Raises: BadOutput."""
    import pandas as pd

    store.read_manifest(folder)
    missing = [name for name in TABLES if not (folder / f"{name}.parquet").exists()]
    if missing:
        raise BadOutput(
            f"survey: {folder} lacks {', '.join(missing)}; run the same eval-perception again to finish it."
        )
    return {name: pd.read_parquet(folder / f"{name}.parquet") for name in TABLES}


def publish(folder: Path, to: Path) -> list[Path]:
    """Keep the tables of a finished survey in `to` as perception_NAME.parquet, with its configuration in their metadata. Raises: BadOutput."""
    read(folder)
    stack = store.read_manifest(folder)["configuration"]["stack"]
    kept = [
        to / f"perception{'' if stack == 'embedded' else f'_{stack}'}_{name}.parquet"
        for name in TABLES
    ]
    try:
        to.mkdir(parents=True, exist_ok=True)
        for name, path in zip(TABLES, kept, strict=True):
            write_atomic(path, (folder / f"{name}.parquet").read_bytes())
    except OSError as error:
        raise BadOutput(
            f"survey: {to} cannot be written ({error.strerror}); choose another folder with --publish."
        ) from error
    return kept


_stack = cache(load_stack)


def _work(left: Sequence[Job], total: int, parts: Path, jobs: int, progress: bool) -> None:
    from tqdm import tqdm

    with tqdm(
        total=total, initial=total - len(left), unit="job", desc="perception", disable=not progress
    ) as bar:
        for job, tables in results(work, left, jobs, "--jobs"):
            _keep(parts, job.name, tables)
            bar.update()


def _part(parts: Path, name: str) -> Path:
    return parts / f"{name}.json"


def _keep(parts: Path, name: str, tables: Tables) -> None:
    try:
        write_atomic(
            _part(parts, name), json.dumps(tables, default=lambda number: number.item()).encode()
        )
    except OSError as error:
        raise BadOutput(
            f"survey: {parts} cannot be written ({error.strerror}); make room and run the same command again."
        ) from error


def _write(folder: Path, parts: Sequence[Path]) -> "dict[str, pd.DataFrame]":
    """All parts as one table of each kind, with the run's configuration in every file's metadata."""
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq

    lines: Tables = {name: [] for name in TABLES}
    for part in parts:
        try:
            held = json.loads(part.read_bytes())
        except ValueError as error:
            raise BadOutput(
                f"survey: {part} is damaged; delete it and run the same command again."
            ) from error
        for name, of_part in held.items():
            lines[name] += of_part
    note = json.dumps(store.read_manifest(folder), sort_keys=True).encode()
    for name, held in lines.items():
        unique = [
            line for i, line in enumerate(held) if name != "references" or line not in held[:i]
        ]
        table = (
            pa.Table.from_pylist(unique)
            if unique
            else pa.table({"suite": pa.array([], pa.string())})
        )
        sink = pa.BufferOutputStream()
        pq.write_table(table.replace_schema_metadata({b"run": note}), sink, compression="zstd")
        write_atomic(folder / f"{name}.parquet", sink.getvalue().to_pybytes())
    return {name: pd.read_parquet(folder / f"{name}.parquet") for name in TABLES}
