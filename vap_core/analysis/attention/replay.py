"""Runs the episodes of a run again with the attention observed, and keeps the measures as tables.

The same row, weights and seed give the same episode; observing changes no action. What a killed
command had finished is found again in its folder.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.analysis.attention import tables
from vap_core.analysis.attention.observer import NOTHING, Observer, Rows
from vap_core.base.errors import BadStudy
from vap_core.base.files import writing
from vap_core.rollout.calls import QUERIES
from vap_core.rollout.loop import rollout
from vap_core.rollout.types import Episode, EpisodeHeader
from vap_core.simulation.types import EpisodeRow
from vap_core.study import store
from vap_core.study.engine import BATCH, spread_evenly
from vap_core.study.failures import listed_row, study_of
from vap_core.study.methods import needs_token
from vap_core.study.processes import prepare, results
from vap_core.study.results import read_runs
from vap_core.study.stats import layout_name
from vap_core.study.store import digest, locked
from vap_core.study.trials import Study, make_trial, register_personal

if TYPE_CHECKING:
    import pandas as pd

ERRORS = "errors"
"""Beside the tables in a part: the episodes that ended in an error, and its last line."""
Known = tuple[str, int]
"""Outcome and number of steps that an episode has in the run."""


@dataclass(frozen=True)
class Job:
    """Some episodes of one task, variant and method; its name is its file's.

    `known` is how they ended in the run. `explained` of them get the causal measures.
    """

    name: str
    study: Study
    method: str
    rows: tuple[EpisodeRow, ...]
    known: tuple[Known, ...]
    policy: str
    memory: Path
    explained: tuple[bool, ...]


@dataclass(frozen=True)
class Wanted:
    """Which episodes of a run: of these suites and methods (none named: all), of policies whose
    label holds `policy`, so many a task and method.

    `explain` of them get the causal measures, which take as long as many calls.
    """

    suites: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    policy: str = ""
    episodes: int | None = None
    explain: int = 2


def run_replay(
    source: Path, folder: Path, wanted: Wanted, *, workers: int = 2, progress: bool = True
) -> "dict[str, pd.DataFrame]":
    """Do what `folder` lacks, write a parquet table each and return them.

    `source` is a run's folder or a published table.

    Raises: BadOutput, BadStudy when nothing is left of what is asked for, when it was run with
        weights that are not here, or when no call of the policy was observed.
    """
    from tqdm import tqdm

    jobs = plan(source, folder / "memory", wanted)
    with writing(folder, "attention", "choose another folder with --out"):
        folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        parts = folder / "parts"
        with writing(folder, "attention"):
            parts.mkdir(exist_ok=True)
        missing = []
        for job in jobs:
            if not (parts / f"{job.name}.json").exists():
                missing.append(job)
        modules = ("vap_core.analysis.attention.replay", "vap_core.policies.lerobot.preload")
        prepare(modules)
        with tqdm(
            total=sum(len(job.rows) for job in jobs),
            initial=sum(len(job.rows) for job in jobs) - sum(len(job.rows) for job in missing),
            unit="episode",
            desc="attention",
            disable=not progress,
        ) as bar:
            # Tokens take a minute each: what needs none comes first, and is kept.
            for learns in (False, True):
                group = [job for job in missing if needs_token(job.method) == learns]
                for study in dict.fromkeys(job.study for job in group):
                    register_personal(study, folder / "memory")
                for job, rows in results(run_job, group, workers=workers, remedy="--workers"):
                    path = parts / f"{job.name}.json"
                    store.write_json_part(path, rows, caller="attention")
                    bar.update(len(job.rows))
        return _write_tables(source, folder, [parts / f"{job.name}.json" for job in jobs])


def plan(source: Path, memory: Path, wanted: Wanted) -> list[Job]:
    """The jobs of the wanted episodes of a run. Raises: BadOutput, BadStudy."""
    jobs: list[Job] = []
    policies: dict[Any, set[str]] = {}
    for manifest, episodes in read_runs(source):
        if wanted.policy:
            episodes = episodes[episodes["policy"].str.contains(wanted.policy, regex=False)]
        if wanted.suites:
            episodes = episodes[episodes["suite"].isin(wanted.suites)]
        if wanted.methods:
            episodes = episodes[episodes["method"].isin(wanted.methods)]
        ended = episodes[episodes["outcome"] != "error"]
        for key, group in ended.groupby(["suite", "task", "method"], sort=False):
            lines = group.sort_values(["seed", "episode"]).to_dict("records")
            if wanted.episodes is not None:
                lines = spread_evenly(lines, wanted.episodes)
            jobs += _jobs_of(manifest, lines, memory, wanted.explain)
            policies.setdefault(key, set()).update(str(line["policy"]) for line in lines)
    if not jobs:
        raise BadStudy(
            f"attention: {source} holds no episode of what was asked for; leave --suite, --method "
            "or --policy out."
        )
    for names in policies.values():
        if len(names) > 1:
            raise BadStudy(
                f"attention: {source} holds episodes of one task and method by "
                f"{' and '.join(sorted(names))}; choose one with --policy."
            )
    return jobs


def _jobs_of(
    manifest: dict[str, Any], lines: Sequence[dict[str, Any]], memory: Path, explain: int
) -> Iterator[Job]:
    """The jobs of some episodes of one task and method.

    Raises: BadStudy for sub-goals, whose targets change on the way.
    """
    study = study_of(manifest, lines[0])
    chosen = [id(line) for line in spread_evenly(lines, explain)] if explain else []
    by_variant: dict[str, list[dict[str, Any]]] = {}
    for line in lines:
        by_variant.setdefault(str(line["variant"]), []).append(line)
    for same in by_variant.values():
        for first in range(0, len(same), BATCH):
            batch = same[first : first + BATCH]
            rows = tuple(listed_row(study, line) for line in batch)
            if rows[0].subgoals:
                raise BadStudy(
                    f"attention: episodes of {rows[0].suite} in this run have sub-goals, and what "
                    "is measured here is one target's; choose other suites with --suite."
                )
            method = str(batch[0]["method"])
            known = tuple((str(line["outcome"]), int(line["steps"])) for line in batch)
            explained = tuple(id(line) in chosen for line in batch)
            what = {
                "run": manifest["digest"],
                "rows": [(row.task, row.seed, row.episode) for row in rows],
                "explained": explained,
                "method": method,
            }
            yield Job(
                name=f"{rows[0].suite}.{rows[0].task}.{method}.{digest(what)}",
                study=study,
                method=method,
                rows=rows,
                known=known,
                policy=str(batch[0]["policy"]),
                memory=memory,
                explained=explained,
            )


def run_job(job: Job) -> dict[str, Rows]:
    """Run the episodes of one job in this process, and return its part of the tables.

    Raises: BadStudy for a policy without attention maps, or one that has changed since.
    """
    trial = make_trial(job.study, job.rows, job.method, job.memory)
    policy: Any = trial.policy
    check_policy(policy, job.policy)
    explained = {}
    for row, explain in zip(job.rows, job.explained, strict=True):
        explained[row.key, row.seed] = explain
    observers: dict[tuple[str, int], Observer] = {}

    def observe(header: EpisodeHeader) -> Observer:
        row = header.row
        observer = Observer(header, policy, explain=explained[row.key, row.seed])
        observers[row.key, row.seed] = observer
        return observer

    trial = replace(trial, attention=QUERIES)
    found: dict[str, Rows] = {name: [] for name in (*tables.TABLES, ERRORS)}
    episodes = list(rollout(trial, job.rows, observe, batch=BATCH))
    for row, episode, known in zip(job.rows, episodes, job.known, strict=True):
        observer = observers.get((row.key, row.seed))
        if observer is None:  # it ended in an error before its first call
            observer = Observer(episode.header, policy)
        about = _about(episode)
        found["episodes"].append({**about, **_ending(observer, episode, known)})
        for name, rows in observer.tables.items():
            found[name] += [{**about, **row} for row in rows]
        if episode.outcome.status == "error":
            error = episode.outcome.detail.strip().rpartition("\n")[2]
            found[ERRORS].append({**about, "error": error})
    return found


def check_policy(policy: Any, label: str) -> None:
    """Raises: BadStudy for a policy without attention maps, or another than the run's `label`."""
    if not getattr(policy, "attends", False):
        raise BadStudy(
            f"attention: {policy.label} gives no attention maps, as pi0, pi0.5, mini-pi0 and "
            "smolvla do on square pictures; choose another run."
        )
    if policy.label != label:
        raise BadStudy(
            f"attention: this was run with {label}, and {policy.label} is here now; run eval again."
        )


