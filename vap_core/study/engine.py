"""Runs a study: batches of episodes per process, results appended as they come.

Only what is missing runs. Killed at any time, by Ctrl-C, a full disk or a lost machine, the same
call goes on where it stopped. An episode that ends in an error is tried again, and recorded then;
both attempts are kept. The jobs of a worker that died run again. Where workers die again and again
and no job finishes in between, episodes run one by one, and one whose worker dies then is an error.
"""

import sys
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from typing import TYPE_CHECKING, Any, Literal

from vap_core.base.errors import BadPolicy, BadStudy, WorkerDied, number_of
from vap_core.base.files import write_atomic, writing
from vap_core.policies.lerobot.checkpoints import config_field, fingerprint, locate, stamp
from vap_core.policies.names import MINI, POLICIES, is_served, shipped_checkpoint
from vap_core.policies.protocol import unchanged_weights
from vap_core.policies.tables import vocabulary_of, words_of
from vap_core.rollout.types import Episode, EpisodeHeader
from vap_core.simulation import suites
from vap_core.simulation.types import AS_LISTED, EpisodeRow, Outcome
from vap_core.study import diagnosis, logs, steps, store
from vap_core.study.measurement import Executor, work_off
from vap_core.study.store import MANIFEST, read_manifest
from vap_core.study.trials import Study, make_trial, register_personal
from vap_core.study.workers import prepare, results

if TYPE_CHECKING:
    import pandas as pd
    from tqdm import tqdm

    from vap_core.recording import DeferredRecorder, Recorder

SHORT = 12
"""Digits of a digest in messages."""


def require_same_weights(study: Study, suite: str, folder: Path) -> None:
    """Compare a suite's checkpoint, as it is now, with the manifest of the run in `folder`.

    A folder without one is passed over: on a cluster the machine has compared before.

    Raises: BadPolicy when the checkpoint was replaced, or a file of it is missing.
    """
    checkpoint = study.checkpoint(suite)
    if not checkpoint or not (folder / MANIFEST).exists():
        return
    begun_with = weights_by_suite(read_manifest(folder)["configuration"]).get(suite)
    now = _fingerprint(checkpoint, stamp(checkpoint))[:SHORT]
    if begun_with and now != begun_with:
        raise BadPolicy(
            f"engine: the weights in {checkpoint} changed while the run in {folder} went on "
            f"({begun_with} at first, {now} now). What was finished is kept. Let the training that "
            "writes them end, and choose another folder with --out."
        )


@cache
def _fingerprint(checkpoint: str, _: tuple[object, ...]) -> str:
    """The fingerprint of a checkpoint with this stamp; it takes seconds where it is large."""
    return fingerprint(checkpoint)


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


KIND = "mini_pi0"
"""The type of policy whose words are few."""


def unknown_words(known: Container[str], instructions: Iterable[str]) -> list[str]:
    """The words of some instructions, in lower case, that are none of `known`; each once."""
    words: dict[str, None] = {}
    for instruction in dict.fromkeys(instructions):
        words |= dict.fromkeys(words_of(instruction))
    return [word for word in words if word not in known]


def policy_notes(study: Study) -> list[str]:
    """A line for each suite whose instructions have such words; of a served policy, what is sent
    and received. Raises: BadPolicy."""
    if is_served(study.policy):
        from vap_core.policies.served import parse_address

        return [f"{study.policy}: {'; '.join(parse_address(study.policy).map.lines())}"]
    lines = []
    for suite in dict.fromkeys(suite for suite, _ in study.tasks):
        checkpoint = study.checkpoint(suite)
        if not checkpoint or config_field(checkpoint, "type") != KIND:
            continue
        folder = locate(checkpoint)
        known, _ = vocabulary_of(folder) or ((), None)
        tasks = [task for task in study.tasks if task[0] == suite]
        said = [row.instruction for task in tasks for row in study.rows(*task)]
        words = unknown_words(known, said)
        if words:
            lines.append(
                f"note: {folder.name} does not know {', '.join(words)}, which instructions of "
                f"{suite} say; where that reaches it, it reads <unk>. It was trained on the words "
                "of the benchmarks."
            )
    return lines


def worker_modules(policy: str) -> tuple[str, ...]:
    """What a worker of a study with this policy imports first."""
    modules = [
        "vap_core.study.engine",
        "vap_core.rollout.loop",
        "vap_core.recording.recorder",
        "onnxruntime",
        "scipy.special",
    ]
    if is_served(policy):
        modules += ["vap_core.policies.served", "websockets.sync.client"]
    elif policy not in POLICIES:
        modules += ["vap_core.policies.lerobot.adapter", "lerobot.policies"]
        if Path(policy).name.startswith(MINI):
            modules.append("vap_core.policies.mini_pi0.processor_mini_pi0")
    return tuple(modules)


def start_server(policy: str, folder: Path) -> None:
    """Have the server import what workers need, while this process finds out what they do.

    Where a run has begun in `folder` perhaps nothing is left to do: then `engine.run` starts it.
    """
    if not (folder / MANIFEST).exists():
        prepare(worker_modules(policy))


