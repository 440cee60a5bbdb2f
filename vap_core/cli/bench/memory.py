"""Memory of one process over many episodes, which should stay flat once all models are loaded."""

import resource
import shutil
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle
from pathlib import Path

from vap_core.cli.bench.jobs import jobs_of
from vap_core.evaluation import processes
from vap_core.evaluation.jobs import BATCH, Job, run_job
from vap_core.evaluation.policy_names import MINI
from vap_core.evaluation.study import Study
from vap_core.evaluation.trials import register_personal
from vap_core.simulation import suites

SUITE = "simpler-bridge"
STEPS = 10
"""Control steps of an episode: memory may grow with episodes, scenes and recordings."""
Series = list[tuple[int, float]]
"""Episodes run so far, and the megabytes that the process holds then."""


def measure(episodes: int, every: int, folder: Path) -> Series:
    """The memory of a fresh process at its start and after every so many episodes.

    Raises: WorkerDied.
    """
    plan = (episodes, every, folder)
    _, series = next(processes.results(_run, [plan], 1, "--workers"))
    return series


def _run(plan: tuple[int, int, Path]) -> Series:
    """Episodes of all tasks in turn under VAP, in jobs of five; failures are recorded."""
    episodes, every, folder = plan
    series = [(0, resident_mb())]
    tasks = tuple((SUITE, task.name) for task in suites.suite(SUITE).tasks)
    study = Study(tasks, ("vap",), policy=MINI, follow="call")
    register_personal(study, folder / "memory")
    done = 0
    for job in cycle(_jobs(study, folder)):
        run_job(job)
        shutil.rmtree(folder / "recordings", ignore_errors=True)
        done += len(job.rows)
        over = done >= episodes
        if over or done % every == 0:
            series.append((done, resident_mb()))
        if over:
            return series
    raise AssertionError("a suite has tasks")


def _jobs(study: Study, folder: Path) -> Sequence[Job]:
    """A job of each task in turn, over all episodes that fill one."""
    rows = [study.rows(*task) for task in study.tasks]
    jobs: list[Job] = []
    for first in range(0, min(map(len, rows)) - BATCH + 1, BATCH):
        for of_task in rows:
            batch = [replace(row, max_steps=STEPS) for row in of_task[first : first + BATCH]]
            jobs += jobs_of(study, "vap", batch, folder)
    return jobs


def resident_mb() -> float:
    """The megabytes that this process holds; where the system does not tell, the most it held."""
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text().split()[1]) * resource.getpagesize() / 1e6
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
