"""Runs a study: batches of episodes per process, results appended as they come, only what is missing.

Killed at any time, by Ctrl-C, a full disk or a lost machine, the same call goes on where it stopped. An episode that ends in an error is tried again,
and recorded then; both tries are kept. What a worker was doing when it died runs again, unless nothing else ends in between.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from typing import TYPE_CHECKING, Any, Literal

from vap_core import audit, failures, store, traces
from vap_core.errors import BadOutput, BadRecording, BadStudy, WorkerDied
from vap_core.experiments import Study, make_trial, register_personal
from vap_core.frozen import frozen
from vap_core.oracle import Revealed
from vap_core.policies import Insider
from vap_core.processes import results
from vap_core.values import EpisodeRow, Opening

if TYPE_CHECKING:
    import pandas as pd

    from vap_core.record import Recorder, Waiting

BATCH = 5
"""Episodes of one job; small enough that a killed run loses little, large enough to share one policy call."""
Record = Literal["all", "failures", "none"] | int
"""Which episodes are recorded: every one; every failure, and one success in ten to compare with; none; or so many per task and method, spread
evenly."""
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Job:
    """Some rows of one task and variant under one method, for one worker; `attempt` 1 is the first. `chosen` are the keys to record when `record` is
    a number; `video` records AV1 instead of JPEGs, and `attention` where the policy looks."""

    study: Study
    method: str
    rows: tuple[EpisodeRow, ...]
    keys: tuple[str, ...]
    attempt: int
    folder: Path
    record: Record
    chosen: frozenset[str] = frozenset()
    video: bool = False
    attention: bool = False


Spread = Callable[[Callable[[Job], Rows], Sequence[Job], int, str], Iterator[tuple[Job, Rows]]]
"""How jobs reach processes: processes.results, or a cluster's."""


def run(
    study: Study,
    folder: Path,
    *,
    workers: int = 2,
    record: Record = "all",
    retries: int = 1,
    progress: bool = True,
    spread: Spread = results,
    video: bool = False,
    attention: bool = False,
) -> "pd.DataFrame":
    """Run whatever of `study` is not in `folder` yet, and return the table of all its episodes.

    Raises: BadOutput when the folder holds another run, is in use or cannot be written; WorkerDied when workers died more often
    than `retries` in a row.
    """
    store.open_run(folder, study.configuration())
    with store.locked(folder):
        store.compact(folder)
        _run(study, folder, workers, record, retries, progress, spread, {"video": video, "attention": attention})
        store.compact(folder)
    return store.read(folder)


def _run(study: Study, folder: Path, workers: int, record: Record, retries: int, progress: bool, spread: Spread, recorded: Mapping[str, Any]) -> None:
    from tqdm import tqdm

    register_personal(study, folder / "memory")
    total, deaths = len(study.methods) * sum(len(study.rows(suite, task)) for suite, task in study.tasks), 0
    table = store.read(folder)
    ended = {str(method): Counter(success=int(part.success.sum()), n=len(part)) for method, part in table.groupby("method")}
    with tqdm(total=total, initial=len(table), unit="episode", disable=not progress, smoothing=0.05) as bar:
        while jobs := [replace(job, **recorded) for job in missing(study, folder, record, retries)]:
            try:
                for job, rows in spread(work, jobs, workers, "--workers"):
                    store.append(folder, rows)
                    deaths = 0
                    if job.attempt == 1:
                        bar.update(len(rows))
                    ended.setdefault(job.method, Counter()).update(success=sum(row["success"] for row in rows), n=len(rows) * (job.attempt == 1))
                    bar.set_postfix_str(_running(ended))
            except WorkerDied:
                deaths += 1
                if deaths > retries:
                    raise
                bar.write(f"note: a worker process died; what it was doing runs again ({deaths} of {retries} retries).", file=sys.stderr)


def _running(ended: dict[str, Counter[str]]) -> str:
    """Success rates so far."""
    return ", ".join(f"{method} {100 * count['success'] / count['n']:.0f} % of {count['n']}" for method, count in sorted(ended.items()) if count["n"])


