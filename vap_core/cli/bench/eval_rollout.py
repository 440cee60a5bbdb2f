"""The arms of the evaluation benchmark that run this package's rollout."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from vap_core.base.version import code_version
from vap_core.cli.bench.eval_plan import (
    BATCH,
    FOLLOW,
    SUITE,
    TASK,
    Arm,
    Cost,
    Plan,
    count_of,
)
from vap_core.cli.bench.profile_parts import ROLLOUT_PARTS, profiled
from vap_core.evaluation.processes import end_with_parent
from vap_core.policies.lerobot.toy_pi0 import toy_sizes
from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow

_trial: Any = None
"""What a process runs episodes with; `_build` sets it."""


def rollout_arms(plan: Plan, folder: Path, stack: ExitStack) -> list[Arm]:
    """rollout in one warm process, then in several; `folder` is a LoopProcess', prepared."""
    arms = []
    for workers in sorted({1, plan.workers}):
        pool = _start_pool(plan, folder, workers, stack)
        for follow, name in FOLLOW.items():
            arms.append(
                Arm(
                    name=f"batches of {BATCH}, {count_of(workers, 'worker')}, {name}",
                    loop="ours",
                    code=code_version(),
                    run=_spread(plan, pool, follow),
                    equal_cpu=name if workers == 1 else "",
                    wall=name if workers == plan.workers else "",
                )
            )
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


def _spread(plan: Plan, pool: ProcessPoolExecutor, follow: str) -> Callable[[], Cost]:
    """All episodes, in batches over the processes."""
    rows = plan.rows()

    def run() -> Cost:
        batches = []
        for first in range(0, len(rows), BATCH):
            batches.append(rows[first : first + BATCH])
        start = time.perf_counter()
        costs = list(pool.map(partial(_run_batch, follow=follow), batches))
        wall = time.perf_counter() - start
        parts: dict[str, float] = {}
        for cost in costs:
            for part, seconds in cost.parts.items():
                parts[part] = parts.get(part, 0.0) + seconds
        return Cost(wall, sum(cost.cpu for cost in costs), parts)

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
    from vap_core.simulation.suites.open_row import build_scene, models_of

    models = models_of(suites.rows(SUITE, TASK))
    suite = suites.suite(SUITE)
    with toy_sizes(plan.toy):
        policy = load_policy(folder / "pi0", "cpu")
    attender = Attender(load_stack("embedded"), load_bank(folder / "memory"))
    _trial = Trial(
        method="vap",
        scene=build_scene(SUITE, models),
        policy=policy,
        prompter=TintPrompter(attender),
        control=suite.control,
        sensor=suite.sensor,
    )
    first_rows = plan.rows()[:BATCH]
    _run_batch([replace(row, max_steps=2) for row in first_rows], "step")


def _run_batch(rows: Sequence[EpisodeRow], follow: str) -> Cost:
    """Run episodes, and say what they took."""
    from vap_core.rollout.loop import rollout

    trial = replace(_trial, follow=follow)
    with profiled(ROLLOUT_PARTS) as parts:
        wall = time.perf_counter()
        cpu = time.process_time()
        for episode in rollout(trial, rows, batch=BATCH):
            assert episode.outcome.status != "error", episode.outcome.detail
            assert episode.outcome.steps == episode.header.row.max_steps
        cpu = time.process_time() - cpu
        wall = time.perf_counter() - wall
    return Cost(wall, cpu, parts.with_rest(cpu))
