"""Jobs as `eval` makes them, for benchmarks that run them in this process."""

from collections.abc import Sequence
from pathlib import Path

from vap_core.evaluation.jobs import BATCH, Job
from vap_core.evaluation.study import Study
from vap_core.simulation.types import EpisodeRow


def jobs_of(study: Study, method: str, rows: Sequence[EpisodeRow], folder: Path) -> list[Job]:
    """Rows of one task in batches; failures are recorded."""
    jobs = []
    for first in range(0, len(rows), BATCH):
        batch = tuple(rows[first : first + BATCH])
        keys = tuple(f"{row.task}-{row.episode}" for row in batch)
        jobs.append(
            Job(
                study=study,
                method=method,
                rows=batch,
                keys=keys,
                attempt=1,
                folder=folder,
                record="failures",
            )
        )
    return jobs
