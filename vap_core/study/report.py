"""The table at the end of a run, and the report over finished runs: Markdown, a page, pictures."""

import base64
import json
import os
from collections import Counter
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing, suppress
from html import escape
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from vap_core.base.errors import BadOutput, BadRecording, command
from vap_core.base.files import Rows, align, markdown, signed_interval, write_atomic, writing
from vap_core.base.pictures import METHODS, method_marks, write_png
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import extent_m, get_object
from vap_core.simulation.suites.rules import rejudge
from vap_core.simulation.types import EpisodeRow, Outcome, Truth
from vap_core.study import logs, paper
from vap_core.study.charts import differences_figure, forest_figure, funnel_figure, scores_table
from vap_core.study.failures import (
    DIAGNOSIS_COLUMNS,
    breakdown,
    breakdown_rows,
    diagnosed,
    funnel_table,
    older_text,
    sub_cases_text,
    why_other,
)
from vap_core.study.results import (
    Runs,
    comparisons,
    errors,
    load_runs,
    outcomes,
    paper_results,
    provenance,
    results,
    track_title,
)
from vap_core.study.stats import (
    RATES,
    RESAMPLES,
    TRACK,
    Score,
    abstention_rows,
    abstentions,
    compare,
    layout_names,
    rate,
    score,
    step_times,
)
from vap_core.study.store import key_of, read, read_manifest

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from vap_core.base.types import Rgb
    from vap_core.study.trials import Study

LISTED = {**suites.BENCHMARKS, **suites.SHARED}
"""The suites with a hashed list: benchmarks, and shared scenes."""
MATCHED = (
    "protocol-matched in MuJoCo: other physics, renderings and objects than SIMPLER's and "
    "VLABench's own."
)


def suites_table() -> str:
    """Benchmarks and shared scenes as their hashed lists hold them; the warm-up suites.

    Raises: BadSuite for a damaged list.
    """
    notes = "\n".join([MATCHED, *_development_lists(), *_warm_ups()])
    parts = [align(_track_rows()), align(_task_rows()), notes]
    return "\n\n".join(parts)


def _track_rows() -> list[list[str]]:
    rows = [
        ["suite", "robot", "cameras", "Hz", "control", "track", "episodes", "sha256 of the list"]
    ]
    for name, suite in LISTED.items():
        columns = [name, suite.robot, " ".join(suite.cameras), f"{suite.hz:g}", suite.control]
        digest = suites.lists.digest(name)[:12]
        tracks = Counter(row.split for row in suites.lists.read(name))
        for split, count in tracks.items():
            rows.append([*columns, split or "-", str(count), digest])
    return rows


def _task_rows() -> list[list[str]]:
    rows = [["suite", "task", "instruction", "success when", "max steps", "episodes"]]
    for name, suite in LISTED.items():
        for task in suite.tasks:
            listed = suites.rows(name, task.name)
            counts = Counter(row.split for row in listed).values()
            rows.append(
                [
                    name,
                    task.name,
                    task.instruction,
                    " and ".join(_rules(listed[0])),
                    str(task.max_steps),
                    " + ".join(map(str, counts)),
                ]
            )
    return rows


def _rules(row: EpisodeRow) -> list[str]:
    """The rule of every sub-goal in order."""
    return [row.at(stage).rule for stage in range(row.stages)]


def _development_lists() -> list[str]:
    counts = []
    for name in suites.BENCHMARKS:
        counts.append(f"{name}-dev {len(suites.benchmark(f'{name}-dev'))}")
    return [
        f"to tune on, other layouts and objects: {', '.join(counts)}",
        "with -absent after its name, a suite of these is the same without the target",
    ]


def _warm_ups() -> list[str]:
    lines = []
    for name, suite in suites.WARM_UPS.items():
        lines.append(
            f"warm-up {name}: {suite.robot}, {len(suite.tasks)} picks of "
            f"{suite.tasks[0].max_steps} steps, any number of episodes"
        )
    return lines


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


