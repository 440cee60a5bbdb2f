"""Runs a study: batches of episodes per process, results appended as they come.

Only what is missing runs. Killed at any time, by Ctrl-C, a full disk or a lost machine, the same
call goes on where it stopped. An episode that ends in an error is tried again, and recorded then;
both attempts are kept. The jobs of a worker that died run again. Where workers die again and again
and no job finishes in between, episodes run one by one, and one whose worker dies then is an error.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import WorkerDied
from vap_core.evaluation import store
from vap_core.evaluation.jobs import BATCH, Job, Record, Rows, row_of_dead_worker, run_job
from vap_core.evaluation.processes import prepare, results
from vap_core.evaluation.study import Study
from vap_core.evaluation.trials import register_personal
from vap_core.evaluation.unknown_words import unknown_words_notes
from vap_core.evaluation.worker_server import worker_modules
from vap_core.simulation.types import AS_LISTED, EpisodeRow

if TYPE_CHECKING:
    import pandas as pd
    from tqdm import tqdm

Executor = Callable[[Callable[[Job], Rows], Sequence[Job], int, str], Iterator[tuple[Job, Rows]]]
"""How jobs reach processes: `processes.results`, or `cluster.ray_executor`'s."""
LONE_DEATHS = 3
"""So many episodes in a row that end their worker mean that the machine is at fault, not they."""
KeyedRow = tuple[EpisodeRow, str]
"""A row of an episode list, and the key of its result."""


def run(
    study: Study,
    folder: Path,
    *,
    workers: int = 2,
    record: Record = "all",
    retries: int = 1,
    progress: bool = True,
    executor: Executor = results,
    video: bool = False,
    attention: tuple[str, ...] = (),
    policy_timeout_s: float | None = None,
) -> "pd.DataFrame":
    """Run the episodes of `study` that `folder` lacks, and return the table of all its episodes.

    Raises: BadOutput when the folder holds another run, is in use or cannot be written; BadPolicy
        when the weights change while it runs; WorkerDied when LONE_DEATHS workers died in a row,
        each with one episode.
    """
    from tqdm import tqdm

    resumed = (folder / store.MANIFEST).exists()

    def missing() -> list[Job]:
        # A run that was interrupted may be again: its first jobs end soon, and are kept.
        short = max(workers, 1) if resumed else 0
        jobs = missing_jobs(study, folder, record, retries, short)
        complete = []
        for job in jobs:
            complete.append(
                replace(job, video=video, attention=attention, policy_timeout_s=policy_timeout_s)
            )
        return complete

    store.open_run(folder, study.configuration())
    for line in unknown_words_notes(study):
        print(line, file=sys.stderr)
    with store.locked(folder):
        store.sweep(folder)
        store.compact(folder)
        if executor is results and missing():
            prepare(worker_modules(study.policy))
        register_personal(study, folder / "memory")
        table = store.read(folder)
        with tqdm(
            total=len(study.methods) * _count_rows(study),
            initial=len(table),
            unit="episode",
            disable=not progress,
            smoothing=0.05,
        ) as bar:
            counts = _count_by_method(table)
            counted = set(map(store.key_of, table.to_dict("records")))
            deaths = 0
            jobs = missing()
            while jobs:
                if deaths > retries:
                    finished = run_alone(jobs, executor, retries, bool(len(store.read(folder))))
                else:
                    finished = executor(run_job, jobs, workers, "--workers")
                try:
                    for job, rows in finished:
                        store.append(folder, rows)
                        deaths = 0
                        _show_progress(bar, counts, counted, job.method, rows)
                except WorkerDied:
                    deaths += 1
                    if deaths > retries + 1:
                        raise
                    how = "again" if deaths <= retries else "one episode at a time"
                    bar.write(
                        f"note: a worker process died; what it was doing runs {how} "
                        f"({deaths} of {retries + 1} deaths).",
                        file=sys.stderr,
                    )
                jobs = missing()
        store.compact(folder)
    table = store.read(folder)
    note = _errors_note(table)
    if note:
        print(note, file=sys.stderr)
    return table


def _errors_note(table: "pd.DataFrame") -> str:
    """How episodes that ended in an error, tried as often as was asked for, are tried again."""
    errors = table[table["outcome"] == "error"]
    if errors.empty:
        return ""
    episodes = "1 episode is an error" if len(errors) == 1 else f"{len(errors)} episodes are errors"
    return (
        f"note: {episodes}; when the cause is mended, the same command with --retries "
        f"{int(errors['attempt'].max())} tries again."
    )


def run_alone(
    jobs: Sequence[Job], executor: Executor, retries: int, others_finished: bool
) -> Iterator[tuple[Job, Rows]]:
    """Each episode in a worker of its own, until one that ends its worker is found.

    Such an episode is an error, and is not tried again, where another one finishes: after it, or
    before (`others_finished`).

    Raises: WorkerDied.
    """
    dead: list[tuple[Job, Rows]] = []
    for job in chain.from_iterable(map(_split, jobs)):
        try:
            found = list(executor(run_job, [job], 1, "--workers"))
        except WorkerDied as error:
            last = replace(job, attempt=max(job.attempt, retries + 1))
            dead.append((last, [row_of_dead_worker(last, str(error))]))
            if len(dead) == LONE_DEATHS:
                raise
            continue
        yield from found
        if dead:
            yield from dead
            return
    if dead and not others_finished:
        raise WorkerDied(dead[-1][1][0]["detail"])
    yield from dead


