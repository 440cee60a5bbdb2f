"""CPU milliseconds of a control step by part, as `eval` runs episodes by default.

The shipped mini-pi0, images at the policy's calls, batches of five, failures recorded, in this
process. Imports, registration and a first warm episode do not count.
"""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from vap_core.cli.bench.jobs import jobs_of
from vap_core.cli.bench.measurement import Measurement, Table, provenance
from vap_core.cli.bench.profile_parts import profiled
from vap_core.evaluation.engine import spread_evenly
from vap_core.evaluation.jobs import Job, run_job
from vap_core.evaluation.policy_names import MINI
from vap_core.evaluation.study import Study
from vap_core.evaluation.trials import register_personal
from vap_core.simulation.types import EpisodeRow

METHODS = ("generic", "vap")
EPISODES = 5
"""Of every task of a column."""
QUICK_STEPS = 3


@dataclass(frozen=True)
class Column:
    """Some tasks of one suite in one variant; measured under every method."""

    name: str
    suite: str
    tasks: tuple[str, ...]
    variant: str = "base"


COLUMNS = (
    Column("bridge", "simpler-bridge", ("put-camera", "pick-shaver")),
    Column("fractal base", "simpler-fractal", ("pick-pen-holder", "move-bottle-near-coke-can")),
    Column("fractal distractors-many", "simpler-fractal", ("pick-pen-holder",), "distractors-many"),
    Column("vlabench", "vlabench", ("select-cup", "select-leather-bag")),
    Column("tabletop", "tabletop", ("select-cup", "put-plant")),
)


def measure(episodes: int = EPISODES, quick: bool = False) -> Measurement:
    """Every column under every method; about five minutes, `quick` half a minute."""
    columns = COLUMNS[:1] if quick else COLUMNS
    n = 1 if quick else episodes
    measured = []
    cost = 0.0
    with tempfile.TemporaryDirectory() as scratch:
        turns = [(column, method) for column in columns for method in METHODS]
        for column, method in tqdm(turns, unit="column", disable=None):
            found, cost = _measure_column(
                column=column, method=method, n=n, quick=quick, folder=Path(scratch) / column.name
            )
            measured.append(found)
    about = provenance(
        "python -m vap_core bench profile",
        n=f"{n} episodes a task",
        seed=0,
        clock="CPU time of one process",
    )
    return Measurement("profile", about, {"columns": measured, "count_us": 1e6 * cost})


def tables(measurement: Measurement) -> list[Table]:
    """Milliseconds a control step, and the share of the total."""
    columns = measurement.values["columns"]
    header = ["part"]
    steps = ["steps"]
    total = ["total"]
    for column in columns:
        header.append(f"{column['name']}, {column['method']}")
        steps.append(str(column["steps"]))
        total.append(f"{_total_ms(column):.1f}")
    rows = [header, steps, total]
    for part in columns[0]["seconds"]:
        rows.append([part, *[_cell(column, part) for column in columns]])
    counts = [f"{_counting_ms(measurement, column):.1f}" for column in columns]
    note = (
        "A part is without the parts that it calls, but for grounding, re-detection and the scene, "
        "which are whole. In the brackets: % of the total; a dash: never called. To count "
        f"calls takes {' / '.join(counts)} ms a step in the order of the columns; it is in the "
        "rows."
    )
    return [Table("CPU milliseconds of a control step", rows, note)]


def _measure_column(
    column: Column, method: str, n: int, quick: bool, folder: Path
) -> tuple[dict[str, Any], float]:
    """What one column says under one method, and the seconds that counting a call takes."""
    tasks = tuple((column.suite, task) for task in column.tasks)
    study = Study(tasks, (method,), policy=MINI, follow="call")
    register_personal(study, folder / "memory")
    jobs = []
    for suite, task in tasks:
        rows = _rows(study.rows(suite, task), column.variant, n)
        if quick:
            rows = [replace(row, max_steps=QUICK_STEPS) for row in rows]
        jobs += jobs_of(study, method, rows, folder)
    run_job(_warm_up(jobs[0]))
    summaries: list[dict[str, Any]] = []
    with profiled() as parts:
        start = time.process_time()
        for job in jobs:
            summaries += run_job(job)
        total = time.process_time() - start
    return {
        "name": column.name,
        "method": method,
        "tasks": list(column.tasks),
        "episodes": len(summaries),
        "steps": sum(int(row["steps"]) for row in summaries),
        "successes": sum(bool(row["success"]) for row in summaries),
        "seconds": parts.with_rest(total),
        "calls": parts.calls,
    }, parts.cost_of_a_call()


def _rows(listed: Sequence[EpisodeRow], variant: str, n: int) -> list[EpisodeRow]:
    """`n` episodes of a list in one variant, spread evenly."""
    return spread_evenly([row for row in listed if row.variant == variant], n)


def _warm_up(job: Job) -> Job:
    """The same job, over after two steps."""
    rows = tuple(replace(row, max_steps=2) for row in job.rows)
    return replace(job, rows=rows)


def _total_ms(column: dict[str, Any]) -> float:
    total: float = sum(column["seconds"].values())
    return 1e3 * total / column["steps"]


def _cell(column: dict[str, Any], part: str) -> str:
    if part in column["calls"] and not column["calls"][part]:
        return "-"
    ms = 1e3 * column["seconds"][part] / column["steps"]
    return f"{ms:.1f} ({100 * ms / _total_ms(column):.0f})"


def _counting_ms(measurement: Measurement, column: dict[str, Any]) -> float:
    calls = sum(column["calls"].values())
    ms: float = 1e-3 * measurement.values["count_us"] * calls / column["steps"]
    return ms