MOST_FAILURES = 24
"""Failures that have a picture; the others are counted."""
THUMBNAIL_PX = 150
STYLE = """
body{font:15px/1.45 system-ui,sans-serif;max-width:1080px;margin:24px auto;padding:0 16px;
color:#222;background:#fff}
table{border-collapse:collapse;margin:12px 0}td,th{padding:3px 10px;text-align:left;
border-bottom:1px solid #ddd;font-size:13px}th{border-bottom:2px solid #888}
img{max-width:100%}.failures{display:grid;grid-template-columns:repeat(auto-fill,minmax(320px,1fr));
gap:14px}.failures article{border:1px solid #ccc;border-radius:6px;padding:8px;font-size:13px}
.failures img{width:31%;margin-right:1%}code{background:#f2f2f2;padding:1px 4px;font-size:12px}
h3{font-size:14px;margin:6px 0 2px}.wide{overflow-x:auto}
"""


def report_page(
    table: "pd.DataFrame",
    tables: Mapping[str, Mapping[str, Rows]],
    forest: "Figure",
    sources: Sequence[Path],
    out: Path,
) -> str:
    """The page that stands in the folder `out`.

    `table` has one row per episode, `tables` the rows of the report's tables by section and title;
    `sources` are the runs, whose recordings give the pictures of failures.
    """
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'><title>Report</title>",
        f"<style>{STYLE}</style></head><body><h1>Report</h1>",
        f"<p>{escape(_summary(table))}</p>",
        _picture(forest, "success rates with 95 % intervals"),
    ]
    for section, by_title in tables.items():
        parts.append(f"<h2>{escape(section)}</h2>")
        for title, rows in by_title.items():
            if title:
                parts.append(f"<h3>{escape(title)}</h3>")
            parts.append(_html_table(rows))
    if set(DIAGNOSIS_COLUMNS) <= set(table.columns):
        parts.append("<h2>Where episodes are lost</h2>")
        parts.append(_picture(_funnel(table), "episodes that are left after each stage"))
        parts += _failures(table, sources, out)
    parts.append("</body></html>\n")
    return "\n".join(parts)


def _summary(table: "pd.DataFrame") -> str:
    n = len(table)
    won = int(table["outcome"].eq("success").sum())
    methods = ", ".join(dict.fromkeys(table["method"]))
    return f"{n} episodes, {won} of them successes; methods: {methods}."


def _funnel(table: "pd.DataFrame") -> "Figure":
    names = list(dict.fromkeys(table["method"]))
    colours = {name: colour for name, (colour, _) in method_marks(names).items()}
    known = [name for name in METHODS if name in colours]
    order = [*known, *(name for name in names if name not in known)]
    return funnel_figure(funnel_table(table), {name: colours[name] for name in order})


def _failures(table: "pd.DataFrame", sources: Sequence[Path], out: Path) -> list[str]:
    """A card per failure: its verdict, what the policy saw at the deciding frame, a link.

    Failures that were not diagnosed have none and are counted.
    """
    known = diagnosed(table)
    failed = known[known["outcome"].eq("failure")]
    order = ["suite", "case", "sub_case", "method", "task", "episode"]
    failed = failed.sort_values(order, kind="stable")
    rows = failed.to_dict("records")
    parts = [f"<h2>Failures ({len(rows)})</h2>"]
    older = int(table["outcome"].eq("failure").sum()) - len(rows)
    if older:
        parts.append(f"<p>{older_text(older)}.</p>")
    pictured: list[str] = []
    with closing(_recorded(rows, sources)) as recorded:
        for row, recording in islice(recorded, MOST_FAILURES):
            pictured.append(_card(row, recording, out))
    if pictured:
        parts.append(f"<div class='failures'>{''.join(pictured)}</div>")
    left = len(rows) - len(pictured)
    if left:
        parts.append(
            f"<p>{left} more without a picture here: <code>python -m vap_core diagnose RUN</code> "
            "lists all of them, and records what was not recorded.</p>"
        )
    return parts


