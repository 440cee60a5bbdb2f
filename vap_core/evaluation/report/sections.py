"""The sections of a report as Markdown."""

from typing import TYPE_CHECKING

from vap_core.base.tables import markdown
from vap_core.evaluation import paper
from vap_core.evaluation.abstention import abstention_rows, abstentions
from vap_core.evaluation.metrics import TRACK
from vap_core.evaluation.report.cells import (
    comparison_rows,
    outcome_rows,
    result_rows,
    track_title,
)
from vap_core.evaluation.report.failures import breakdown, breakdown_rows, sub_cases_text
from vap_core.evaluation.report.results import errors
from vap_core.evaluation.report.runs import Runs
from vap_core.evaluation.statistics import RESAMPLES

if TYPE_CHECKING:
    import pandas as pd

RESULTS_NOTE = (
    "- n: episodes that were run, of those in the suite's whole list; all tasks: of the whole "
    "lists of every task that any method here was asked for.\n"
    "  An error is no success and stays in n; an episode that was not run is not in n.\n"
    "- SR, CMR, wrong object: % of n with Wilson's 95 % interval. CMR is not "
    "defined for selections, where a touch counts as a wrong object, too.\n"
    "- (bound): the method or the policy reads the simulator; it bounds what results can be, and "
    "is none.\n"
    "- over layouts: 95 % interval of SR with the starting layouts drawn again (bootstrap), where "
    "layouts were run under several seeds or looks;\n"
    "  Wilson's takes every episode for independent and is too narrow there.\n"
    f"- paper's row, SR and CMR: {paper.OTHER_WORLD}"
)
COMPARISONS_NOTE = (
    "Pairs are the same episodes (suite, task, split, variant, episode, seed, policy) under two "
    "methods; an error is no success.\n"
    "- difference: SR of the method minus SR of the one it is compared with, in points; 95 % "
    f"interval by {RESAMPLES} bootstrap samples of whole layouts.\n"
    "  In simulations it covers 94 to 96 % from 40 layouts on, 90 to 94 % at 10 to 24, and about "
    "90 % where fewer than ten layouts differ; with so few go by p.\n"
    "- p McNemar: exact, every pair on its own. p layouts: the same where no layout returns; else "
    "exact, too, with whole layouts changing sign.\n"
    "- p Holm: p layouts, corrected for a suite's comparisons with one policy: those of its single "
    "tasks, and apart from them those of all tasks together."
)
FAILURES_NOTE = (
    "Case 1: all views are prompted alike, and wrong. Case 2: views are prompted with different "
    "instances. Case 3: the prompt is right, the\n"
    "manipulation fails. Unprompted: the method highlights nothing. Confidence: the share of "
    "neighbouring thresholds under which a label stays the same.\n"
    "`python -m vap_core diagnose` lists the failures and opens one at the frame that decided it; "
    "runs older than the diagnosis are left out."
)

ABSTENTION_NOTE = (
    "If the robot did not act where the vote's margin at t = 0, the least of all views, is below a "
    "threshold. The episodes without a target are those of NAME-absent."
)


def opening_section(runs: Runs) -> str:
    """How many episodes there are, which runs are unfinished, and in what they differ."""
    several = "s" if len(runs.manifests) > 1 else ""
    lines = [
        f"{len(runs.table)} of the {runs.wanted['asked'].sum()} episodes that "
        f"{len(runs.manifests)} run{several} asked for."
    ]
    lines += [f"**Unfinished**: {line}" for line in runs.unfinished]
    lines += [f"**Not alike**: {line}" for line in runs.unlike]
    return "\n".join(lines)


def results_section(lines: "pd.DataFrame", published: "pd.DataFrame") -> str:
    """A table per track, and footnotes to the paper's numbers per suite.

    `published` is of `results.paper_results`.

    Raises: BadOutput, as `paper.ledger`.
    """
    parts = ["## Results", RESULTS_NOTE]
    for suite, of_suite in lines.groupby("suite", sort=False):
        for (_, split), part in of_suite.groupby(TRACK, sort=False):
            of_track = (published["suite"] == suite) & (published["split"] == split)
            parts.append(f"### {track_title(str(suite), str(split))}")
            rows = result_rows(part, published[of_track])
            parts.append(markdown(rows))
        notes = paper.footnotes(str(suite))
        if suite == "tabletop":
            notes = [paper.real_arm(), *notes]
        if notes:
            numbered = []
            for i, note in enumerate(notes, 1):
                numbered.append(f"{i}. {note}")
            parts.append("Footnotes to the paper's numbers:\n\n" + "\n".join(numbered))
    return "\n\n".join(parts)


def outcomes_section(runs: Runs, ends: "pd.DataFrame") -> str:
    parts = ["## Outcomes", markdown(outcome_rows(ends))]
    lines = errors(runs)
    if lines:
        listed = "\n".join(f"- {line}" for line in lines)
        parts.append(f"Errors, by the last line of their tracebacks:\n{listed}")
    return "\n\n".join(parts)


def failures_section(runs: Runs) -> str:
    """How the failures divide into cases; empty for runs that are older than the diagnosis."""
    if "case" not in runs.table:
        return ""
    counts = breakdown(runs.table)
    sub_cases = "- " + sub_cases_text(counts).replace("\n", "\n- ")
    parts = ["## Why episodes failed", FAILURES_NOTE, markdown(breakdown_rows(counts)), sub_cases]
    return "\n\n".join(parts)


def comparisons_section(compared: "pd.DataFrame") -> str:
    title = "## Methods compared"
    if compared.empty:
        return f"{title}\n\nNo two methods ran the same episodes under one policy."
    return "\n\n".join([title, COMPARISONS_NOTE, markdown(comparison_rows(compared))])


def pictures_section(with_differences: bool) -> str:
    parts = ["## Pictures", "![Success rates with 95 % intervals](forest.png)"]
    if with_differences:
        parts.append("![Differences from the first method on the same episodes](paired.png)")
    return "\n\n".join(parts)


def provenance_section(origins: "pd.DataFrame") -> str:
    """A line per run (`provenance.provenance`), and its command."""
    lines = []
    for line in origins.to_dict("records"):
        parts = []
        for name in ("digest", "version", "seed", "policy"):
            parts.append(f"{name} {line[name]}")
        for name in ("stack", "robots", "world", "weights", "lists"):
            if line[name]:
                parts.append(f"{name} {line[name]}")
        lines.append(f"- {line['run']}: {', '.join(parts)}\n  `{line['command']}`")
    return "## Provenance\n\n" + "\n".join(lines)


def abstention_section(runs: Runs) -> str:
    """Success against coverage; empty where no suite was run with and without its targets."""
    found = abstentions(runs.table)
    if not found:
        return ""
    return f"## Abstention\n\n{ABSTENTION_NOTE}\n\n{markdown(abstention_rows(found))}"
