"""The report over finished runs: Markdown, a page, tables as CSV, pictures."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.figures import write_png
from vap_core.base.files import write_atomic, writing
from vap_core.evaluation.metrics import RATES
from vap_core.evaluation.report import sections
from vap_core.evaluation.report.cells import outcome_rows, result_rows, track_title
from vap_core.evaluation.report.page import report_page
from vap_core.evaluation.report.pictures import differences_figure, forest_figure
from vap_core.evaluation.report.provenance import provenance
from vap_core.evaluation.report.results import comparisons, outcomes, paper_results, results
from vap_core.evaluation.report.runs import load_runs
from vap_core.evaluation.statistics import compare

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

COMPARISON_FILES = ("paired.png", "comparisons.csv")
"""What only a report that compares methods has."""


def report(sources: Sequence[Path], out: Path) -> str:
    """Write report.md and report.html, its tables as CSV, forest.png and paired.png.

    Returns report.md.

    `sources` are run folders or published tables. An unfinished run is reported as it is, and
    marked. Rates in the CSV tables are fractions, as the names of their columns say.

    Raises: BadOutput for a run that is damaged or an `out` that cannot be written.
    """
    runs = load_runs(sources)
    lines = results(runs)
    published = paper_results(runs)
    ends = outcomes(runs)
    origins = provenance(runs)
    compared = compare(runs.table, runs.methods)
    differences = comparisons(compared)
    parts = [
        "# Report",
        sections.opening_section(runs),
        sections.results_section(lines, published),
        sections.outcomes_section(runs, ends),
        sections.failures_section(runs),
        sections.comparisons_section(differences),
        sections.abstention_section(runs),
        sections.pictures_section(with_differences=bool(compared)),
        sections.provenance_section(origins),
    ]
    text = "\n\n".join(filter(None, parts))
    files = {
        "report.md": f"{text}\n",
        "results.csv": _csv_text(lines, fractions=_rate_columns()),
        "outcomes.csv": _csv_text(ends),
        "provenance.csv": _csv_text(origins),
    }
    figures = {"forest.png": forest_figure(lines)}
    files["report.html"] = report_page(
        table=runs.table,
        tables={
            "Results": _rows_by_track(lines),
            "Outcomes": {"": outcome_rows(ends)},
        },
        forest=figures["forest.png"],
        sources=sources,
        out=out,
    )
    if compared:
        files["comparisons.csv"] = _csv_text(differences, fractions=["difference", "low", "high"])
        against_first = [c for c in compared if c.one == compared[0].one]
        figures["paired.png"] = differences_figure(against_first)
    _write(out, files, figures)
    return text


def _rows_by_track(lines: "pd.DataFrame") -> dict[str, list[list[str]]]:
    """The rows of results of each suite and track, by its title."""
    rows = {}
    for (suite, split), part in lines.groupby(["suite", "split"], sort=False):
        rows[track_title(str(suite), str(split))] = result_rows(part, lines.iloc[:0])
    return rows


def _csv_text(table: "pd.DataFrame", fractions: Sequence[str] = ()) -> str:
    """A table as CSV; the names of columns that hold fractions end with "_fraction"."""
    names = {}
    for name in fractions:
        names[name] = f"{name}_fraction"
    return table.rename(columns=names).to_csv(index=False)


def _rate_columns() -> list[str]:
    """The columns of `results.results` that hold fractions."""
    columns = ["sr_layout_low", "sr_layout_high", "paper_sr", "paper_cmr"]
    for name in RATES:
        columns.append(name)
        columns += [f"{name}_low", f"{name}_high"]
    return columns


def _write(out: Path, files: dict[str, str], figures: "dict[str, Figure]") -> None:
    """Write a report, and remove the comparisons of an earlier one that this one has not."""
    with writing(out, "report", "choose another folder with --out"):
        out.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            write_atomic(out / name, content.encode())
        for name, figure in figures.items():
            write_png(figure, out / name)
        for name in COMPARISON_FILES:
            if name not in files and name not in figures:
                (out / name).unlink(missing_ok=True)