def probable_policy(suite_names: Sequence[str]) -> str:
    """The default policy of suites, as far as their names alone say it; else ""."""
    named = set(suite_names) - {"all"}
    return MINI if all(shipped_checkpoint(name).is_dir() for name in named) else ""


BATCH = 5
"""Episodes of one job: a killed run loses few, and they share one policy call."""
Record = Literal["all", "failures", "none"] | int
"""Which episodes are recorded.

Every one; every failure and one success in ten to compare with; none; or so many per task and
method, at equal distances.
"""
Rows = list[dict[str, Any]]
"""Rows of a results table."""


@dataclass(frozen=True)
class Job:
    """Some rows of one task and variant under one method, for one worker.

    `keys` name the results (engine.result_key); `attempt` 1 is the first. `chosen` are the keys to
    record when `record` is a number. `video` records AV1 instead of JPEGs, `attention` where these
    queries look (rollout.queries). `policy_timeout_s` is rollout.Trial's.
    """

    study: Study
    method: str
    rows: tuple[EpisodeRow, ...]
    keys: tuple[str, ...]
    attempt: int
    folder: Path
    record: Record
    chosen: frozenset[str] = frozenset()
    video: bool = False
    attention: tuple[str, ...] = ()
    policy_timeout_s: float | None = None

    def settings(self) -> dict[str, Any]:
        """The run's configuration, as it is on this machine. Raises: as `Study.configuration`."""
        self.study.open_suites()
        return self.study.configuration()


def run_job(job: Job) -> Rows:
    """Run one job in this process, and return a row of the results table for each episode.

    `peak_mb` is the most memory that the process has taken so far. `policy_sha256` begins the
    checksum of the policy's parameters. `bound` marks a method or policy that reads the simulator:
    its rows are no results.

    Raises: BadPolicy when the parameters changed, or the checkpoint since the run began; BadStudy;
        BadOutput.
    """
    from vap_core.rollout.loop import rollout
    from vap_core.simulation.scenes import Scene

    job.study.open_suites()
    trial = make_trial(job.study, job.rows, job.method, job.folder / "memory")
    require_same_weights(job.study, job.rows[0].suite, job.folder)
    begin = _recorders(job) if _records(job) else None
    if job.attention and not getattr(trial.policy, "attends", False):
        raise BadStudy(
            f"engine: {trial.policy.label} gives no attention maps, as pi0, pi0.5, mini-pi0 and "
            "smolvla do on square pictures; leave --attention out."
        )
    trial = replace(
        trial,
        attention=() if begin is None else job.attention,
        policy_timeout_s=job.policy_timeout_s,
    )
    with unchanged_weights(trial.policy) as checksum:
        # Other libraries' environments take memory: one at a time.
        batch = BATCH if isinstance(trial.scene, Scene) else 1
        episodes = list(rollout(trial, job.rows, begin, batch=batch))
    steps.write(job.folder, episodes)
    logs.write_states(job.folder, episodes)
    logs.write_audit(job.folder, episodes)
    columns = {
        "attempt": job.attempt,
        "policy_sha256": checksum,
        "bound": trial.bound,
        "peak_mb": getrusage(RUSAGE_SELF).ru_maxrss // 1024,
    }
    rows = []
    for key, episode in zip(job.keys, episodes, strict=True):
        found = {**diagnosis.columns(episode), **logs.switch_columns(episode)}
        hidden = logs.hidden_columns(episode, trial.occlusion)
        rows.append({"key": key, **columns, **episode.summary(), **found, **hidden})
    return rows


def row_of_dead_worker(job: Job, why: str) -> dict[str, Any]:
    """The row of a job's only episode, whose worker died: an error before its first step.

    Raises: BadPolicy when the policy's checkpoint is not on this machine.
    """
    (row,), (key,) = job.rows, job.keys
    header = EpisodeHeader(
        row=row,
        method=job.method,
        policy=job.study.policy_label(row.suite),
        hz=suites.suite(row.suite).hz,
        cameras=(),
        instruction=row.instruction,
        rewritten=row.instruction,
        groundings={},
        object_sizes_m={},
    )
    outcome = Outcome(
        status="error",
        success=False,
        success_once=False,
        held_steps=0,
        cmr=None if row.rule == "selected" else False,
        wrong_object=False,
        first_object_correct=False,
        steps=0,
        detail=why,
    )
    episode = Episode(header=header, frames=(), outcome=outcome, seconds={})
    columns = {"key": key, "attempt": job.attempt, "policy_sha256": None, "peak_mb": 0}
    return {**columns, **episode.summary(), **diagnosis.columns(episode)}


def _records(job: Job) -> bool:
    """Whether any episode of the job may be recorded."""
    if isinstance(job.record, int):
        return not job.chosen.isdisjoint(job.keys)
    return job.record != "none"


