"""The one engine of measurements: it does the jobs that a folder lacks, and writes the tables.

A measurement is a frozen value that says what its results depend on, which jobs there are, and
what one of them gives. Killed at any time, the same call goes on where it stopped: a job's part is
written whole, and is there or not.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from vap_core.base.errors import WorkerDied
from vap_core.study import store
from vap_core.study.workers import results, results_here

if TYPE_CHECKING:
    import pandas as pd

type Row = dict[str, Any]
type Tables = dict[str, list[Row]]
"""Rows by the name of their table."""
type Executor = Callable[[Callable[[Any], Any], Sequence[Any], int, str], Iterator[tuple[Any, Any]]]
"""How jobs reach processes: `workers.results`, or `workers.ray_executor`'s."""


class Measurement:
    """What is measured; `caller` is the command that messages name."""

    caller: ClassVar[str]

    def settings(self) -> dict[str, Any]:
        """What the results depend on, as JSON."""
        raise NotImplementedError

    def jobs(self) -> Sequence[Any]:
        """Every job, each with a `name` of its own; those that are `alone` come last, alone."""
        raise NotImplementedError

    def prepare(self, folder: Path) -> None:
        """What every job needs there; called once, while no other process works in the folder."""

    def run(self, job: Any, folder: Path) -> Tables:
        """Do one job in this process. Whatever else it writes is in `folder`."""
        raise NotImplementedError


@dataclass(frozen=True)
class Part:
    """One job of a measurement, as a process or another machine gets it."""

    asked: Measurement
    job: Any
    folder: Path

    @property
    def path(self) -> Path:
        return self.folder / "parts" / f"{self.job.name}.json"

    def settings(self) -> dict[str, Any]:
        return self.asked.settings()


def run_part(part: Part) -> Tables:
    """One job's rows. Raises: what the measurement's `run` raises."""
    return part.asked.run(part.job, part.folder)


def measure(
    asked: Measurement,
    folder: Path,
    *,
    workers: int = 1,
    progress: bool = True,
    executor: Executor | None = None,
) -> "dict[str, pd.DataFrame]":
    """Do what `folder` lacks, write a Parquet and a CSV table each, and return the tables.

    Raises: BadOutput when the folder holds another run, is in use or cannot be written; WorkerDied;
        what a job raises.
    """
    from tqdm import tqdm

    parts = [Part(asked, job, folder) for job in asked.jobs()]
    store.open_run(folder, asked.settings())
    with store.locked(folder):
        asked.prepare(folder)

        def missing(alone: bool) -> list[Part]:
            of_kind = (part for part in parts if getattr(part.job, "alone", False) == alone)
            return [part for part in of_kind if not part.path.exists()]

        done = sum(part.path.exists() for part in parts)
        with tqdm(
            total=len(parts),
            initial=done,
            unit="job",
            desc=asked.caller.removeprefix("measure "),
            disable=not progress,
        ) as bar:

            def keep(part: Part, tables: Tables) -> None:
                store.write_json_part(part.path, tables, asked.caller)
                bar.update()

            spread = executor or (results if workers > 1 else results_here)
            work_off(lambda: missing(False), run_part, keep, spread, workers)
            work_off(lambda: missing(True), run_part, keep, results_here, 1)
        tables: Tables = {}
        paths = [part.path for part in parts]
        others = set((folder / "parts").glob("*.json")).difference(paths)  # of an earlier call
        for path in (*paths, *sorted(others)):
            for name, rows in store.read_json_part(path, asked.caller).items():
                tables.setdefault(name, []).extend(rows)
        return store.write_tables(folder, tables, asked.caller)


def work_off(
    missing: Callable[[], Sequence[Any]],
    work: Callable[[Any], Any],
    keep: Callable[[Any, Any], None],
    executor: Executor,
    workers: int,
    *,
    retries: int = 1,
    alone: Callable[[Sequence[Any]], Iterator[tuple[Any, Any]]] | None = None,
    note: Callable[[int], None] = lambda deaths: None,
) -> None:
    """Do the missing jobs until none is left; `keep` gets each with its result.

    Where a worker dies, what is missing then runs again, `retries` times while no job finishes in
    between; after that by `alone`, where it is given.

    Raises: WorkerDied.
    """
    deaths = 0
    while jobs := missing():
        spread = (
            alone(jobs)
            if alone and deaths > retries
            else executor(work, jobs, workers, "--workers")
        )
        try:
            for job, result in spread:
                keep(job, result)
                deaths = 0
        except WorkerDied:
            deaths += 1
            if deaths > retries + (alone is not None):
                raise
            note(deaths)


def read(folder: Path, caller: str, names: Sequence[str]) -> "dict[str, pd.DataFrame]":
    """The tables of a finished measurement. Raises: BadOutput."""
    return store.read_tables({name: folder / f"{name}.parquet" for name in names}, caller)


def report(asked: Measurement, text: str, folder: Path, also: Mapping[str, str] = {}) -> str:
    """Write `report.txt`, and return it with a line on what was written. Raises: BadOutput."""
    from vap_core.base.files import write_atomic, writing

    with writing(folder, asked.caller):
        for name, content in {"report.txt": f"{text}\n", **also}.items():
            write_atomic(folder / name, content.encode())
    return f"{text}\n\nwrote {folder}: report.txt, and the tables as Parquet and CSV"
