"""The tables of a report as rows of text cells, header first; fractions are printed as percent."""

from typing import TYPE_CHECKING, Any

from vap_core.base.tables import signed_interval

if TYPE_CHECKING:
    import pandas as pd

Row = list[str]


def result_rows(lines: "pd.DataFrame", published: "pd.DataFrame") -> list[Row]:
    """The results of one track, a block per task with methods as rows.

    `lines` are of `results.results`, `published` of `paper.main_results`. The paper's methods that
    were not run stand below ours.
    """
    with_layouts = bool(lines["sr_layout_low"].notna().any())
    with_paper = len(published) > 0
    rows = [_result_head(with_layouts, with_paper)]
    for task in dict.fromkeys(lines["task"]):
        ours = lines[lines["task"] == task]
        for line in ours.itertuples():
            rows.append(_result_cells(line, with_layouts, with_paper))
        theirs = published[published["task"] == task]
        for line in theirs[~theirs["method"].isin(ours["method"])].itertuples():
            blank = ["-"] * (len(rows[0]) - 4)
            rows.append([task, *blank, line.paper_method, percent(line.sr), percent(line.cmr)])
    return rows


def outcome_rows(ends: "pd.DataFrame") -> list[Row]:
    """How many episodes were asked for, and how they ended (`results.outcomes`)."""
    rows = [
        [
            "suite",
            "method",
            "policy",
            "in the list",
            "asked for",
            "run",
            "success",
            "failure",
            "error",
            "run more than once",
            "most attempts",
        ]
    ]
    for line in ends.itertuples():
        counts = (line.listed, line.asked, line.run, line.success, line.failure, line.error)
        attempts = [_attempts(line.retried), _attempts(line.most_attempts)]
        rows.append([line.suite, line.method, line.policy, *map(str, counts), *attempts])
    return rows


def comparison_rows(compared: "pd.DataFrame") -> list[Row]:
    """Pairs of methods on the same episodes (`results.comparisons`)."""
    rows = [
        [
            "suite",
            "task",
            "method",
            "against",
            "policy",
            "pairs",
            "layouts",
            "only it",
            "only the other",
            "difference [95 %]",
            "p McNemar",
            "p layouts",
            "p Holm",
        ]
    ]
    for line in compared.itertuples():
        track = track_title(line.suite, line.split)
        counts = (line.pairs, line.layouts, line.only_other, line.only_one)
        rows.append(
            [
                *(track, line.task, line.other, line.one, line.policy),
                *map(str, counts),
                _difference(line),
                *(_p_value(line.p_mcnemar), _p_value(line.p), _p_value(line.p_holm)),
            ]
        )
    return rows


def track_title(suite: str, split: str) -> str:
    """A suite, and its split where it has several."""
    if not split:
        return suite
    return f"{suite}, {split}"


def percent(fraction: float) -> str:
    """A fraction as percent without the sign, "-" where it is not defined."""
    if fraction != fraction:
        return "-"
    return f"{100 * fraction:.1f}"


def percent_interval(middle: float, low: float, high: float) -> str:
    """A fraction and its interval as percent without the sign, "-" where it is not defined."""
    if low != low:
        return "-"
    return f"{100 * middle:.1f} {_interval(low, high)}"


def _result_head(with_layouts: bool, with_paper: bool) -> Row:
    head = ["task", "method", "policy", "n", "layouts", "errors", "SR % [95 %]"]
    if with_layouts:
        head.append("over layouts")
    head += ["CMR % [95 %]", "wrong object % [95 %]"]
    if with_paper:
        head += ["paper's row", "paper SR", "paper CMR"]
    return head


def _result_cells(line: Any, with_layouts: bool, with_paper: bool) -> Row:
    method = line.method
    n = f"{line.n} of {line.listed}"
    if line.bound:
        method += " (bound)"
    if line.seeds > 1:
        n += f" ({line.seeds} seeds)"
    cells = [line.task, method, line.policy, n, str(line.layouts), str(line.errors)]
    cells.append(percent_interval(line.sr, line.sr_low, line.sr_high))
    if with_layouts:
        cells.append(_interval(line.sr_layout_low, line.sr_layout_high))
    cells.append(percent_interval(line.cmr, line.cmr_low, line.cmr_high))
    cells.append(percent_interval(line.wrong_object, line.wrong_object_low, line.wrong_object_high))
    if with_paper and isinstance(line.paper_method, str):
        cells += [line.paper_method, percent(line.paper_sr), percent(line.paper_cmr)]
    elif with_paper:
        cells += ["-", "-", "-"]
    return cells


def _interval(low: float, high: float) -> str:
    if low != low:
        return "-"
    return f"[{100 * low:.1f}, {100 * high:.1f}]"


def _difference(line: Any) -> str:
    """The points between two methods, "-" where they are not defined."""
    if line.low != line.low:
        return "-"
    return signed_interval(100 * line.difference, 100 * line.low, 100 * line.high, digits=1)


def _attempts(count: float) -> str:
    if count != count:
        return "not kept"
    return f"{count:.0f}"


def _p_value(p: float) -> str:
    if p < 0.001:
        return "< 0.001"
    return f"{p:.3f}"
