"""Runs an ablation with the engine, one run an arm, and says what it found."""

from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.figures import write_png
from vap_core.base.files import writing
from vap_core.base.tables import align
from vap_core.evaluation import store
from vap_core.evaluation.ablations.arms import ABLATIONS
from vap_core.evaluation.ablations.picture import effects_figure, policies_figure
from vap_core.evaluation.ablations.table import (
    across_policies,
    arm_results,
    arm_rows,
    policy_results,
)
from vap_core.evaluation.engine import run
from vap_core.evaluation.hiding import hiding_lines
from vap_core.evaluation.jobs import Record
from vap_core.evaluation.study import Study
from vap_core.evaluation.switching import switching_lines

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


def ablate_text(
    name: str, study: Study, root: Path, *, workers: int = 2, record: Record = "none"
) -> str:
    """Run what `root` lacks, draw `NAME.png` there, and return the table.

    Raises: what `engine.run` and `arm_results` raise.
    """
    ablation = ABLATIONS[name]
    episodes = run_arms(name, study, root, workers=workers, record=record)
    picture = root / f"{name}.png"
    if ablation.policies:
        tables, figure = _of_policies(name, episodes)
        policy = "each by its label"
    else:
        results = arm_results(ablation, episodes)
        tables, figure = [align(arm_rows(results))], effects_figure(results, ablation.question)
        policy = study.policy
    with writing(picture, "ablate"):
        write_png(figure, picture, dpi=200)
    errors = int(episodes["outcome"].eq("error").sum())
    first = arm_folder(study, root, ablation.names[0])
    lines = [
        ablation.question,
        *tables,
        *switching_lines(episodes),
        *hiding_lines(episodes),
        f"n episodes a suite, {study.seeds} seed(s) from {study.seed}; policy {policy}; "
        f"{errors} errors. Intervals of rates: over layouts where they return, else Wilson's; of "
        "differences: cluster bootstrap over layouts. p exact, Holm's correction over the arms of "
        "a suite.",
        f"picture: {picture}",
        f"every arm is a run of its own: {study.next_command('diagnose', first)}",
    ]
    return "\n".join(lines)


def _of_policies(name: str, episodes: "pd.DataFrame") -> "tuple[list[str], Figure]":
    """A table for every policy, and one that compares the policies; and their picture."""
    ablation = ABLATIONS[name]
    of_policies = policy_results(ablation, episodes)
    tables = []
    for label, results in of_policies.items():
        tables += [f"{label}: {ablation.policies[label]}", align(arm_rows(results))]
    across = align(arm_rows(across_policies(ablation, episodes)))
    tables += [f"{ablation.names[-1]} with every policy, against the first", across]
    return tables, policies_figure(of_policies, name)


def run_arms(
    name: str, study: Study, root: Path, *, workers: int = 2, record: Record = "none"
) -> "pd.DataFrame":
    """The episodes of every arm of an ablation; those that `root` lacks are run.

    Each arm is a run in a folder of its own, so that ablations share the arms that they have in
    common; so is each arm with each policy, where the ablation has policies.

    Raises: what `engine.run` raises.
    """
    import pandas as pd

    tables = []
    for policy in ABLATIONS[name].policies.values() or (study.policy,):
        with_policy = replace(study, policy=policy)
        for arm in ABLATIONS[name].names:
            of_arm = replace(with_policy, methods=(arm,))
            folder = arm_folder(with_policy, root, arm)
            tables.append(run(of_arm, folder, workers=workers, record=record))
    columns = dict.fromkeys(chain.from_iterable(tables))
    kept = [table.dropna(axis="columns", how="all") for table in tables]
    return pd.concat(kept, ignore_index=True).reindex(columns=list(columns))


def arm_folder(study: Study, root: Path, arm: str) -> Path:
    """The run of one arm: its name, and the digest of everything that its results depend on."""
    digest = store.digest(replace(study, methods=(arm,)).configuration())
    return root / f"{arm}-{digest[:8]}"
