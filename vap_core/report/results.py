"""The numbers of a report as tidy tables: rates with both intervals beside the paper's, outcomes, comparisons, provenance."""

import shlex
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core import paper, suites
from vap_core.metrics import TRACK, count, intervals
from vap_core.report.runs import Runs
from vap_core.statistics import ALL_TASKS, Comparison, bootstrap_interval

if TYPE_CHECKING:
    import pandas as pd

RATES = {"sr": "success", "cmr": "cmr", "wrong_object": "wrong_object", "first_object_correct": "first_object_correct"}


def results(runs: Runs) -> "pd.DataFrame":
    """One row per suite, task, split, method and policy, in the order of the runs, and per track over ALL_TASKS; rates in percent.

    `sr_k` of `sr_n` episodes succeed; `sr_low`, `sr_high` are Wilson's, `sr_cp_*` Clopper and Pearson's; `sr_layout_*` is the cluster
    bootstrap over starting layouts where a layout was run more than once, else nan. `n` of `listed` episodes were run, `asked` for were as many
    as it says; `bound`: method or policy reads the simulator, and bounds what results can be; `paper_*` are the paper's, in another world.
    """
    import pandas as pd

    track, (table, wanted) = list(TRACK), _with_totals(runs)
    named = {counted: told for name, measure in RATES.items() for counted, told in ((measure, f"{name}_k"), (f"{measure}_n", f"{name}_n"))}
    held = count(table, track).rename(columns=named).drop(columns="steps")
    asked = wanted.groupby(track, sort=False).agg(asked=("asked", "sum"), listed=("listed", "sum"), seeds=("seed", "nunique")).reset_index()
    lines = asked.merge(held, on=track, how="left")
    whole = [column for column in held if column not in track]
    lines[whole] = lines[whole].fillna(0).astype(int)
    for name in RATES:
        k, n = lines[f"{name}_k"].to_numpy(), lines[f"{name}_n"].to_numpy()
        lines[name] = 100 * np.divide(k, n, out=np.full(len(k), np.nan), where=n > 0)
        for form, conservative in (("", False), ("_cp", True)):
            for side, bound in zip(("low", "high"), intervals(k, n, conservative=conservative), strict=True):
                lines[f"{name}{form}_{side}"] = 100 * bound
    lines = lines.merge(_by_layout(table), on=track, how="left")
    reads = table[table["bound"].fillna(False).astype(bool)] if "bound" in table else table[:0]
    lines["bound"] = pd.MultiIndex.from_frame(lines[track]).isin(pd.MultiIndex.from_frame(reads[track]))
    lines["layouts"] = lines["layouts"].fillna(0).astype(int)
    told = paper.main_results().rename(columns={"sr": "paper_sr", "cmr": "paper_cmr"})
    return pd.DataFrame(lines.merge(told, on=["suite", "split", "task", "method"], how="left"))


def _with_totals(runs: Runs) -> "tuple[pd.DataFrame, pd.DataFrame]":
    """The episodes, and what was wanted; both again as ALL_TASKS after the tasks of each track that has several."""
    import pandas as pd

    track = ["suite", "split"]
    several = runs.wanted.groupby(track, sort=False)["task"].nunique().loc[lambda n: n > 1].index
    whole = [part[pd.MultiIndex.from_frame(part[track]).isin(several)].assign(task=ALL_TASKS) for part in (runs.table, runs.wanted)]
    wanted = pd.concat([runs.wanted, whole[1]], ignore_index=True)
    order = wanted.groupby(track, sort=False).ngroup().sort_values(kind="stable").index
    return pd.concat([runs.table, whole[0]], ignore_index=True), wanted.loc[order].reset_index(drop=True)


def _by_layout(table: "pd.DataFrame") -> "pd.DataFrame":
    import pandas as pd

    track = list(TRACK)
    won = table[[*track, "layout"]].assign(won=(table["success"].eq(True) & table["outcome"].ne("error")).astype(float), n=1.0)
    clusters = won.groupby([*track, "layout"], sort=True)[["won", "n"]].sum().reset_index()
    lines = []
    for key, part in clusters.groupby(track, sort=False):
        low, high = (float("nan"),) * 2 if part["n"].max() == 1 else bootstrap_interval(part["won"].to_numpy(), part["n"].to_numpy(), least=0.0)
        lines.append((*key, len(part), 100 * low, 100 * high))
    return pd.DataFrame(lines, columns=[*track, "layouts", "sr_layout_low", "sr_layout_high"])


