"""Runs a study in local processes: batches of episodes per worker, results appended as they come, only what is missing."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core import store, traces
from vap_core.experiments import Study, make_trial, register_personal
from vap_core.processes import results
from vap_core.values import EpisodeRow, Opening

if TYPE_CHECKING:
    import pandas as pd

    from vap_core.record import Recorder

BATCH = 5
"""Episodes of one job; small enough that a killed run loses little, large enough to share one policy call."""


@dataclass(frozen=True)
class Job:
    """Some rows of one task and variant under one method, for one worker."""

    study: Study
    method: str
    rows: tuple[EpisodeRow, ...]
    folder: Path
    record: bool


def run(study: Study, folder: Path, *, workers: int = 2, record: bool = True, progress: bool = True) -> "pd.DataFrame":
    """Run whatever of `study` is not in `folder` yet, and return the table of all its episodes.

    Killed at any time, the same call goes on where it stopped. Raises BadOutput when the folder holds another run, or is in use.
    """
    store.open_run(folder, study.configuration())
    with store.locked(folder):
        _run(study, folder, workers, record, progress)
    return store.read(folder)


def _run(study: Study, folder: Path, workers: int, record: bool, progress: bool) -> None:
    from tqdm import tqdm

    jobs = list(missing(study, folder, record))
    total = len(study.methods) * sum(len(study.rows(suite, task)) for suite, task in study.tasks)
    register_personal(study, folder / "memory")
    with tqdm(total=total, initial=total - sum(len(job.rows) for job in jobs), unit="episode", disable=not progress) as bar:
        for job, rows in results(work, jobs, workers, "--workers"):
            store.append(folder, rows)
            bar.update(len(rows))
            won = sum(row["success"] for row in rows)
            bar.set_postfix_str(f"{job.rows[0].task} {job.method} {won}/{len(rows)}")


def missing(study: Study, folder: Path, record: bool) -> Iterator[Job]:
    """Jobs for the episodes that the run in `folder` lacks."""
    done = set(store.read(folder)[store.KEY].itertuples(index=False, name=None))
    for method in reversed(study.methods):  # the slower, prompted method first, so that workers finish together
        for suite, task in study.tasks:
            rows = [row for row in study.rows(suite, task) if (suite, task, method, row.episode) not in done]
            for variant in dict.fromkeys(row.variant for row in rows):
                alike = [row for row in rows if row.variant == variant]
                for first in range(0, len(alike), BATCH):
                    yield Job(study, method, tuple(alike[first : first + BATCH]), folder, record)


def work(job: Job) -> list[dict[str, Any]]:
    """Run one job in this process."""
    from vap_core.rollout import rollout

    trial = make_trial(job.study, job.rows, job.method, job.folder / "memory")
    sink = _recorders(job.folder / "recordings") if job.record else None
    episodes = list(rollout(trial, job.rows, sink, batch=BATCH))
    traces.write(job.folder, episodes)
    return [episode.summary() for episode in episodes]


def _recorders(folder: Path) -> Any:
    from vap_core.record import Recorder, recording_name

    folder.mkdir(parents=True, exist_ok=True)

    def begin(opening: Opening) -> "Recorder":
        path = folder / recording_name(opening.row, opening.method)
        path.unlink(missing_ok=True)  # left by a run that was killed after recording and before its result was stored
        return Recorder(path, opening)

    return begin