def _recorded(
    rows: Sequence[Mapping[str, Any]], sources: Sequence[Path]
) -> Generator[tuple[Mapping[str, Any], Path]]:
    """Each episode that has a recording, and the first such.

    Files of runs of other policies have the same name; one that is damaged, unfinished or of
    another episode is none.
    """
    from vap_core.recording import read_summary, recording_file_name

    for row in rows:
        name = recording_file_name(
            row["suite"], row["task"], int(row["episode"]), int(row["seed"]), row["method"]
        )
        for source in sources:
            path = Path(source) / "recordings" / name
            with suppress(BadRecording):
                if path.is_file() and not why_other(read_summary(path), row):
                    yield row, path
                    break


def _card(row: Mapping[str, Any], recording: Path, out: Path) -> str:
    frame = max(0, int(row["deciding_frame"]))
    words = f"{row['case'].capitalize()} · {row['sub_case']}"
    about = f"{row['suite']} · {row['task']} · episode {row['episode']} · {row['method']}"
    link = quote(os.path.relpath(recording, out).replace(os.sep, "/"))
    images = []
    for camera, rgb in _views(recording, frame).items():
        images.append(f"<img alt='{escape(camera)}' title='{escape(camera)}' src='{_jpeg(rgb)}'>")
    look = command("view", recording, "--frame", str(frame))
    return (
        f"<article><h3>✗ {escape(words)}</h3><div>{escape(about)}</div>"
        f"<div>{''.join(images)}</div><p>{escape(str(row['case_sentence']))}</p>"
        f"<a href='{link}'>recording</a>, frame {frame}: <code>{escape(look)}</code></article>"
    )


def _views(recording: Path, frame: int) -> "dict[str, Rgb]":
    """What the policy saw last at a frame, by camera; nothing from a file that is damaged."""
    from vap_core.recording.read import prompted_entities, read_pictures

    try:
        entities = prompted_entities(recording)
        pictures = read_pictures(recording, set(entities.values()))
    except (BadRecording, RuntimeError, ValueError, OSError):
        return {}
    views = {}
    for camera, entity in entities.items():
        before = [step for step in pictures[entity] if step <= frame]
        if before:
            views[camera] = pictures[entity][max(before)]
    return views


def _jpeg(rgb: "Rgb") -> str:
    from PIL import Image

    image = Image.fromarray(rgb)
    image.thumbnail((THUMBNAIL_PX, THUMBNAIL_PX))
    data = BytesIO()
    image.save(data, "JPEG", quality=78)
    return f"data:image/jpeg;base64,{base64.b64encode(data.getvalue()).decode()}"


def _picture(figure: "Figure", words: str) -> str:
    data = BytesIO()
    figure.savefig(data, format="png", dpi=100, metadata={"Software": None})
    inside = base64.b64encode(data.getvalue()).decode()
    return f"<img alt='{escape(words)}' src='data:image/png;base64,{inside}'>"


def _html_table(rows: Rows) -> str:
    """The first row is the head."""
    lines = []
    for i, row in enumerate(rows):
        tag = "td" if i else "th"
        cells = "".join(f"<{tag}>{escape(str(cell))}</{tag}>" for cell in row)
        lines.append(f"<tr>{cells}</tr>")
    return f"<div class='wide'><table>{''.join(lines)}</table></div>"


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
        opening_section(runs),
        results_section(lines, published),
        outcomes_section(runs, ends),
        failures_section(runs),
        comparisons_section(differences),
        abstention_section(runs),
        pictures_section(with_differences=bool(compared)),
        provenance_section(origins),
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


def conclude(study: "Study", table: "pd.DataFrame", folder: Path) -> str:
    """Write `summary.json` and `figure.png` into the run's folder, and return the text to print.

    Raises: BadOutput.
    """
    scores = ordered(score(table), study.tasks, study.methods)
    summary = folder / "summary.json"
    figure = folder / "figure.png"
    lines = []
    for each in scores:
        lines.append({**each.to_json(), "seed": study.seed, "seeds": study.seeds})
    with writing(folder, "conclude"):
        write_atomic(summary, json.dumps(lines, indent=1).encode())
        write_png(forest_figure(scores_table(scores)), figure)
    text = [
        results_table(scores),
        *_totals(scores),
        *_layouts_note(study, table, folder),
        "",
        "time per control step, ms by part:",
        _times_table(scores, table),
        "",
        *_written(study, folder, f"wrote {summary}, {figure}"),
    ]
    if table["outcome"].eq("failure").any():
        text.append(f"why they failed: {study.next_command('diagnose', folder)}")
    text.append(f"tables, paired tests, a page: {study.next_command('report', folder)}")
    return "\n".join(text)


