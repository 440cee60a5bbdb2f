"""The numbers of a report as tidy tables: rates with both intervals, outcomes, comparisons.

Rates and differences are fractions.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from vap_core.evaluation import paper
from vap_core.evaluation.metrics import MEASURES, RATES, SCORE_KEY, TRACK, count, intervals
from vap_core.evaluation.policy_names import PRIVILEGED
from vap_core.evaluation.report.runs import Runs
from vap_core.evaluation.statistics import (
    ALL_TASKS,
    Comparison,
    layout_clusters,
    layout_interval,
)
from vap_core.simulation import suites

if TYPE_CHECKING:
    import pandas as pd

OUTCOMES = ("success", "failure", "error")


def results(runs: Runs) -> "pd.DataFrame":
    """One row per suite, task, split, method and policy, in the order of the runs.

    After the tasks of each track that has several, rows of ALL_TASKS follow; their `listed` counts
    the tasks that any method of the track was asked for. `n` of `listed` episodes were run, `asked`
    were asked for. `sr_k` of `sr_n` episodes succeed; `sr_low` and
    `sr_high` are Wilson's. `sr_layout_*` is the cluster bootstrap
    over starting layouts where a layout was run more than once, else nan. `bound` marks a method or
    policy that reads the simulator. `paper_*` are the paper's numbers.

    Raises: BadOutput, as `paper.ledger`.
    """
    import pandas as pd

    key = list(SCORE_KEY)
    table, wanted = _with_totals(runs)
    counts = count(table, key).rename(columns=_count_columns()).drop(columns="steps")
    lines = (
        wanted.groupby(key, sort=False)
        .agg(asked=("asked", "sum"), listed=("listed", "sum"), seeds=("seed", "nunique"))
        .reset_index()
        .merge(counts, on=key, how="left")
    )
    total = lines["task"] == ALL_TASKS
    lines.loc[total, "listed"] = _listed_together(runs, lines[total], TRACK)
    counted = counts.columns.drop(key)
    lines[counted] = lines[counted].fillna(0).astype(int)
    for name in RATES:
        _add_rate(lines, name)
    lines = lines.merge(_layout_intervals(table), on=key, how="left")
    reading = pd.MultiIndex.from_frame(reads_simulator(table)[key])
    lines["bound"] = pd.MultiIndex.from_frame(lines[key]).isin(reading)
    lines["layouts"] = lines["layouts"].fillna(0).astype(int)
    published = paper_results(runs).rename(columns={"sr": "paper_sr", "cmr": "paper_cmr"})
    return lines.merge(published, on=[*TRACK, "task", "method"], how="left")


def paper_results(runs: Runs) -> "pd.DataFrame":
    """The paper's main results, without tasks that a run plays with an object of one's own.

    Raises: BadOutput, as `paper.ledger`.
    """
    import pandas as pd

    published = paper.main_results()
    own = []
    for manifest in runs.manifests.values():
        if manifest["configuration"].get("object"):
            own += [tuple(task) for task in manifest["configuration"]["tasks"]]
    if not own:
        return published
    tasks = pd.MultiIndex.from_frame(published[["suite", "task"]])
    return published[~tasks.isin(own)]


def outcomes(runs: Runs) -> "pd.DataFrame":
    """Per suite, method and policy: how many episodes were asked for, and how they ended.

    `retried` is nan where attempts were not kept.
    """
    by = ["suite", "method", "policy"]
    attempt = runs.table["attempt"].astype(float)
    retried = (attempt > 1).astype(float).where(attempt.notna())
    flat = runs.table[by].assign(run=1, retried=retried, attempts=attempt)
    for outcome in OUTCOMES:
        flat[outcome] = runs.table["outcome"].eq(outcome).astype(int)
    groups = flat.groupby(by, sort=False)
    ended = groups[["run", *OUTCOMES]].sum()
    ended["retried"] = groups["retried"].sum(min_count=1)
    ended["most_attempts"] = groups["attempts"].max()
    wanted = runs.wanted.groupby(by, sort=False)
    lines = wanted[["listed", "asked"]].sum().join(wanted["seed"].nunique().rename("seeds"))
    lines = lines.join(ended).reset_index()
    lines["listed"] = _listed_together(runs, lines, ["suite"])
    lines = lines.drop(columns="seeds")
    lines[["run", *OUTCOMES]] = lines[["run", *OUTCOMES]].fillna(0).astype(int)
    return lines


def errors(runs: Runs, limit: int = 5) -> list[str]:
    """The last lines of the commonest tracebacks, with how often they occurred."""
    details = runs.table.loc[runs.table["outcome"].eq("error"), "detail"].fillna("").astype(str)
    last_lines = details.str.strip().str.rsplit("\n", n=1).str[-1].str.slice(0, 160)
    counts = last_lines.replace("", "(no traceback was kept)").value_counts(sort=True)
    lines = []
    for text, n in counts.head(limit).items():
        lines.append(f"{n} x {text}")
    if len(counts) > limit:
        rest = counts.iloc[limit:].sum()
        lines.append(f"and {rest} of {len(counts) - limit} other kinds")
    return lines


def comparisons(compared: Sequence[Comparison]) -> "pd.DataFrame":
    """One row per comparison."""
    import pandas as pd

    columns = list(Comparison.__dataclass_fields__)
    return pd.DataFrame([asdict(comparison) for comparison in compared], columns=columns)


def _count_columns() -> dict[str, str]:
    """The columns of `metrics.count` as this table names them."""
    names = {}
    for name, measure in zip(RATES, MEASURES, strict=True):
        names[measure] = f"{name}_k"
        names[f"{measure}_n"] = f"{name}_n"
    return names


def _add_rate(lines: "pd.DataFrame", name: str) -> None:
    """Add a rate with Wilson's interval."""
    k = lines[f"{name}_k"].to_numpy()
    n = lines[f"{name}_n"].to_numpy()
    lines[name] = np.divide(k, n, out=np.full(len(k), np.nan), where=n > 0)
    lines[f"{name}_low"], lines[f"{name}_high"] = intervals(k, n)


