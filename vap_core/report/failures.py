"""How failures divide: the paper's table of cases (P tab:error_case_breakdown), and the road on which episodes are lost."""

from typing import TYPE_CHECKING

from vap_core.errors import BadOutput
from vap_core.failures import CASES, STAGES
from vap_core.metrics import rate
from vap_core.values import value

if TYPE_CHECKING:
    import pandas as pd

BY = ["suite", "method"]


def diagnosed(table: "pd.DataFrame") -> "pd.DataFrame":
    """The episodes whose failures were diagnosed. Raises: BadOutput when the table is older than the diagnosis."""
    if "case" not in table:
        raise BadOutput("diagnose: this run was made before failures were diagnosed; run the same eval again in another folder.")
    return table[table["case"].notna()].astype({"deciding_frame": int})


def breakdown(table: "pd.DataFrame", by: tuple[str, ...] = ("suite", "method")) -> "pd.DataFrame":
    """One row per group: `n` episodes, `failed`, how many failures are of each case (`case 1`, ...) and sub-case (`case 1: drift`, ...), and `sure`,
    the mean confidence. The cases of a row sum to `failed`; errors are in `n` alone."""
    import pandas as pd

    whole = diagnosed(table)
    flat = whole[list(by)].assign(n=1, failed=whole["outcome"].eq("failure").astype(int))
    for case, parts in CASES.items():
        flat[case] = whole["case"].eq(case).astype(int)
        for part in parts:
            flat[f"{case}: {part}"] = (whole["case"].eq(case) & whole["sub_case"].eq(part)).astype(int)
    counted = flat.groupby(list(by), sort=False).sum().reset_index()
    sure = whole[whole["case"].ne("")].groupby(list(by), sort=False)["case_confidence"].mean().rename("sure").reset_index()
    return pd.DataFrame(counted.merge(sure, on=list(by), how="left"))


def breakdown_rows(counts: "pd.DataFrame") -> list[list[str]]:
    """To print: failures in percent of all episodes, cases in percent of failures, each with its 95 % Wilson interval."""
    cases = [case for case in CASES if counts[case].any()]
    rows = [["suite", "method", "n", "fail % [95 %]", *(f"{case} % of failures" for case in cases), "confidence"]]
    for line in counts.to_dict("records"):
        shares = [str(rate(int(line[case]), int(line["failed"]))) for case in cases]
        sure = "-" if line["sure"] != line["sure"] else f"{line['sure']:.2f}"
        rows.append([str(line["suite"]), str(line["method"]), str(line["n"]), str(rate(int(line["failed"]), int(line["n"]))), *shares, sure])
    return rows


def sub_cases_text(counts: "pd.DataFrame") -> str:
    """Every sub-case that occurred, how often, most frequent first, one line per suite and method."""
    names = [f"{case}: {part}" for case, parts in CASES.items() for part in parts]
    lines = []
    for line in counts.to_dict("records"):
        found = sorted(((int(line[name]), name) for name in names if line[name]), reverse=True)
        lines.append(f"{line['suite']} {line['method']}: " + (", ".join(f"{n} x {name}" for n, name in found) or "no failure"))
    return "\n".join(lines)


@value
class Road:
    """How many of `n` episodes are still on the road after each of STAGES; None where a method has no such stage."""

    suite: str
    method: str
    n: int
    left: tuple[int | None, ...]


def roads(table: "pd.DataFrame") -> list[Road]:
    """The stage funnel of every suite and method: an episode is counted up to the first stage that it does not pass."""
    found = []
    for (suite, method), part in diagnosed(table).groupby(BY, sort=False):
        left: list[int | None] = []
        on = part["outcome"].ne("error")
        for name in STAGES:
            passed = part[f"stage_{name}"]
            if passed.isna().all():
                left.append(None)
                continue
            on &= passed.eq(True)
            left.append(int(on.sum()))
        found.append(Road(str(suite), str(method), len(part), tuple(left)))
    return found