def results_table(scores: Sequence[Score]) -> str:
    """Aligned text; every rate with its 95 % Wilson interval."""
    rows = [
        [
            "suite",
            "task",
            "method",
            "policy",
            "n",
            "errors",
            "SR % [95 %]",
            "CMR % [95 %]",
            "wrong object % [95 %]",
        ]
    ]
    for each in scores:
        task = f"{each.task} ({each.split})" if each.split else each.task
        counts = [str(each.n), str(each.errors)]
        rates = [str(each.sr), str(each.cmr), str(each.wrong_object)]
        rows.append([each.suite, task, each.method, each.policy, *counts, *rates])
    return align(rows)


def ordered(
    scores: Sequence[Score], tasks: Sequence[Sequence[str]], methods: Sequence[str]
) -> list[Score]:
    """In the order in which a study names its tasks and methods."""
    places: dict[tuple[str, str], int] = {}
    for suite, task in tasks:
        places.setdefault((suite, task), len(places))

    def place(each: Score) -> tuple[int, int]:
        return places[each.suite, each.task], methods.index(each.method)

    return sorted(scores, key=place)


def _totals(scores: Sequence[Score]) -> list[str]:
    """Success over all tasks of a track per method, where there are several.

    Begins with an empty line.
    """
    by_track: dict[tuple[str, str, str], list[Score]] = {}
    for each in scores:
        by_track.setdefault((each.suite, each.split, each.method), []).append(each)
    lines = []
    for (suite, split, method), part in by_track.items():
        if len(part) == 1:
            continue
        k = n = 0
        for each in part:
            k += each.sr.k
            n += each.n
        total = rate(k, n)
        least = min(part, key=lambda each: each.sr.value)
        track = f"{suite} ({split})" if split else suite
        lines.append(
            f"{track} {method}: {total.k} of {total.n} succeed, SR {total}; least {least.task} "
            f"{least.sr}"
        )
    if lines:
        lines.insert(0, "")
    return lines


def _layouts_note(study: "Study", table: "pd.DataFrame", folder: Path) -> list[str]:
    """That the intervals above count episodes whose layouts return; nothing where none does."""
    placed = table[["split", "method"]].assign(layout=layout_names(table))
    if not placed.duplicated().any():
        return []
    layouts = placed["layout"].nunique()
    episodes = len(placed) // placed["method"].nunique()
    command = study.next_command("report", folder)
    return [
        "",
        f"{episodes} episodes a method on {layouts} layouts; for intervals over layouts: {command}",
    ]


def _times_table(scores: Sequence[Score], table: "pd.DataFrame") -> str:
    """Milliseconds of one control step by part, one row per suite and method."""
    times: dict[tuple[str, str], Mapping[str, float]] = {}
    for each in scores:
        episodes = table[(table["suite"] == each.suite) & (table["method"] == each.method)]
        times[each.suite, each.method] = step_times(episodes)
    parts: dict[str, None] = {}
    for times_ms in times.values():
        parts |= dict.fromkeys(times_ms)
    rows = [["suite", "method", *parts, "total"]]
    for (suite, method), times_ms in times.items():
        row = [suite, method]
        for part in parts:
            row.append(f"{times_ms.get(part, 0.0):.1f}")
        total_ms = sum(times_ms.values())
        rows.append([*row, f"{total_ms:.1f}"])
    return align(rows)


def _written(study: "Study", folder: Path, written: str) -> list[str]:
    """What was written, and how to look at a recording of a prompted episode."""
    recordings = sorted((folder / "recordings").glob("*.rrd"))
    if not recordings:
        return [written]
    size_mb = sum(path.stat().st_size for path in recordings) / 1e6
    return [
        f"{written}, {len(recordings)} recordings ({size_mb:.0f} MB) in {folder / 'recordings'}",
        f"look at one: {study.next_command('view', _example(recordings))}",
    ]


