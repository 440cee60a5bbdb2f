"""The report over finished runs: Markdown to read and print, CSV and LaTeX tables, two pictures."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core import paper
from vap_core.errors import BadOutput
from vap_core.files import write_atomic
from vap_core.plots import write_png
from vap_core.report import results as tables
from vap_core.report.failures import breakdown, breakdown_rows, sub_cases_text
from vap_core.report.latex import main_tables
from vap_core.report.pictures import differences_figure, forest_figure
from vap_core.report.runs import Runs, load
from vap_core.report.text import latex, markdown
from vap_core.statistics import RESAMPLES, compare

if TYPE_CHECKING:
    import pandas as pd

READING = """- n: episodes that were run, of those in the suite's whole list; all tasks: their episodes together.
  An error is no success and stays in n; an episode that was not run is not in n.
- SR, CMR, wrong object: % of n with Wilson's 95 % interval (results.csv has Clopper and Pearson's, too). CMR is not defined for selections.
- (bound): the method or the policy reads the simulator; it bounds what results can be, and is none.
- over layouts: 95 % interval of SR with the starting layouts drawn again (bootstrap), where layouts were run under several seeds or looks;
  Wilson's takes every episode for independent and is too narrow there.
- paper's row, SR and CMR: {world}"""
COMPARED = """Pairs are the same episodes (suite, task, split, variant, episode, seed, policy) under two methods; an error is no success.
- difference: SR of the method minus SR of the one it is compared with, in points; 95 % interval by {resamples} bootstrap samples of whole layouts.
  In simulations it covers 94 to 96 % from 40 layouts on, 90 to 94 % at 10 to 24; with so few go by p.
- p McNemar: exact, every pair on its own. p layouts: the same where no layout returns; else exact, too, with whole layouts changing sign.
- p Holm: p layouts, corrected for all comparisons of single tasks, and apart from them for those of all tasks together."""

FAILED = """Case 1: all views are prompted alike, and wrong. Case 2: views are prompted with different instances. Case 3: the prompt is right, the
hand fails. Unprompted: the method highlights nothing. Confidence: the share of neighbouring thresholds under which a label stays the same.
`python -m vap_core diagnose` lists the failures and opens one at the frame that decided it; runs older than the diagnosis are left out."""


