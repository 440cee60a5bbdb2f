"""Our numbers in the shape of the paper's main tables, as LaTeX (booktabs), the paper's own below a rule."""

from typing import TYPE_CHECKING, Any

from vap_core import paper
from vap_core.report.text import escape

if TYPE_CHECKING:
    import pandas as pd


def main_tables(lines: "pd.DataFrame") -> str:
    """One tabular per suite and track: methods as rows, CMR and SR of every task as columns (`results.results`)."""
    told = paper.main_results()
    tables = ["% needs \\usepackage{booktabs}; intervals: Wilson, 95 %\n"]
    for (suite, split), part in lines.groupby(["suite", "split"], sort=False):
        tables.append(_table(part, told[(told["suite"] == suite) & (told["split"] == split)], f"{suite}{f', {split}' if split else ''}"))
    return "\n".join(tables)


def _table(part: "pd.DataFrame", told: "pd.DataFrame", title: str) -> str:
    tasks = list(dict.fromkeys(part["task"]))
    moved = {task: bool(part.loc[part["task"] == task, "cmr"].notna().any()) for task in tasks}  # a selection has no CMR
    widths = [3 if moved[task] else 2 for task in tasks]
    heads, rules, at = [], [], 2
    for task, width in zip(tasks, widths, strict=True):
        heads.append(rf"\multicolumn{{{width}}}{{c}}{{{escape(task)}}}")
        rules.append(rf"\cmidrule(lr){{{at}-{at + width - 1}}}")
        at += width
    columns = [name for task in tasks for name in ("$n$", *(["CMR (\\%)"] if moved[task] else []), "SR (\\%)")]
    policies = part["policy"].nunique() > 1
    body = []
    for (method, policy), ours in part.groupby(["method", "policy"], sort=False):
        cells = [escape(f"{method} ({policy})" if policies else str(method))]
        by_task = {line.task: line for line in ours.itertuples()}
        for task in tasks:
            line = by_task.get(task)
            of = "" if line is None else f"{line.n}/{line.listed}"
            cells += [of, *([_rate(line, "cmr")] if moved[task] else []), _rate(line, "sr")]
        body.append(" & ".join(cells) + r" \\")
    if len(told):
        body += [r"\midrule", rf"\multicolumn{{{sum(widths) + 1}}}{{c}}{{\textit{{The paper's own numbers: another world}}}} \\", r"\midrule"]
        for method, theirs in told.groupby("paper_method", sort=False):
            by_task = {line.task: line for line in theirs.itertuples()}
            cells = [escape(str(method))]
            for task in tasks:
                cells += ["", *([_plain(by_task.get(task), "cmr")] if moved[task] else []), _plain(by_task.get(task), "sr")]
            body.append(" & ".join(cells) + r" \\")
    top = [f"% {title}", rf"\begin{{tabular}}{{l{'c' * sum(widths)}}}", r"\toprule", f"Method & {' & '.join(heads)} " + r"\\", " ".join(rules)]
    return "\n".join([*top, f" & {' & '.join(columns)} " + r"\\", r"\midrule", *body, r"\bottomrule", r"\end{tabular}", ""])


def _rate(line: Any, name: str) -> str:
    if line is None or getattr(line, f"{name}_low") != getattr(line, f"{name}_low"):
        return "--"
    return rf"{getattr(line, name):.1f} {{\scriptsize [{getattr(line, f'{name}_low'):.1f}, {getattr(line, f'{name}_high'):.1f}]}}"


def _plain(line: Any, name: str) -> str:
    return "--" if line is None or getattr(line, name) != getattr(line, name) else f"{getattr(line, name):.1f}"
