"""The arms of the evaluation benchmark that run this package's rollout."""

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from vap_core.cli.bench.eval_plan import (
    BATCH,
    FOLLOW,
    SUITE,
    TASK,
    Arm,
    Plan,
    Work,
    add_parts,
    count_of,
    shorten,
)
from vap_core.evaluation.processes import end_with_parent
from vap_core.policies.lerobot.toy_pi0 import toy_sizes
from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow

_trial: Any = None
"""What a process runs episodes with; `_build` sets it."""


def rollout_arms(plan: Plan, folder: Path, stack: ExitStack) -> list[Arm]:
    """rollout in one warm process, then in several."""
    arms = []
    if not plan.workers:
        _build(plan, folder)
        stack.callback(_close)
        for follow, ending in FOLLOW.items():
            name = f"ours, batches of {BATCH}, in this process{ending}"
            work = partial(_run_batch, plan.rows(), follow)
            arms.append(Arm(name, work, [], {}))
        return arms
    for workers in sorted({1, plan.workers}):
        pool = _start_pool(plan, folder, workers, stack)
        for follow, ending in FOLLOW.items():
            name = f"ours, batches of {BATCH}, {count_of(workers, 'worker')}{ending}"
            arms.append(Arm(name, _spread(plan, pool, follow), [], {}))
    return arms


def _start_pool(plan: Plan, folder: Path, workers: int, stack: ExitStack) -> ProcessPoolExecutor:
    """So many warm processes."""
    pool = stack.enter_context(
        ProcessPoolExecutor(workers, get_context("spawn"), _start_worker, (plan, folder))
    )
    # One job for each: the first process is still starting when the next job comes.
    jobs = []
    for _ in range(workers):
        jobs.append(pool.submit(_run_batch, [], "step"))
    for job in jobs:
        job.result()
    return pool


def _spread(plan: Plan, pool: ProcessPoolExecutor, follow: str) -> Work:
    """All episodes, in batches over the processes."""
    rows = plan.rows()

    def run() -> Mapping[str, float]:
        batches = []
        for first in range(0, len(rows), BATCH):
            batches.append(rows[first : first + BATCH])
        total: dict[str, float] = {}
        for parts in pool.map(partial(_run_batch, follow=follow), batches):
            add_parts(total, parts)
        return total

    return run


def _start_worker(plan: Plan, folder: Path) -> None:
    end_with_parent()
    _build(plan, folder)


def _build(plan: Plan, folder: Path) -> None:
    """All that an episode needs, and two steps of one to warm up."""
    global _trial
    from vap_core.attend import Attender
    from vap_core.memory import load_bank
    from vap_core.perception.stacks import load_stack
    from vap_core.policies.lerobot.adapter import load_policy
    from vap_core.rollout.loop import Trial
    from vap_core.rollout.prompters.tint import TintPrompter
    from vap_core.simulation.suites.open_row import build_scene

    models: dict[str, None] = {}
    for row in suites.rows(SUITE, TASK):
        for placement in row.placements:
            models[placement.model] = None
    suite = suites.suite(SUITE)
    with toy_sizes(plan.toy):
        policy = load_policy(folder / "pi0", "cpu")
    attender = Attender(load_stack("embedded"), load_bank(folder / "memory"))
    _trial = Trial(
        method="vap",
        scene=build_scene(SUITE, tuple(models)),
        policy=policy,
        prompter=TintPrompter(attender),
        control=suite.control,
        sensor=suite.sensor,
    )
    first_rows = plan.rows()[:BATCH]
    _run_batch(shorten(first_rows, 2), "step")


def _close() -> None:
    global _trial
    _trial.scene.close()
    _trial = None


def _run_batch(rows: Sequence[EpisodeRow], follow: str) -> Mapping[str, float]:
    """Run episodes; returns seconds by part, "rest" is what no part counts."""
    from vap_core.rollout.loop import rollout

    start = time.perf_counter()
    parts = dict.fromkeys(("environment", "attend", "policy", "record"), 0.0)
    trial = replace(_trial, follow=follow)
    for episode in rollout(trial, rows, batch=BATCH):
        assert episode.outcome.status != "error", episode.outcome.detail
        assert episode.outcome.steps == episode.header.row.max_steps
        for part, seconds in episode.seconds.items():
            known = part if part in parts else "environment"
            parts[known] += seconds
    rest = time.perf_counter() - start - sum(parts.values())
    return {**parts, "rest": rest}
