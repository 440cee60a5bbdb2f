"""How failures divide into cases (P tab:error_case_breakdown), and the funnel of stages."""

from typing import TYPE_CHECKING

from vap_core.base.errors import BadOutput
from vap_core.base.types import value
from vap_core.evaluation.diagnosis import STAGES
from vap_core.evaluation.metrics import rate
from vap_core.evaluation.report.results import reads_simulator
from vap_core.rollout.failure import CASES

if TYPE_CHECKING:
    import pandas as pd

BY = ["suite", "method"]
"""The columns that name a group of episodes here."""
APART = ", "
"""Between a method and a policy in the name of a group."""
SUBGOAL = "subgoal"
"""The column of the sub-goal that was diagnosed, counted from 1, where there are several."""
DIAGNOSIS_COLUMNS = ("case", "sub_case", "deciding_frame")


def check_diagnosed(table: "pd.DataFrame") -> None:
    """Raises: BadOutput when the whole table is older than the diagnosis."""
    if not set(DIAGNOSIS_COLUMNS) <= set(table.columns):
        raise BadOutput(
            "diagnose: this run was made before failures were diagnosed; run the same eval again "
            "in another folder."
        )


def diagnosed(table: "pd.DataFrame") -> "pd.DataFrame":
    """The episodes whose failures were diagnosed.

    Raises: as `check_diagnosed`.
    """
    check_diagnosed(table)
    return table[table["case"].notna()].astype({"deciding_frame": int})


def undiagnosed(table: "pd.DataFrame") -> "pd.DataFrame":
    """The episodes of runs that are older than the diagnosis, in a table that has others, too."""
    return table[table["case"].isna()]


def older_text(n_more: int) -> str:
    """How many episodes are not shown, because no failure of their runs was diagnosed."""
    return f"{n_more} more of runs older than the diagnosis are left out"


def breakdown(table: "pd.DataFrame") -> "pd.DataFrame":
    """One row per suite and method: how many episodes failed, by case and sub-case.

    `n` episodes, `failed`, a column of counts for each case (`case 1`, ...) and sub-case
    (`case 1: drift`, ...), and `mean_confidence`. The cases of a row sum to `failed`; errors are in
    `n` alone. Where there are sub-goals, `sub-goal 1`, ... count the failures by the first that
    failed. A method that ran with several policies on a suite has a row for each, and is named with
    it.

    Raises: BadOutput when the table is older than the diagnosis.
    """
    episodes = _by_policy(diagnosed(table))
    if "case_confidence" not in episodes:  # no episode failed
        episodes = episodes.assign(case_confidence=float("nan"))
    failed = episodes["outcome"].eq("failure")
    flat = episodes[BY].assign(n=1, failed=failed.astype(int))
    for case, sub_cases in CASES.items():
        # Older versions gave some errors a case, too.
        of_case = failed & episodes["case"].eq(case)
        flat[case] = of_case.astype(int)
        for sub_case in sub_cases:
            both = of_case & episodes["sub_case"].eq(sub_case)
            flat[f"{case}: {sub_case}"] = both.astype(int)
    for number in _subgoals(episodes):
        failed_there = failed & episodes[SUBGOAL].eq(number)
        flat[f"sub-goal {number}"] = failed_there.astype(int)
    counts = flat.groupby(BY, sort=False).sum().reset_index()
    with_case = episodes[failed & episodes["case"].ne("")].groupby(BY, sort=False)
    confidence = with_case["case_confidence"].mean().rename("mean_confidence").reset_index()
    return counts.merge(confidence, on=BY, how="left")


def _by_policy(episodes: "pd.DataFrame") -> "pd.DataFrame":
    """The methods that ran with several policies on one suite named "METHOD, POLICY"."""
    if "policy" not in episodes:
        return episodes
    several = episodes.groupby(BY)["policy"].transform("nunique") > 1
    named = episodes["method"] + APART + episodes["policy"]
    return episodes.assign(method=episodes["method"].mask(several, named))