def _split(job: Job) -> list[Job]:
    """A job of each of its episodes."""
    singles = []
    for row, key in zip(job.rows, job.keys, strict=True):
        singles.append(replace(job, rows=(row,), keys=(key,)))
    return singles


def missing_jobs(
    study: Study, folder: Path, record: Record = "none", retries: int = 0, short: int = 0
) -> Iterator[Job]:
    """Jobs for the episodes that the run in `folder` lacks.

    Also for episodes in error that were tried at most `retries` times; these are recorded. The
    slower, prompted method comes first, so that workers finish together. The first `short` jobs
    have one episode each.

    Raises: BadOutput when the run's manifest is absent, or a part is damaged.
    """
    run_digest = store.read_manifest(folder)["digest"]
    attempts = _attempts(store.read(folder))
    given = 0
    for method in reversed(study.methods):
        for suite, task in study.tasks:
            rows = [(row, result_key(row, method, run_digest)) for row in study.rows(suite, task)]
            chosen = _chosen_keys(rows, record)
            for (_, attempt), group in _missing_groups(rows, attempts, retries).items():
                record_now: Record = record if attempt == 1 else "all"
                first = 0
                while first < len(group):
                    size = 1 if given < short else BATCH
                    batch, keys = zip(*group[first : first + size], strict=True)
                    first += size
                    given += 1
                    yield Job(
                        study=study,
                        method=method,
                        rows=batch,
                        keys=keys,
                        attempt=attempt,
                        folder=folder,
                        record=record_now,
                        chosen=chosen,
                    )


def result_key(row: EpisodeRow, method: str, run_digest: str) -> str:
    """Names a result: a hash of the episode's row, the method and the digest of the run."""
    about = asdict(row)
    if about["start"] == asdict(AS_LISTED):  # keys are those of versions without starts
        del about["start"]
    for name in ("speaker", "owned", "subgoals", "inside"):  # and without shared scenes
        if not about[name]:
            del about[name]
    return store.digest({"row": about, "method": method, "run": run_digest})


def spread_evenly[T](items: Sequence[T], n: int) -> list[T]:
    """`n` of them, or all if there are fewer, at equal distances."""
    if n >= len(items):
        return list(items)
    return [items[i * len(items) // n] for i in range(n)]


def _attempts(table: "pd.DataFrame") -> dict[str, tuple[int, str]]:
    """The last attempt of every finished episode and its outcome, by key."""
    attempts = {}
    if not table.empty:
        for row in table.itertuples():
            attempts[row.key] = row.attempt, row.outcome
    return attempts


def _chosen_keys(rows: Sequence[KeyedRow], record: Record) -> frozenset[str]:
    """The keys to record when `record` is a number."""
    if not isinstance(record, int):
        return frozenset()
    return frozenset(key for _, key in spread_evenly(rows, record))


def _missing_groups(
    rows: Sequence[KeyedRow], attempts: dict[str, tuple[int, str]], retries: int
) -> dict[tuple[str, int], list[KeyedRow]]:
    """The missing rows, by their variant and the number of their next attempt."""
    groups: dict[tuple[str, int], list[KeyedRow]] = {}
    for row, key in rows:
        tried, outcome = attempts.get(key, (0, "error"))
        if outcome == "error" and (tried == 0 or tried <= retries):
            groups.setdefault((row.variant, tried + 1), []).append((row, key))
    return groups


def _count_rows(study: Study) -> int:
    total = 0
    for suite, task in study.tasks:
        total += len(study.rows(suite, task))
    return total


def _count_by_method(table: "pd.DataFrame") -> dict[str, Counter[str]]:
    """Successes and episodes of every method."""
    counts = {}
    for method, part in table.groupby("method"):
        counts[str(method)] = Counter(success=int(part.success.sum()), n=len(part))
    return counts


def _show_progress(
    bar: "tqdm",
    counts: dict[str, Counter[str]],
    counted: set[tuple[Any, ...]],
    method: str,
    rows: Rows,
) -> None:
    """Advance the bar by a finished job's rows, and print the success rates so far.

    `counted` are the keys of the episodes that `counts` has: a second attempt is none more.
    """
    count = counts.setdefault(method, Counter())
    for row in rows:
        count["success"] += row["success"]
    fresh = set(map(store.key_of, rows)) - counted
    counted |= fresh
    count["n"] += len(fresh)
    bar.update(len(fresh))
    rates = []
    for method, count in sorted(counts.items()):
        if count["n"]:
            rates.append(f"{method} {100 * count['success'] / count['n']:.0f} % of {count['n']}")
    bar.set_postfix_str(", ".join(rates))
