"""Runs an ablation with the engine, one run an arm, and says what it found."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.tables import align
from vap_core.evaluation import store
from vap_core.evaluation.ablations.arms import ABLATIONS
from vap_core.evaluation.ablations.picture import effects_figure
from vap_core.evaluation.ablations.table import arm_results, arm_rows
from vap_core.evaluation.engine import run
from vap_core.evaluation.hiding import hiding_lines
from vap_core.evaluation.jobs import Record
from vap_core.evaluation.study import Study
from vap_core.evaluation.switching import switching_lines

if TYPE_CHECKING:
    import pandas as pd


def ablate_text(
    name: str, study: Study, root: Path, *, workers: int = 2, record: Record = "none"
) -> str:
    """Run what `root` lacks, draw `NAME.png` there, and return the table.

    Raises: what `engine.run` raises.
    """
    ablation = ABLATIONS[name]
    episodes = run_arms(name, study, root, workers=workers, record=record)
    results = arm_results(ablation, episodes)
    picture = root / f"{name}.png"
    effects_figure(results, ablation.question).savefig(picture, dpi=200)
    errors = int(episodes["outcome"].eq("error").sum())
    first = arm_folder(study, root, ablation.names[0])
    lines = [
        ablation.question,
        align(arm_rows(results)),
        *switching_lines(episodes),
        *hiding_lines(episodes),
        f"n episodes a suite, {study.seeds} seed(s) from {study.seed}; policy {study.policy}; "
        f"{errors} errors. Intervals: Wilson's for rates, cluster bootstrap over layouts for "
        "differences; p exact, Holm's correction over the arms of a suite.",
        f"picture: {picture}",
        f"every arm is a run of its own: python -m vap_core diagnose {first}",
    ]
    return "\n".join(lines)


def run_arms(
    name: str, study: Study, root: Path, *, workers: int = 2, record: Record = "none"
) -> "pd.DataFrame":
    """The episodes of every arm of an ablation; those that `root` lacks are run.

    Each arm is a run in a folder of its own, so that ablations share the arms that they have in
    common.
    """
    import pandas as pd

    tables = []
    for arm in ABLATIONS[name].names:
        of_arm = replace(study, methods=(arm,))
        folder = arm_folder(study, root, arm)
        what_for = f"ablate {name}"
        tables.append(run(of_arm, folder, workers=workers, record=record, what_for=what_for))
    return pd.concat(tables, ignore_index=True)


def arm_folder(study: Study, root: Path, arm: str) -> Path:
    """The run of one arm: its name, and the digest of everything that its results depend on."""
    digest = store.digest(replace(study, methods=(arm,)).configuration())
    return root / f"{arm}-{digest[:8]}"
