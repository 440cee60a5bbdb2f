"""Runs an ablation with the engine, and says what it found."""

from pathlib import Path

from vap_core.base.tables import align
from vap_core.evaluation.ablations.arms import ABLATIONS
from vap_core.evaluation.ablations.picture import effects_figure
from vap_core.evaluation.ablations.table import arm_results, arm_rows
from vap_core.evaluation.engine import run
from vap_core.evaluation.jobs import Record
from vap_core.evaluation.study import Study
from vap_core.evaluation.switching import switching_lines


def ablate_text(
    name: str, study: Study, folder: Path, *, workers: int = 2, record: Record = "none"
) -> str:
    """Run what `folder` lacks, draw `effects.png` there, and return the table.

    Raises: what `engine.run` raises.
    """
    ablation = ABLATIONS[name]
    episodes = run(study, folder, workers=workers, record=record, what_for=f"ablate {name}")
    results = arm_results(ablation, episodes)
    picture = folder / "effects.png"
    effects_figure(results, ablation.question).savefig(picture, dpi=200)
    errors = int(episodes["outcome"].eq("error").sum())
    lines = [
        ablation.question,
        align(arm_rows(results)),
        *switching_lines(episodes),
        f"n episodes a suite, {study.seeds} seed(s) from {study.seed}; policy {study.policy}; "
        f"{errors} errors. Intervals: Wilson's for rates, cluster bootstrap over layouts for "
        "differences; p exact, Holm's correction over the arms of a suite.",
        f"picture: {picture}",
        f"why they failed: python -m vap_core diagnose {folder}",
    ]
    return "\n".join(lines)