def report(folders: Sequence[Path], out: Path) -> str:
    """Write report.md, results, comparisons, outcomes and provenance as CSV and LaTeX, forest.png and paired.png into `out`; returns report.md.

    An unfinished run is reported as it is, and said so. Raises: BadOutput for a run that is damaged or an `out` that cannot be written.
    """
    runs = load(folders)
    lines, compared = tables.results(runs), compare(runs.table, runs.methods)
    found, ends, made = tables.comparisons(compared), tables.outcomes(runs), tables.provenance(runs)
    many = bool(compared)
    parts = [_opening(runs), *_results(lines), *_outcomes(runs, ends), *_failures(runs), *_compared(found), _pictures(many), *_provenance(made)]
    text = "\n\n".join(["# Report", *parts])
    files = {"report.md": text + "\n", "results.tex": main_tables(lines), "outcomes.tex": latex(_outcome_rows(ends))}
    files |= {f"{name}.csv": table.to_csv(index=False) for name, table in (("results", lines), ("outcomes", ends), ("provenance", made))}
    if many:
        files |= {"comparisons.csv": found.to_csv(index=False), "comparisons.tex": latex(_compared_rows(found))}
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            write_atomic(out / name, content.encode())
        write_png(forest_figure(lines), out / "forest.png")
        if many:
            write_png(differences_figure([c for c in compared if c.one == compared[0].one]), out / "paired.png")
        else:
            for name in ("paired.png", "comparisons.csv", "comparisons.tex"):  # of another report
                (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise BadOutput(f"report: {out} cannot be written ({error.strerror}); choose another folder with --out.") from error
    return text


def _opening(runs: Runs) -> str:
    counts = f"{len(runs.table)} of the {runs.wanted['asked'].sum()} episodes that {len(runs.notes)} run{'s' * (len(runs.notes) > 1)} asked for."
    return "\n".join([counts, *(f"**Unfinished**: {line}" for line in runs.unfinished)])


def _results(lines: "pd.DataFrame") -> list[str]:
    parts = ["## Results", READING.format(world=paper.OTHER_WORLD)]
    for suite, tracks in lines.groupby("suite", sort=False):
        for split, part in tracks.groupby("split", sort=False):
            parts += [f"### {suite}{f', {split}' if split else ''}", markdown(_result_rows(part, str(suite), str(split)))]
        notes = [*([paper.real_arm()] if suite == "tabletop" else []), *paper.oddities(str(suite))]
        parts += ["Footnotes to the paper's numbers:\n\n" + "\n".join(f"{i}. {note}" for i, note in enumerate(notes, 1))] if notes else []
    return parts


def _result_rows(part: "pd.DataFrame", suite: str, split: str) -> list[list[str]]:
    """Blocks of one task each, methods as rows; what the paper has and we have not stands below ours."""
    beside = (told := paper.main_results())[(told["suite"] == suite) & (told["split"] == split)]
    over = part["sr_layout_low"].notna().any()
    head = ["task", "method", "policy", "n", "layouts", "errors", "SR % [95 %]", *(["over layouts"] if over else []), "CMR % [95 %]"]
    rows = [[*head, "wrong object % [95 %]", *(["paper's row", "paper SR", "paper CMR"] if len(beside) else [])]]
    for task in dict.fromkeys(part["task"]):
        ours, theirs = part[part["task"] == task], beside[beside["task"] == task]
        for line in ours.itertuples():
            seeds = f" ({line.seeds} seeds)" if line.seeds > 1 else ""
            cells = [line.task, f"{line.method} (bound)" if line.bound else line.method, line.policy, f"{line.n} of {line.listed}{seeds}"]
            cells += [str(line.layouts), str(line.errors), percent(line.sr, line.sr_low, line.sr_high)]
            cells += [percent(line.sr, line.sr_layout_low, line.sr_layout_high).partition(" ")[2] or "-"] if over else []
            cells += [percent(line.cmr, line.cmr_low, line.cmr_high), percent(line.wrong_object, line.wrong_object_low, line.wrong_object_high)]
            told_here = [str(line.paper_method), _one(line.paper_sr), _one(line.paper_cmr)] if isinstance(line.paper_method, str) else ["-"] * 3
            rows.append([*cells, *(told_here if len(beside) else [])])
        for line in theirs[~theirs["method"].isin(ours["method"])].itertuples():
            rows.append([task, *["-"] * (len(rows[0]) - 4), line.paper_method, _one(line.sr), _one(line.cmr)])
    return rows


def _outcomes(runs: Runs, ends: "pd.DataFrame") -> list[str]:
    parts = ["## Outcomes", markdown(_outcome_rows(ends))]
    told = tables.errors(runs)
    return [*parts, "Errors, by the last line of their tracebacks:\n" + "\n".join(f"- {line}" for line in told)] if told else parts


def _outcome_rows(ends: "pd.DataFrame") -> list[list[str]]:
    head = ["suite", "method", "policy", "in the list", "asked for", "run", "success", "failure", "error", "run more than once", "most attempts"]
    return [head] + [
        [line.suite, line.method, line.policy, *map(str, (line.listed, line.asked, line.run, line.success, line.failure, line.error)),
         *("not kept" if cell != cell else f"{cell:.0f}" for cell in (line.retried, line.most_attempts))]
        for line in ends.itertuples()
    ]  # fmt: skip


def _failures(runs: Runs) -> list[str]:
    if "case" not in runs.table:
        return []
    counts = breakdown(runs.table)
    told = "\n".join(f"- {line}" for line in sub_cases_text(counts).splitlines())
    return ["## Why episodes failed", FAILED, markdown(breakdown_rows(counts)), told]


def _compared(found: "pd.DataFrame") -> list[str]:
    if found.empty:
        return ["## Methods compared", "No two methods ran the same episodes under one policy."]
    return ["## Methods compared", COMPARED.format(resamples=RESAMPLES), markdown(_compared_rows(found))]


def _compared_rows(found: "pd.DataFrame") -> list[list[str]]:
    head = ["suite", "task", "method", "against", "policy", "pairs", "layouts", "only it", "only the other", "difference [95 %]"]
    rows = [[*head, "p McNemar", "p layouts", "p Holm"]]
    for line in found.itertuples():
        about = [f"{line.suite}, {line.split}" if line.split else line.suite, line.task, line.other, line.one, line.policy]
        counts = [str(n) for n in (line.pairs, line.layouts, line.only_other, line.only_one)]
        rows.append([*about, *counts, percent(line.difference, line.low, line.high, "+"), *map(_p, (line.p_mcnemar, line.p, line.p_holm))])
    return rows


def _pictures(many: bool) -> str:
    shown = ["## Pictures", "![Success rates with 95 % intervals](forest.png)"]
    return "\n\n".join([*shown, "![Differences from the first method on the same episodes](paired.png)"] if many else shown)


def _provenance(made: "pd.DataFrame") -> list[str]:
    lines = []
    for line in made.itertuples():
        about = [f"digest {line.digest}", f"version {line.version}", f"seed {line.seed}", f"policy {line.policy}"]
        about += [f"{name} {cell}" for name in ("stack", "robots", "world", "weights", "lists") if (cell := getattr(line, name))]
        lines.append(f"- {line.run}: {', '.join(about)}\n  `{line.command}`")
    return ["## Provenance", "\n".join(lines)]


def percent(middle: float, low: float, high: float, sign: str = "") -> str:
    """A percentage with its interval, "-" where it is not defined."""
    return "-" if low != low else f"{middle:{sign}.1f} [{low:{sign}.1f}, {high:{sign}.1f}]"


def _one(number: float) -> str:
    return "-" if number != number else f"{number:.1f}"


def _p(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"