def _with_totals(runs: Runs) -> "tuple[pd.DataFrame, pd.DataFrame]":
    """The episodes and the wanted counts; both again as ALL_TASKS, where a track has several."""
    import pandas as pd

    tasks = runs.wanted.groupby(TRACK, sort=False)["task"].nunique()
    several = tasks[tasks > 1].index

    def with_total(table: "pd.DataFrame") -> "pd.DataFrame":
        repeated = table[pd.MultiIndex.from_frame(table[TRACK]).isin(several)]
        return pd.concat([table, repeated.assign(task=ALL_TASKS)], ignore_index=True)

    wanted = with_total(runs.wanted)
    order = wanted.groupby(TRACK, sort=False).ngroup().sort_values(kind="stable").index
    return with_total(runs.table), wanted.loc[order].reset_index(drop=True)


def _listed_together(runs: Runs, lines: "pd.DataFrame", where: Sequence[str]) -> "pd.Series[int]":
    """`listed` of lines over all tasks that any method was asked for `where` a line is.

    A suite without a list has no more than a method was asked for.
    """
    by_task = runs.wanted.groupby([*TRACK, "task"], sort=False)["listed"].max().reset_index()
    together = by_task.groupby(list(where), sort=False)["listed"].sum().rename("together")
    found = lines.join(together, on=list(where))
    whole = found["seeds"] * found["together"]
    return whole.where(found["suite"].map(suites.has_list), found["listed"])


def _layout_intervals(table: "pd.DataFrame") -> "pd.DataFrame":
    """The number of layouts of each line, and the cluster bootstrap of SR where layouts return."""
    import pandas as pd

    key = list(SCORE_KEY)
    clusters = layout_clusters(table, by=key).reset_index()
    lines = []
    for names, part in clusters.groupby(key, sort=False):
        low, high = layout_interval(part["won"].to_numpy(), part["n"].to_numpy())
        lines.append((*names, len(part), low, high))
    return pd.DataFrame(lines, columns=[*key, "layouts", "sr_layout_low", "sr_layout_high"])


def reads_simulator(table: "pd.DataFrame") -> "pd.DataFrame":
    """The episodes whose method or policy reads the simulator; older runs say it of no method."""
    bound = np.zeros(len(table), bool)
    if "policy" in table:
        bound |= table["policy"].isin(PRIVILEGED)
    if "bound" in table:
        bound |= table["bound"].eq(True)
    return table[bound]