def missing(study: Study, folder: Path, record: Record = "none", retries: int = 0) -> Iterator[Job]:
    """Jobs for the episodes that the run in `folder` lacks, and for those in error that were tried at most `retries` times; these are recorded."""
    table = store.read(folder)
    held = {} if table.empty else {row.key: (row.attempt, row.outcome) for row in table.itertuples()}
    run = store.note(folder)["digest"]
    for method in reversed(study.methods):  # the slower, prompted method first, so that workers finish together
        for suite, task in study.tasks:
            groups: dict[tuple[str, int], list[tuple[EpisodeRow, str]]] = {}
            listed = [(row, key(row, method, run)) for row in study.rows(suite, task)]
            chosen = frozenset(name for _, name in spread_evenly(listed, record)) if isinstance(record, int) else frozenset()
            for row, name in listed:
                tried, outcome = held.get(name, (0, "error"))
                if outcome == "error" and (tried == 0 or tried <= retries):
                    groups.setdefault((row.variant, tried + 1), []).append((row, name))
            for (_, attempt), group in groups.items():
                for first in range(0, len(group), BATCH):
                    rows, keys = zip(*group[first : first + BATCH], strict=True)
                    yield Job(study, method, rows, keys, attempt, folder, record if attempt == 1 or record == "all" else "failures", chosen)


def spread_evenly[T](items: Sequence[T], n: int) -> list[T]:
    """`n` of them, or all if there are fewer, at equal distances."""
    return [items[i * len(items) // n] for i in range(n)] if n < len(items) else list(items)


def key(row: EpisodeRow, method: str, run: str) -> str:
    """What a result belongs to: the episode's row, the method, and the digest of the run (weights, world and code that matter)."""
    return store.digest({"row": asdict(row), "method": method, "run": run})


def work(job: Job) -> Rows:
    """Run one job in this process; `peak_mb` is the most memory that it has taken so far, `policy_sha256` begins the checksum of the policy's
    parameters, and `bound` marks what is no result: a method or policy that reads the simulator. Raises: BadPolicy when the parameters changed."""
    from vap_core.rollout import rollout

    trial = make_trial(job.study, job.rows, job.method, job.folder / "memory")
    sink = None if job.record == "none" or (isinstance(job.record, int) and not job.chosen & set(job.keys)) else _recorders(job)
    if job.attention and not getattr(trial.policy, "attends", False):
        raise BadStudy(f"engine: {trial.policy.label} does not tell where it looks, as pi0, pi0.5 and mini-pi0 do; leave --attention out.")
    trial = replace(trial, attention=job.attention and sink is not None)
    with frozen(trial.policy) as checksum:
        episodes = list(rollout(trial, job.rows, sink, batch=BATCH))
    if sink is not None:
        _index(job)
    traces.write(job.folder, episodes)
    audit.write(job.folder, episodes)
    bound = isinstance(trial.attender, Revealed) or isinstance(trial.policy, Insider)
    about: dict[str, Any] = {"attempt": job.attempt, "policy_sha256": checksum, "bound": bound}
    about["peak_mb"] = getrusage(RUSAGE_SELF).ru_maxrss // 1024
    return [{"key": name, **about, **episode.summary(), **failures.columns(episode)} for name, episode in zip(job.keys, episodes, strict=True)]


def _index(job: Job) -> None:
    """So that a query need not read recordings whole; an episode that ended before its first step has nothing to ask for."""
    from vap_core.record import index, recording_name

    for path in (job.folder / "recordings" / recording_name(row, job.method) for row in job.rows):
        if path.exists():
            with suppress(BadRecording):
                index(path)


def _recorders(job: Job) -> Callable[[Opening], "Recorder | Waiting"]:
    from vap_core.record import Recorder, Waiting, recording_name, wanted

    folder, keys = job.folder / "recordings", dict(zip(((row.key, row.seed) for row in job.rows), job.keys, strict=True))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadOutput(f"engine: {folder} cannot be written ({error.strerror}); make room and run the same command again.") from error

    def begin(opening: Opening) -> "Recorder | Waiting":
        row = opening.row
        path = folder / recording_name(row, job.method)
        path.unlink(missing_ok=True)  # left by a run that was killed after recording and before its result was stored
        if job.record == "all":
            return Recorder(path, opening, video=job.video)
        if job.record == "failures":
            return Waiting(path, opening, lambda outcome: wanted(outcome, row, job.method), video=job.video)
        return Waiting(path, opening, lambda outcome: keys[row.key, row.seed] in job.chosen, video=job.video)

    return begin