def _about(episode: Episode) -> dict[str, Any]:
    row = episode.header.row
    return {
        "suite": row.suite,
        "task": row.task,
        "method": episode.header.method,
        "seed": row.seed,
        "episode": row.episode,
    }


def _ending(observer: Observer, episode: Episode, known: Known) -> dict[str, Any]:
    """How an episode ended, and whether it ended so in the run, too."""
    outcome = episode.outcome
    step, touched = observer.first_touch or (None, NOTHING)
    summary = episode.summary()
    return {
        "policy": episode.header.policy,
        "layout": f"{episode.header.row.task} {layout_name(episode.header.row)}",
        "text": episode.header.rewritten,
        "outcome": outcome.status,
        "success": outcome.success,
        "steps": outcome.steps,
        "first_touch": step,
        "touched": touched,
        "margin": summary["margin"],
        "reproduced": (outcome.status, outcome.steps) == known,
    }


def _write_tables(source: Path, folder: Path, parts: Sequence[Path]) -> "dict[str, pd.DataFrame]":
    """All parts as one table of each kind, with the runs and the code in the metadata.

    Episodes that ended in an error are left out, and told: they are no failures of a policy.

    Raises: BadStudy when they hold no call.
    """
    rows: dict[str, Rows] = {name: [] for name in (*tables.TABLES, ERRORS)}
    for path in parts:
        for name, part in store.read_json_part(path, caller="attention").items():
            rows[name] += part
    errors = rows.pop(ERRORS)
    n = len(rows["episodes"])
    rows = _without_errors(rows, errors)
    if not rows["calls"]:
        raise _without_calls(folder, n, errors)
    if errors:
        print(
            f"attention: of {n} episodes {_errors_text(errors)}; left out. To run them again "
            f"delete {folder / 'parts'}.",
            file=sys.stderr,
        )
    measured = {row["suite"] for row in rows["episodes"]}
    runs = []
    for manifest, episodes in read_runs(source):
        if measured & set(episodes["suite"]):
            runs.append(manifest)
    tables.write(folder, rows, runs)
    return tables.read(folder)


def _without_calls(folder: Path, episodes: int, errors: Rows) -> BadStudy:
    return BadStudy(
        f"attention: no call of the policy was observed in {episodes} episodes; "
        f"{_errors_text(errors)}. Mend it, delete {folder / 'parts'} and run the same command "
        "again."
    )


def _errors_text(errors: Rows) -> str:
    text = f"{len(errors)} ended in an error"
    if errors:
        first = errors[0]
        name = "/".join(str(first[part]) for part in ("suite", "task", "method", "episode"))
        text += f", the first is {name}: {first['error']:.200}"
    return text


def _without_errors(rows: dict[str, Rows], errors: Rows) -> dict[str, Rows]:
    """The rows of every table without those of episodes that ended in an error."""
    gone = {_episode_of(row) for row in errors}
    return {
        name: [row for row in part if _episode_of(row) not in gone] for name, part in rows.items()
    }


def _episode_of(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in ("suite", "task", "method", "seed", "episode"))