def _recorders(job: Job) -> Callable[[EpisodeHeader], "Recorder | DeferredRecorder"]:
    """The function that begins the recording of an episode of the job. Raises: BadOutput."""
    from vap_core.recording import (
        DeferredRecorder,
        Recorder,
        is_failure_or_sampled,
        recording_name,
    )

    folder = job.folder / "recordings"
    with writing(folder, "engine"):
        folder.mkdir(parents=True, exist_ok=True)
    keys = {(row.key, row.seed): key for row, key in zip(job.rows, job.keys, strict=True)}

    def begin(header: EpisodeHeader) -> "Recorder | DeferredRecorder":
        row = header.row
        path = folder / recording_name(row, job.method)
        # A run that was killed may have recorded an episode and not stored its result.
        path.unlink(missing_ok=True)
        if job.record == "all":
            return Recorder(path, header, video=job.video, explain=diagnosis.explain)

        def is_wanted(outcome: Outcome) -> bool:
            if job.record == "failures":
                return is_failure_or_sampled(outcome, row, job.method)
            return keys[row.key, row.seed] in job.chosen

        return DeferredRecorder(path, header, is_wanted, video=job.video, explain=diagnosis.explain)

    return begin


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
        how: dict[str, Any] = dict(video=video, attention=attention)
        how["policy_timeout_s"] = policy_timeout_s
        return [replace(job, **how) for job in missing_jobs(study, folder, record, retries, short)]

    store.open_run(folder, study.configuration())
    own_files = suites.own_files(suite for suite, _ in study.tasks)
    if own_files:
        write_atomic(folder / suites.own.FILES, ":".join(own_files).encode())
    for line in policy_notes(study):
        print(line, file=sys.stderr)
    with store.locked(folder):
        store.sweep(folder)
        store.compact(folder)
        if executor is results and missing():
            if progress:
                print(f"loading {study.policy}, {study.stack} perception ...", file=sys.stderr)
            prepare(worker_modules(study.policy))
        register_personal(study, folder / "memory")
        table = store.read(folder)
        with tqdm(
            total=len(study.methods) * sum(len(study.rows(*task)) for task in study.tasks),
            initial=len(table),
            unit="episode",
            desc=", ".join(dict.fromkeys(suite for suite, _ in study.tasks)),
            disable=not progress,
            smoothing=0.05,
        ) as bar:
            counts = {
                str(method): Counter(success=int(part.success.sum()), n=len(part))
                for method, part in table.groupby("method")
            }
            counted = set(map(store.key_of, table.to_dict("records")))

            def keep(job: Job, rows: Rows) -> None:
                store.append(folder, rows)
                _show_progress(bar, counts, counted, job.method, rows)

            def alone(jobs: Sequence[Job]) -> Iterator[tuple[Job, Rows]]:
                return run_alone(jobs, executor, retries, bool(len(store.read(folder))))

            def note(deaths: int) -> None:
                how = "again" if deaths <= retries else "one episode at a time"
                bar.write(
                    f"note: a worker process died; what it was doing runs {how} "
                    f"({deaths} of {retries + 1} deaths).",
                    file=sys.stderr,
                )

            work_off(
                missing, run_job, keep, executor, workers, retries=retries, alone=alone, note=note
            )
        store.compact(folder)
    table = store.read(folder)
    errors = table[table["outcome"] == "error"]
    if len(errors):
        print(
            f"note: {number_of(len(errors), 'episode')} ended in an error; when the cause is "
            f"mended, the same command with --retries {int(errors['attempt'].max())} tries again.",
            file=sys.stderr,
        )
    return table


def run_alone(
    jobs: Sequence[Job], executor: Executor, retries: int, others_finished: bool
) -> Iterator[tuple[Job, Rows]]:
    """Each episode in a worker of its own, until one that ends its worker is found.

    Such an episode is an error, and is not tried again, where another one finishes: after it, or
    before (`others_finished`).

    Raises: WorkerDied.
    """
    dead: list[tuple[Job, Rows]] = []
    singles = [
        replace(job, rows=(row,), keys=(key,))
        for job in jobs
        for row, key in zip(job.rows, job.keys, strict=True)
    ]
    for job in singles:
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
    table = store.read(folder)
    attempts = {row.key: (row.attempt, row.outcome) for row in table.itertuples()}
    given = 0
    for method in reversed(study.methods):
        for suite, task in study.tasks:
            rows = [(row, result_key(row, method, run_digest)) for row in study.rows(suite, task)]
            recorded = spread_evenly(rows, record) if isinstance(record, int) else []
            chosen = frozenset(key for _, key in recorded)
            for (_, attempt), group in _missing_groups(rows, attempts, retries).items():
                record_now = record if attempt == 1 else "all"
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
    fresh = set(map(store.key_of, rows)) - counted
    counted |= fresh
    won = sum(row["success"] for row in rows)
    counts.setdefault(method, Counter()).update(success=won, n=len(fresh))
    rates = [
        f"{name} {100 * count['success'] / count['n']:.0f} % of {count['n']}"
        for name, count in sorted(counts.items())
        if count["n"]
    ]
    bar.set_postfix_str(", ".join(rates), refresh=False)
    bar.update(len(fresh))
