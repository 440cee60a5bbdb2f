"""What one worker process runs: a batch of episodes of one task and variant under one method."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from typing import TYPE_CHECKING, Any, Literal

from vap_core.base.errors import BadStudy
from vap_core.base.files import writing
from vap_core.evaluation import diagnosis, hiding, input_audit, state_log, steps, switching
from vap_core.evaluation.same_weights import require_same_weights
from vap_core.evaluation.study import Study
from vap_core.evaluation.trials import make_trial
from vap_core.policies.weight_guard import unchanged_weights
from vap_core.rollout.types import Episode, EpisodeHeader
from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow, Outcome

if TYPE_CHECKING:
    from vap_core.recording import DeferredRecorder, Recorder

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


def run_job(job: Job) -> Rows:
    """Run one job in this process, and return a row of the results table for each episode.

    `peak_mb` is the most memory that the process has taken so far. `policy_sha256` begins the
    checksum of the policy's parameters. `bound` marks a method or policy that reads the simulator:
    its rows are no results.

    Raises: BadPolicy when the parameters changed, or the checkpoint since the run began; BadStudy;
        BadOutput.
    """
    from vap_core.rollout.loop import rollout

    job.study.open_suites()
    trial = make_trial(job.study, job.rows, job.method, job.folder / "memory")
    require_same_weights(job.study, job.rows[0].suite, job.folder)
    begin = None
    if _records(job):
        begin = _recorders(job)
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
        episodes = list(rollout(trial, job.rows, begin, batch=BATCH))
    steps.write(job.folder, episodes)
    state_log.write(job.folder, episodes)
    input_audit.write(job.folder, episodes)
    columns = {
        "attempt": job.attempt,
        "policy_sha256": checksum,
        "bound": trial.bound,
        "peak_mb": getrusage(RUSAGE_SELF).ru_maxrss // 1024,
    }
    rows = []
    for key, episode in zip(job.keys, episodes, strict=True):
        found = {**diagnosis.columns(episode), **switching.columns(episode)}
        hidden = hiding.columns(episode, trial.occlusion)
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
    keys = {}
    for row, key in zip(job.rows, job.keys, strict=True):
        keys[row.key, row.seed] = key

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