def _example(recordings: Sequence[Path]) -> Path:
    """The first recording of VAP, else the first of all."""
    for path in recordings:
        if ".vap." in path.name:
            return path
    return recordings[0]


RULED = (
    "success",
    "success_once",
    "held_steps",
    "cmr",
    "wrong_object",
    "first_object_correct",
    "steps",
)
"""The columns of a results table that the rules decide."""
Key = tuple[Any, ...]
NEEDED = {"lists", "tasks", "methods", "episodes", "seed", "seeds"}
"""What a run's configuration must hold."""


def rescore(folder: Path) -> str:
    """The table as the rules judge it now, and the episodes that are judged differently.

    Raises: BadOutput for a folder without results or configuration, or whose episode lists have
        changed since; BadSuite.
    """
    stored = _stored_episodes(folder)
    study = _checked_configuration(folder)
    rows = _rows_by_key(study)
    judged: list[dict[str, Any]] = []
    kept = dict(stored)
    changed = []
    for key, truths in logs.read_states(folder):
        if key not in stored or stored[key]["outcome"] == "error":
            continue
        suite, task, _, seed, episode = key
        outcome = _judge(rows[suite, task, seed, episode], truths)
        cells = {name: getattr(outcome, name) for name in RULED}
        judged.append({**stored[key], "outcome": outcome.status, **cells})
        del kept[key]
        if _differs(stored[key], cells):
            changed.append(" ".join(map(str, key)))
    scores = ordered(score([*judged, *kept.values()]), study["tasks"], study["methods"])
    verdict = f"{len(changed)} of {len(judged)} episodes judged differently"
    if changed:
        verdict += ": " + "; ".join(changed[:10])
    verdict += f"; {len(kept)} without a saved state or in error kept as they were."
    return f"{results_table(scores)}\n\n{verdict}"


def _stored_episodes(folder: Path) -> dict[Key, dict[Any, Any]]:
    """The rows of a run's table by their key (store.KEY)."""
    table = read(folder)
    if table.empty:
        raise BadOutput(
            f"rescore: {folder} holds no results; name the folder that eval or rollout wrote."
        )
    episodes: dict[Key, dict[Any, Any]] = {}
    for row in table.to_dict("records"):
        episodes[key_of(row)] = row
    return episodes


def _checked_configuration(folder: Path) -> dict[str, Any]:
    """The configuration of a run whose episode lists have not changed."""
    study = read_manifest(folder)["configuration"]
    if not study.keys() >= NEEDED:
        raise BadOutput(
            f"rescore: {folder} was written by an older version, without the hashes of its "
            "episode lists; run it again."
        )
    for suite in suites.changed_lists(study["lists"]):
        raise BadOutput(
            f"rescore: the list of {suite} has changed since {folder} was run; its states fit no "
            "row of today. Run it again."
        )
    return study


def _rows_by_key(study: Mapping[str, Any]) -> dict[Key, EpisodeRow]:
    """The rows of a study's episode lists by suite, task, seed and episode."""
    rows: dict[Key, EpisodeRow] = {}
    for suite, task in study["tasks"]:
        for row in suites.listed(
            suite,
            task,
            n=study["episodes"],
            seed=study["seed"],
            seeds=study["seeds"],
            own_target=study.get("object", ""),
            split=study.get("split", ""),
        ):
            rows[row.suite, row.task, row.seed, row.episode] = row
    return rows


def _judge(row: EpisodeRow, truths: list[Truth]) -> Outcome:
    sizes_m = {}
    for place in row.placements:
        sizes_m[place.model] = extent_m(get_object(place.model))
    return rejudge(row, sizes_m, truths).outcome()


def _differs(stored: Mapping[str, Any], cells: Mapping[str, Any]) -> bool:
    return any(stored[name] is not cell and stored[name] != cell for name, cell in cells.items())