def _subgoals(episodes: "pd.DataFrame") -> list[int]:
    """The numbers of the sub-goals that failed somewhere."""
    if SUBGOAL not in episodes:
        return []
    failed = episodes.loc[episodes["outcome"].eq("failure"), SUBGOAL].dropna()
    return sorted({int(number) for number in failed})


def breakdown_rows(counts: "pd.DataFrame") -> list[list[str]]:
    """`breakdown` as text cells, cases that never occurred left out.

    Failures in percent of all episodes, cases in percent of failures, each with its 95 % Wilson
    interval.
    """
    cases: list[str] = []
    titles = []
    for case in CASES:
        if counts[case].any():
            cases.append(case)
            titles.append(f"{case} % of failures")
    for column in map(str, counts.columns):
        if column.startswith("sub-goal "):
            cases.append(column)
            titles.append(f"{column} % of failures")
    rows = [["suite", "method", "n", "fail % [95 %]", *titles, "confidence"]]
    for line in counts.to_dict("records"):
        n = int(line["n"])
        failed = int(line["failed"])
        failure_rate = rate(failed, n)
        cells = [str(line["suite"]), str(line["method"]), str(line["n"]), str(failure_rate)]
        for column in cases:
            share = rate(int(line[column]), failed)
            cells.append(str(share))
        confidence = line["mean_confidence"]
        cells.append("-" if confidence != confidence else f"{confidence:.2f}")
        rows.append(cells)
    return rows


def _sub_case_columns() -> list[str]:
    """The columns of a breakdown that count sub-cases."""
    columns = []
    for case, sub_cases in CASES.items():
        for sub_case in sub_cases:
            columns.append(f"{case}: {sub_case}")
    return columns


def sub_cases_table(counts: "pd.DataFrame") -> "pd.DataFrame":
    """One row per sub-case that occurred, by case; a column of counts per suite and method."""
    flat = counts.set_index(BY)[_sub_case_columns()].T
    table = flat[flat.sum(axis=1) > 0]
    table.index = table.index.str.split(": ", n=1, expand=True).set_names(["case", "sub-case"])
    return table


def sub_cases_text(counts: "pd.DataFrame") -> str:
    """How often each sub-case occurred, most frequent first, one line per suite and method."""
    lines = []
    for line in counts.to_dict("records"):
        occurred = []
        for name in _sub_case_columns():
            if line[name]:
                occurred.append((int(line[name]), name))
        occurred.sort(reverse=True)
        text = ", ".join(f"{n} x {name}" for n, name in occurred)
        lines.append(f"{line['suite']} {line['method']}: {text or 'no failure'}")
    return "\n".join(lines)


@value
class FunnelRow:
    """How many of `n` episodes are left after each of STAGES.

    None where a method has no such stage. `succeeded` counts every success, also one that failed
    an earlier stage. `bound` marks a method or policy that reads the simulator.
    """

    suite: str
    method: str
    n: int
    left: tuple[int | None, ...]
    succeeded: int
    bound: bool = False


type FunnelTable = list[FunnelRow]
"""A row per suite and method."""


def funnel_table(table: "pd.DataFrame") -> FunnelTable:
    """How many episodes are left after each stage.

    An episode counts up to the first stage that it does not pass. Methods that ran with several
    policies are named as in `breakdown`.

    Raises: BadOutput when the table is older than the diagnosis.
    """
    rows = []
    for (suite, method), part in _by_policy(diagnosed(table)).groupby(BY, sort=False):
        left: list[int | None] = []
        passing = part["outcome"].ne("error")
        for stage in STAGES:
            passed = part.get(f"stage_{stage}")
            if passed is None or passed.isna().all():
                left.append(None)
                continue
            passing &= passed.eq(True)
            left.append(int(passing.sum()))
        row = FunnelRow(
            suite=str(suite),
            method=str(method),
            n=len(part),
            left=tuple(left),
            succeeded=int(part["outcome"].eq("success").sum()),
            bound=bool(len(reads_simulator(part))),
        )
        rows.append(row)
    return rows