def outcomes(runs: Runs) -> "pd.DataFrame":
    """Per suite, method and policy: how many episodes were asked for, and how they ended; `retried` is nan where attempts were not kept."""
    by = ["suite", "method", "policy"]
    table = runs.table
    attempt = table["attempt"].astype(float)
    ends = {end: table["outcome"].eq(end).astype(int) for end in ("success", "failure", "error")}
    flat = table[by].assign(run=1, **ends, retried=(attempt > 1).astype(float).where(attempt.notna()), attempts=attempt)
    held = flat.groupby(by, sort=False).agg(
        run=("run", "sum"),
        **{end: (end, "sum") for end in ends},
        retried=("retried", lambda s: s.sum(min_count=1)),
        most_attempts=("attempts", "max"),
    )
    lines = runs.wanted.groupby(by, sort=False)[["listed", "asked"]].sum().join(held).reset_index()
    lines[["run", *ends]] = lines[["run", *ends]].fillna(0).astype(int)
    return lines


def errors(runs: Runs, most: int = 5) -> list[str]:
    """The last lines of the commonest tracebacks, with how often they occurred."""
    told = runs.table.loc[runs.table["outcome"].eq("error"), "detail"].fillna("").astype(str)
    last = told.str.strip().str.rsplit("\n", n=1).str[-1].str.slice(0, 160).replace("", "(no traceback was kept)")
    counted = last.value_counts(sort=True)
    lines = [f"{n} x {text}" for text, n in counted.head(most).items()]
    return lines + ([f"and {counted.iloc[most:].sum()} of {len(counted) - most} other kinds"] if len(counted) > most else [])


def comparisons(found: list[Comparison]) -> "pd.DataFrame":
    """One row per comparison, differences in percentage points."""
    import pandas as pd

    lines = pd.DataFrame([asdict(each) for each in found], columns=list(Comparison.__dataclass_fields__))
    lines[["difference", "low", "high"]] *= 100
    return lines


def provenance(runs: Runs) -> "pd.DataFrame":
    """One row per run: its digest, versions, seed, checksums, and the command that makes it."""
    import pandas as pd

    lines = []
    for folder, note in runs.notes.items():
        study: dict[str, Any] = note["configuration"]
        lines.append({
            "run": str(folder), "digest": note["digest"], "version": study.get("version", ""), "policy": study["policy"], "seed": _seeds(study),
            "stack": study.get("stack", ""), "robots": study.get("robots", ""), "world": study.get("world", ""),
            "weights": _short(study.get("weights", {})), "lists": _short(study.get("lists", {})),
            "command": str(note.get("command") or command(study)),
        })  # fmt: skip
    return pd.DataFrame(lines)


def _seeds(study: dict[str, Any]) -> str:
    first, many = study["seed"], study.get("seeds", 1)
    return str(first) if many == 1 else f"{first}..{first + many - 1}"


def _short(sums: Any) -> str:
    return " ".join(f"{name}:{str(digest)[:12]}" for name, digest in sums.items()) if isinstance(sums, dict) else str(sums)


def command(study: dict[str, Any]) -> str:
    """The command line that runs a configuration, without --out."""
    named: dict[str, list[str]] = {}
    for suite, task in study["tasks"]:
        named.setdefault(suite, []).append(task)
    whole = all(tasks == [task.name for task in suites.suite(suite).tasks] for suite, tasks in named.items())
    options = {name: study.get(name) for name in ("episodes", "seed", "policy", "stack", "robots")}
    if not whole and len(named) > 1:  # only the demo runs some tasks of several suites
        return f"python -m vap_core demo --episodes {options['episodes']} --seed {options['seed']}"
    words = ["eval" if whole else "rollout"]
    for suite, tasks in named.items():
        words += ["--suite", suite, *([] if whole else [word for task in tasks for word in ("--task", task)])]
    words += [word for method in study["methods"] for word in ("--method", method)]
    if whole:
        options |= {"seeds": study["seeds"] if study.get("seeds", 1) > 1 else None, "follow": study.get("follow")}
        options |= {"images-every": study.get("images_every") or None}
    words += [word for name, cell in options.items() if cell is not None for word in (f"--{name}", str(cell))]
    return "python -m vap_core " + shlex.join([*words, *(["--audit"] if study.get("audit") else [])])
