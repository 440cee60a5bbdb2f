"""Our numbers in the shape of the paper's main tables, as LaTeX (booktabs).

The paper's own numbers stand below a rule.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.tables import escape
from vap_core.evaluation.metrics import TRACK
from vap_core.evaluation.report.cells import track_title

if TYPE_CHECKING:
    import pandas as pd

Measures = Mapping[str, tuple[str, ...]]
"""The rates that a task has a column for, by task: CMR where it is defined, and SR."""
PREAMBLE = """% needs \\usepackage{booktabs}
% 95 % intervals: of SR over layouts where they return, else Wilson's; of CMR Wilson's
% (bound): it reads the simulator
"""
ABOVE_PAPER = r"\textit{The paper's own numbers: another world}"
HEADS = {"cmr": "CMR (\\%)", "sr": "SR (\\%)"}


def main_tables(lines: "pd.DataFrame", published: "pd.DataFrame") -> str:
    """A tabular per suite and track: methods as rows, n, CMR and SR of every task as columns.

    A method or policy that reads the simulator is marked "(bound)". The interval of SR is over
    layouts where one returns, else Wilson's; that of CMR is Wilson's.

    `lines` are of `results.results`, `published` of `results.paper_results`.
    """
    tables = [PREAMBLE]
    for (suite, split), part in lines.groupby(TRACK, sort=False):
        of_track = (published["suite"] == suite) & (published["split"] == split)
        tables.append(_table(part, published[of_track], track_title(suite, split)))
    return "\n".join(tables)


def _table(lines: "pd.DataFrame", published: "pd.DataFrame", title: str) -> str:
    measures = _measures(lines)
    body = _our_rows(lines, measures)
    if len(published):
        width = 1
        for of_task in measures.values():
            width += 1 + len(of_task)
        body += [r"\midrule", rf"\multicolumn{{{width}}}{{c}}{{{ABOVE_PAPER}}} \\", r"\midrule"]
        body += _paper_rows(published, measures)
    return "\n".join([f"% {title}", *_head(measures), *body, r"\bottomrule", r"\end{tabular}", ""])


def _measures(lines: "pd.DataFrame") -> Measures:
    measures: dict[str, tuple[str, ...]] = {}
    for task, part in lines.groupby("task", sort=False):
        measures[str(task)] = ("sr",)
        if part["cmr"].notna().any():
            measures[str(task)] = ("cmr", "sr")
    return measures


def _head(measures: Measures) -> list[str]:
    """The tabular's beginning: tasks, and below each n and its rates."""
    tasks = []
    rules = []
    columns = []
    first = 2
    for task, of_task in measures.items():
        width = 1 + len(of_task)
        tasks.append(rf"\multicolumn{{{width}}}{{c}}{{{escape(task)}}}")
        rules.append(rf"\cmidrule(lr){{{first}-{first + width - 1}}}")
        columns.append("$n$")
        columns += [HEADS[name] for name in of_task]
        first += width
    return [
        rf"\begin{{tabular}}{{l{'c' * len(columns)}}}",
        r"\toprule",
        f"Method & {' & '.join(tasks)} " + r"\\",
        " ".join(rules),
        f" & {' & '.join(columns)} " + r"\\",
        r"\midrule",
    ]


def _our_rows(lines: "pd.DataFrame", measures: Measures) -> list[str]:
    several = lines["policy"].nunique() > 1
    rows = []
    for (method, policy), part in lines.groupby(["method", "policy"], sort=False):
        by_task = _lines_by_task(part)
        name = str(method)
        if several:
            name = f"{method} ({policy})"
        if part["bound"].any():
            name += " (bound)"
        cells = [escape(name)]
        for task, of_task in measures.items():
            line = by_task.get(task)
            if line is None:
                cells += ["", *["--"] * len(of_task)]
                continue
            cells.append(f"{line.n}/{line.listed}")
            for rate in of_task:
                cells.append(_rate_with_interval(line, rate))
        rows.append(_row(cells))
    return rows


def _paper_rows(published: "pd.DataFrame", measures: Measures) -> list[str]:
    rows = []
    for method, part in published.groupby("paper_method", sort=False):
        by_task = _lines_by_task(part)
        cells = [escape(str(method))]
        for task, of_task in measures.items():
            cells.append("")
            line = by_task.get(task)
            for rate in of_task:
                cells.append(_rate(getattr(line, rate, np.nan)))
        rows.append(_row(cells))
    return rows


def _lines_by_task(part: "pd.DataFrame") -> dict[str, Any]:
    lines = {}
    for line in part.itertuples():
        lines[line.task] = line
    return lines


def _row(cells: list[str]) -> str:
    return " & ".join(cells) + r" \\"


def _rate_with_interval(line: Any, name: str) -> str:
    low, high = getattr(line, f"{name}_low"), getattr(line, f"{name}_high")
    if name == "sr" and line.sr_layout_low == line.sr_layout_low:
        low, high = line.sr_layout_low, line.sr_layout_high
    if low != low:
        return "--"
    return rf"{100 * getattr(line, name):.1f} {{\scriptsize [{100 * low:.1f}, {100 * high:.1f}]}}"


def _rate(fraction: float) -> str:
    if fraction != fraction:
        return "--"
    return f"{100 * fraction:.1f}"
