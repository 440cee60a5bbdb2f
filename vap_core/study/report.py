"""The table at the end of a run, and the report over finished runs: Markdown, a page, pictures."""

import base64
import json
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from vap_core.base.errors import BadOutput, BadRecording, command
from vap_core.base.files import write_atomic, writing
from vap_core.base.pictures import write_png
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import extent_m, get_object
from vap_core.simulation.suites.rules import rejudge
from vap_core.simulation.types import EpisodeRow, Outcome, Truth
from vap_core.study import charts, logs, paper
from vap_core.study.failures import (
    DIAGNOSIS_COLUMNS,
    breakdown,
    breakdown_table,
    diagnosed,
    funnel_table,
    older_text,
    sub_cases_text,
    why_other,
)
from vap_core.study.results import (
    Runs,
    errors,
    load_runs,
    outcomes,
    provenance,
    reads_simulator,
    results,
    track_title,
)
from vap_core.study.stats import (
    ALL_TASKS,
    RATES,
    RESAMPLES,
    TRACK,
    abstentions,
    compare,
    points_text,
    rate_of,
    score,
    step_times,
)
from vap_core.study.store import key_of, read, read_manifest
from vap_core.study.table import percent, percent_interval, printed

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
    import pandas as pd

    tracks, tasks = [], []
    for name, suite in LISTED.items():
        about = dict(suite=name, robot=suite.robot, cameras=" ".join(suite.cameras), Hz=suite.hz)
        about |= dict(control=suite.control)
        for split, count in Counter(row.split for row in suites.lists.read(name)).items():
            digest = {"sha256 of the list": suites.lists.digest(name)[:12]}
            tracks.append({**about, "track": split or "-", "episodes": count, **digest})
        for task in suite.tasks:
            listed = suites.rows(name, task.name)
            rules = " and ".join(listed[0].at(stage).rule for stage in range(listed[0].stages))
            counts = Counter(row.split for row in listed).values()
            line: dict[str, Any] = {"suite": name, "task": task.name}
            line["instruction"] = task.instruction
            line |= {"success when": rules, "max steps": task.max_steps}
            tasks.append({**line, "episodes": " + ".join(map(str, counts))})
    development = [
        f"{name}-dev {len(suites.benchmark(f'{name}-dev'))}" for name in suites.BENCHMARKS
    ]
    notes = [
        MATCHED,
        f"to tune on, other layouts and objects: {', '.join(development)}",
        "with -absent after its name, a suite of these is the same without the target",
    ]
    for name, suite in suites.WARM_UPS.items():
        notes.append(
            f"warm-up {name}: {suite.robot}, {len(suite.tasks)} picks of "
            f"{suite.tasks[0].max_steps} steps, any number of episodes"
        )
    return "\n\n".join([*map(printed, map(pd.DataFrame, (tracks, tasks))), "\n".join(notes)])


def rates_in(lines: "pd.DataFrame", name: str) -> list[str]:
    """A rate of `results` with its interval, in percent."""
    columns = (lines[f"{name}{part}"] for part in ("", "_low", "_high"))
    return list(map(percent_interval, *columns))


def result_table(lines: "pd.DataFrame") -> "pd.DataFrame":
    """Lines of `results.results` to print, with the paper's numbers where it has some."""
    n = lines["n"].astype(str) + " of " + lines["listed"].astype(str)
    seeds = " (" + lines["seeds"].astype(str) + " seeds)"
    table = lines[["task"]].assign(
        method=lines["method"] + lines["bound"].map({True: " (bound)", False: ""}),
        policy=lines["policy"],
        n=n + seeds.where(lines["seeds"] > 1, ""),
        layouts=lines["layouts"],
        errors=lines["errors"],
    )
    table["SR % [95 %]"] = rates_in(lines, "sr")
    if lines["sr_layout_low"].notna().any():
        ends = zip(lines["sr_layout_low"], lines["sr_layout_high"], strict=True)
        texts = [percent_interval(0.0, *each).removeprefix("0.0 ") for each in ends]
        table["over layouts"] = texts
    table["CMR % [95 %]"] = rates_in(lines, "cmr")
    table["wrong object % [95 %]"] = rates_in(lines, "wrong_object")
    if lines["paper_method"].notna().any():
        table["paper's row"] = lines["paper_method"]
        for name, column in {"paper SR": "paper_sr", "paper CMR": "paper_cmr"}.items():
            table[name] = lines[column].map(percent)
    return table


def outcome_table(ends: "pd.DataFrame") -> "pd.DataFrame":
    """How many episodes were asked for, and how they ended (`results.outcomes`), to print."""
    kept = ends.assign(
        **{
            name: ends[name].map(lambda n: "not kept" if n != n else f"{n:.0f}")
            for name in ("retried", "most_attempts")
        }
    )
    names = {"listed": "in the list", "asked": "asked for", "retried": "run more than once"}
    return kept.rename(columns={**names, "most_attempts": "most attempts"})


def comparison_table(compared: "pd.DataFrame") -> "pd.DataFrame":
    """Pairs of methods on the same episodes (`stats.compare`) to print."""
    table = compared[["task"]].assign(
        suite=list(map(track_title, compared["suite"], compared["split"])),
        method=compared["other"],
        against=compared["one"],
        policy=compared["policy"],
        pairs=compared["pairs"],
        layouts=compared["layouts"],
    )
    table["only it"], table["only the other"] = compared["only_other"], compared["only_one"]
    table["difference [95 %]"] = [
        "-" if line.low != line.low else points_text(line, digits=1)
        for line in compared.itertuples()
    ]
    for column, name in {"p_mcnemar": "p McNemar", "p": "p layouts", "p_holm": "p Holm"}.items():
        table[name] = compared[column].map(p_text)
    return table[["suite", *table.columns.drop("suite")]]


def p_text(p: float) -> str:
    """A p-value."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


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
    "`./vap diagnose` lists the failures and opens one at the frame that decided it; "
    "runs older than the diagnosis are left out."
)
ABSTENTION_NOTE = (
    "If the robot did not act where the vote's margin at t = 0, the least of all views, is below a "
    "threshold. The episodes without a target are those of NAME-absent."
)


def report(sources: Sequence[Path], out: Path) -> str:
    """Write report.md and report.html, its tables as CSV, forest.png and paired.png.

    Returns what a terminal shows (`summary`).

    `sources` are run folders or published tables. An unfinished run is reported as it is, and
    marked. Rates in the CSV tables are fractions, as the names of their columns say.

    Raises: BadOutput for a run that is damaged or an `out` that cannot be written.
    """
    runs = load_runs(sources)
    lines = results(runs)
    ends = outcomes(runs)
    origins = provenance(runs)
    compared = compare(runs.table, runs.methods)
    found = findings(lines, compared)
    rates = [f"{name}{part}" for name in RATES for part in ("", "_low", "_high")]
    rates += ["sr_layout_low", "sr_layout_high", "paper_sr", "paper_cmr"]
    figures = {"forest.png": forest(lines)}
    by_track = {
        track_title(str(suite), str(split)): result_table(part)
        for (suite, split), part in lines.groupby(TRACK, sort=False)
    }
    tables = {"Results": by_track, "Outcomes": {"": outcome_table(ends)}}
    text = "\n\n".join(["# Report", *_sections(runs, found, tables, compared, origins)])
    files = {
        "report.md": f"{text}\n",
        "results.csv": _csv(lines, rates),
        "outcomes.csv": _csv(ends),
        "provenance.csv": _csv(origins),
        "report.html": report_page(runs, found, tables, figures["forest.png"], sources, out),
    }
    if len(compared):
        files["comparisons.csv"] = _csv(compared, ["difference", "low", "high"])
        figures["paired.png"] = differences(compared[compared["one"] == compared["one"].iloc[0]])
    with writing(out, "report", "choose another folder with --out"):
        out.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            write_atomic(out / name, content.encode())
        for name, figure in figures.items():
            write_png(figure, out / name)
        for name in {"paired.png", "comparisons.csv"} - {*files, *figures}:  # of an earlier report
            (out / name).unlink(missing_ok=True)
    return summary(runs, found, lines)


MOST_FINDINGS, MOST_LINES = 5, 16
"""Lines of a summary: of its findings, and of all of it."""


def findings(lines: "pd.DataFrame", compared: "pd.DataFrame") -> list[str]:
    """For every track and policy how often the two best methods and the first one succeed, and by
    how much the best is above the first on the same episodes.
    """
    found = []
    by = [*TRACK, "policy"]
    for (suite, split, policy), part in lines.groupby(by, sort=False):
        # All tasks, where there are several; bounds are no results, unless nothing else ran.
        whole = part[
            part["task"].eq(part["task"].iloc[-1]) & (part["bound"] <= part["bound"].min())
        ]
        ranked = whole.sort_values("sr", ascending=False, kind="stable").to_dict("records")
        first = whole["method"].iloc[0]
        shown = [line for i, line in enumerate(ranked) if i < 2 or line["method"] == first]
        rates = [f"{line['method']} in {percent(line['sr'])} % of {line['n']}" for line in shown]
        rates[0] = rates[0].replace(" in ", " succeeds in ")
        text = f"{track_title(str(suite), str(split))}: {', '.join(rates)}"
        same = whole[[*by, "task", "method"]].rename(columns={"method": "one"}).head(1)
        pairs = compared.merge(same.assign(other=ranked[0]["method"]))
        for pair in pairs.itertuples():
            points = points_text(pair, digits=1)
            text += f"; {pair.other} - {pair.one}: {points} points, p {p_text(pair.p)}"
        found.append(f"{text} ({policy})")
    return found


def summary(runs: Runs, found: Sequence[str], lines: "pd.DataFrame") -> str:
    """At most MOST_LINES lines for a terminal: the findings, what is missing, why the best method
    of every suite failed, and the rates where there is room.
    """
    parts = list(found[:MOST_FINDINGS])
    if len(found) > MOST_FINDINGS:
        parts.append(f"and {len(found) - MOST_FINDINGS} more tracks: in the report")
    parts += [f"unfinished: {line}" for line in runs.unfinished[:2]]
    parts += [f"errors: {line}" for line in errors(runs)[:2]]
    if "case" in runs.table and runs.table["outcome"].eq("failure").any():
        counts = breakdown(runs.table.drop(reads_simulator(runs.table).index))
        best = counts.sort_values("failed", kind="stable").drop_duplicates("suite")
        parts += [f"failures of {line}"[:160] for line in sub_cases_text(best).splitlines()[:4]]
    table = result_table(lines)[["task", "method", "n", "SR % [95 %]", "CMR % [95 %]"]]
    if lines["suite"].nunique() > 1:
        table["task"] = lines["suite"] + " " + table["task"]
    room = MOST_LINES - 3 - len(parts)
    if len(table) > room:
        table = table[lines["task"].eq(ALL_TASKS)]
    return "\n".join([*parts, *(["", printed(table)] if 0 < len(table) <= room else [])])


def _sections(
    runs: Runs,
    found: Sequence[str],
    tables: "Mapping[str, Mapping[str, pd.DataFrame]]",
    compared: "pd.DataFrame",
    origins: "pd.DataFrame",
) -> Iterator[str]:
    """The paragraphs of report.md behind its title, as `report_page` shows `found` and `tables`."""
    several = "s" if len(runs.manifests) > 1 else ""
    asked = f"{runs.wanted['asked'].sum()} episodes that {len(runs.manifests)} run{several}"
    yield "\n".join(f"- {line}" for line in found)
    yield "\n".join(
        [
            f"{len(runs.table)} of the {asked} asked for.",
            *(f"**Unfinished**: {line}" for line in runs.unfinished),
            *(f"**Not alike**: {line}" for line in runs.unlike),
        ]
    )
    yield from ("## Results", RESULTS_NOTE)
    for title, shown in tables["Results"].items():
        yield from (f"### {title}", printed(shown, "markdown"))
        if title == "tabletop":
            yield paper.real_arm()
    yield from ("## Outcomes", printed(tables["Outcomes"][""], "markdown"))
    tracebacks = [f"- {line}" for line in errors(runs)]
    if tracebacks:
        yield "\n".join(["Errors, by the last line of their tracebacks:", *tracebacks])
    if "case" in runs.table:  # else the runs are older than the diagnosis
        counts = breakdown(runs.table)
        yield from ("## Why episodes failed", FAILURES_NOTE)
        yield printed(breakdown_table(counts), "markdown")
        yield "- " + sub_cases_text(counts).replace("\n", "\n- ")
    yield "## Methods compared"
    if len(compared):
        yield from (COMPARISONS_NOTE, printed(comparison_table(compared), "markdown"))
    else:
        yield "No two methods ran the same episodes under one policy."
    abstained = abstentions(runs.table)
    if len(abstained):  # a suite was run with and without its targets
        yield from ("## Abstention", ABSTENTION_NOTE, printed(abstained, "markdown"))
    yield from ("## Pictures", "![Success rates with 95 % intervals](forest.png)")
    if len(compared):
        yield "![Differences from the first method on the same episodes](paired.png)"
    yield "## Provenance"
    always, where_any = TOLD[:4], TOLD[4:]
    yield "\n".join(
        f"- {line['run']}: "
        + ", ".join(f"{n} {line[n]}" for n in (*always, *(n for n in where_any if line[n])))
        + f"\n  `{line['command']}`"
        for line in origins.to_dict("records")
    )


TOLD = ("digest", "version", "seed", "policy", "stack", "robots", "world", "weights", "lists")
"""What the report says of a run; but for the first four where it is known."""


def _csv(table: "pd.DataFrame", fractions: Sequence[str] = ()) -> str:
    """A table as CSV; the names of columns that hold fractions end with "_fraction"."""
    return printed(table.rename(columns={name: f"{name}_fraction" for name in fractions}), "csv")


def forest(lines: "pd.DataFrame") -> "Figure":
    """Success rates of every suite, track and task of `results`, a mark per method and policy;
    intervals are over layouts where layouts return.
    """
    shown = lines[lines["n"] > 0]
    shown = shown.assign(
        track=list(map(track_title, shown["suite"], shown["split"])),
        value=shown["sr"],
        low=shown["sr_layout_low"].fillna(shown["sr_low"]),
        high=shown["sr_layout_high"].fillna(shown["sr_high"]),
    )
    several = shown.groupby("suite")["policy"].nunique().max() > 1
    policy = "policy" if several else ""
    return charts.dots(shown, "task", group="track", series="method", policy=policy)


def differences(compared: "pd.DataFrame", line: str = "task") -> "Figure":
    """Differences of success on the same episodes with their 95 % cluster bootstrap, a mark per
    pair of methods, filled where Holm's p is below 0.05.
    """
    shown = compared.assign(
        track=list(map(track_title, compared["suite"], compared["split"])),
        value=compared["difference"],
        filled=compared["p_holm"] < 0.05,
    )
    if compared.groupby("suite")["policy"].nunique().max() > 1:
        shown["track"] += ", " + shown["policy"] + " policy"
    label = (
        f"points of success above {', '.join(dict.fromkeys(compared['one']))}, same episodes, "
        "95 % interval over layouts\nfilled: p < 0.05 after Holm's correction"
    )
    least = min(-25.0, 100 * float(compared["low"].min()) - 2)
    return charts.dots(
        shown, line, group="track", series="other", label=label, limits=(least, 104.0)
    )


MOST_PICTURED, MOST_CARDS = 24, 400
"""Failures that have pictures, and all that have a card; the others are counted."""
PICTURE_PX = 300
STYLE = """
body{font:15px/1.45 system-ui,sans-serif;max-width:1080px;margin:24px auto;padding:0 16px;
color:#222;background:#fff}
table{border-collapse:collapse;margin:12px 0}td,th{padding:3px 10px;text-align:left;
border-bottom:1px solid #ddd;font-size:13px}th{border-bottom:2px solid #888}
img{max-width:100%}.finding{font-size:19px}.failures article{border:1px solid #ccc;
border-radius:6px;padding:8px 12px;margin:10px 0;font-size:13px}.failures img{width:300px;
margin:4px 6px 0 0}code{background:#f2f2f2;padding:1px 4px;font-size:12px}
h3{font-size:15px;margin:6px 0 2px}.wide{overflow-x:auto}[hidden]{display:none}select{font:inherit}
"""
FILTER = """<script>
const choose=()=>document.querySelectorAll('article').forEach(card=>card.hidden=
[...document.querySelectorAll('select')].some(one=>one.value&&card.dataset[one.name]!==one.value));
</script>"""


def report_page(
    runs: Runs,
    found: Sequence[str],
    tables: "Mapping[str, Mapping[str, pd.DataFrame]]",
    forest: "Figure",
    sources: Sequence[Path],
    out: Path,
) -> str:
    """The page that stands in the folder `out`.

    `found` are the findings, `tables` the report's by section and title; `sources` are the runs,
    whose recordings give the pictures of failures.
    """
    table = runs.table
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'><title>Report</title>",
        f"<style>{STYLE}</style></head><body><h1>Report</h1>",
        *(f"<p class='finding'>{escape(line)}</p>" for line in found),
        *(f"<p><strong>Unfinished</strong>: {escape(line)}</p>" for line in runs.unfinished),
        _picture(forest, "success rates with 95 % intervals"),
    ]
    if set(DIAGNOSIS_COLUMNS) <= set(table.columns):
        parts += _failures(table, sources, out)
        parts.append("<h2>Where episodes are lost</h2>")
        funnel = charts.funnel(funnel_table(table))
        parts.append(_picture(funnel, "episodes that are left after each stage"))
    for section, by_title in tables.items():
        parts.append(f"<h2>{escape(section)}</h2>")
        for title, shown in by_title.items():
            parts += [f"<h3>{escape(title)}</h3>"] if title else []
            parts.append(f"<div class='wide'>{printed(shown, 'html')}</div>")
    return "\n".join([*parts, "</body></html>\n"])


def _failures(table: "pd.DataFrame", sources: Sequence[Path], out: Path) -> list[str]:
    """A card per failure, to be chosen by case and task.

    Failures that were not diagnosed have none and are counted.
    """
    known = diagnosed(table)
    order = ["suite", "case", "sub_case", "method", "task", "episode"]
    failed = known[known["outcome"].eq("failure")].sort_values(order, kind="stable")
    parts = [f"<h2>Failures ({len(failed)})</h2>"]
    older = int(table["outcome"].eq("failure").sum()) - len(failed)
    if older:
        parts.append(f"<p>{older_text(older)}.</p>")
    shown = failed.head(MOST_CARDS)
    for name in ("case", "task"):
        options = "".join(f"<option>{escape(each)}</option>" for each in shown[name].unique())
        choice = f"<option value=''>every {name}</option>{options}"
        parts.append(f"<select name='{name}' onchange='choose()'>{choice}</select>")
    from tqdm import tqdm

    cards: list[str] = []
    n_pictured = 0
    for row in tqdm(shown.to_dict("records"), "failures", delay=2.0, leave=False):
        path = _recorded(row, sources) if n_pictured < MOST_PICTURED else None
        n_pictured += path is not None
        cards.append(_card(row, path, sources, out))
    parts.append(f"{FILTER}<div class='failures'>{''.join(cards)}</div>")
    if len(failed) > len(shown):
        parts.append(f"<p>{len(failed) - len(shown)} more: ./vap diagnose RUN</p>")
    return parts


def _recorded(row: Mapping[str, Any], sources: Sequence[Path]) -> Path | None:
    """The first recording of an episode, None where it has none.

    Files of runs of other policies have the same name; one that is damaged, unfinished or of
    another episode is none.
    """
    from vap_core.recording import read_summary, recording_file_name

    name = recording_file_name(
        row["suite"], row["task"], int(row["episode"]), int(row["seed"]), row["method"]
    )
    for source in sources:
        path = Path(source) / "recordings" / name
        with suppress(BadRecording):
            if path.is_file() and not why_other(read_summary(path), row):
                return path
    return None


def _card(
    row: Mapping[str, Any], recording: Path | None, sources: Sequence[Path], out: Path
) -> str:
    """Why an episode failed, what the policy saw at the deciding frame, and how to open it."""
    frame = max(0, int(row["deciding_frame"]))
    case, task = str(row["case"]), str(row["task"])
    about = f"{row['suite']} · {task} · episode {row['episode']} · {row['method']}"
    why = re.sub(r"[\w-]+-lookalike-", "look-alike ", str(row["case_sentence"]))
    why = re.sub(r"[\w-]+-personal\b", "yours", why)
    shown = ""
    if recording is None:
        where = f"episode = {row['episode']} and seed = {row['seed']}"
        words = ["--suite", row["suite"], "--task", task, "--method", row["method"]]
        look = command("diagnose", *sources, *words, "--where", where, "--open", "0")
    else:
        link = quote(os.path.relpath(recording, out).replace(os.sep, "/"))
        try:
            for camera, rgb in _views(recording, frame).items():
                name = escape(camera)
                shown += f"<img alt='{name}' title='{name}' src='{_jpeg(rgb)}'>"
        except BaseException as error:  # decoders of a damaged file raise anything, or panic
            if isinstance(error, KeyboardInterrupt | SystemExit):
                raise
            shown = f"<em>its pictures cannot be read ({escape(type(error).__name__)})</em>"
        shown += f"<br><a href='{link}'>recording</a>, "
        look = command("view", recording, "--frame", str(frame))
    return (
        f"<article data-case='{escape(case)}' data-task='{escape(task)}'>"
        f"<h3>{escape(f'{case.capitalize()} · {row["sub_case"]}: {why}')}</h3>"
        f"<div>{escape(about)}</div><div>{shown}frame {frame}: <code>{escape(look)}</code></div>"
        "</article>"
    )


def _views(recording: Path, frame: int) -> "dict[str, Rgb]":
    """What the policy saw last at a frame, by camera."""
    from vap_core.recording.read import prompted_entities, read_pictures

    entities = prompted_entities(recording)
    pictures = read_pictures(recording, set(entities.values()))
    before = {
        camera: [step for step in pictures[entity] if step <= frame]
        for camera, entity in entities.items()
    }
    return {
        camera: pictures[entities[camera]][max(steps)] for camera, steps in before.items() if steps
    }


def _jpeg(rgb: "Rgb") -> str:
    from PIL import Image

    image = Image.fromarray(rgb)
    image.thumbnail((PICTURE_PX, PICTURE_PX))
    data = BytesIO()
    image.save(data, "JPEG", quality=78)
    return _inline("jpeg", data)


def _inline(kind: str, data: BytesIO) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data.getvalue()).decode()}"


def _picture(figure: "Figure", words: str) -> str:
    data = BytesIO()
    figure.savefig(data, format="png", dpi=100, metadata={"Software": None})
    return f"<img alt='{escape(words)}' src='{_inline('png', data)}'>"


def conclude(study: "Study", table: "pd.DataFrame", folder: Path) -> str:
    """Write `summary.json` and `figure.png` into the run's folder, and return the text to print.

    Raises: BadOutput.
    """
    scores = ordered(score(table), study.tasks, study.methods)
    summary_path, figure = folder / "summary.json", folder / "figure.png"
    lines = [
        {**to_json(line), "seed": study.seed, "seeds": study.seeds}
        for line in scores.to_dict("records")
    ]
    with writing(folder, "conclude"):
        write_atomic(summary_path, json.dumps(lines, indent=1).encode())
        nothing = dict.fromkeys(("sr_layout_low", "sr_layout_high"), float("nan"))
        write_png(forest(scores.assign(**nothing)), figure)
    runs = load_runs([folder])
    parts = {
        method: sum(step_times(part).values())
        for method, part in table.groupby("method", sort=False)
    }
    times = ", ".join(f"{method} {ms:.0f} ms" for method, ms in parts.items())
    rates = results(runs)
    text = [summary(runs, findings(rates, compare(runs.table, runs.methods)), rates)]
    text += ["", f"a control step takes: {times}", f"wrote {summary_path}, {figure}"]
    recordings = sorted((folder / "recordings").glob("*.rrd"))
    if recordings:
        prompted = next((path for path in recordings if ".vap." in path.name), recordings[0])
        text.append(f"look at one: {study.next_command('view', prompted)}")
    if table["outcome"].eq("failure").any():
        text.append(f"why they failed: {study.next_command('diagnose', folder)}")
    text.append(f"tables, paired tests, a page: {study.next_command('report', folder)}")
    return "\n".join(text)


def to_json(line: Mapping[Any, Any]) -> dict[str, Any]:
    """A line of `score` as summary.json has it."""
    kept = {name: line[name] for name in ("suite", "task", "split", "method", "policy")}
    rates = {name: rate_of(line, name) for name in RATES}
    values = {name: each.value if each.n else None for name, each in rates.items()}
    bounds = {name: [each.low, each.high] if each.n else None for name, each in rates.items()}
    counts = {"n": int(line["n"]), "errors": int(line["errors"])}
    return {**kept, **counts, **values, "intervals": bounds}


def results_table(scores: "pd.DataFrame") -> str:
    """Aligned text; every rate with its 95 % Wilson interval."""
    split = (" (" + scores["split"] + ")").where(scores["split"] != "", "")
    table = scores[["suite"]].assign(task=scores["task"] + split)
    table[["method", "policy", "n", "errors"]] = scores[["method", "policy", "n", "errors"]]
    for name, title in (("sr", "SR"), ("cmr", "CMR"), ("wrong_object", "wrong object")):
        table[f"{title} % [95 %]"] = [rate_of(line, name) for line in scores.to_dict("records")]
    return printed(table)


def ordered(
    scores: "pd.DataFrame", tasks: Sequence[Sequence[str]], methods: Sequence[str]
) -> "pd.DataFrame":
    """In the order in which a study names its tasks and methods."""
    places = list(dict.fromkeys(map(tuple, tasks)))
    names = list(zip(scores["suite"], scores["task"], strict=True))
    order = scores.assign(_task=list(map(places.index, names)))
    order["_method"] = scores["method"].map(list(methods).index)
    return scores.loc[order.sort_values(["_task", "_method"], kind="stable").index]


RULED = (
    *("success", "success_once", "held_steps", "cmr", "wrong_object", "first_object_correct"),
    "steps",
)
"""The columns of a results table that the rules decide."""
NEEDED = {"lists", "tasks", "methods", "episodes", "seed", "seeds"}
"""What a run's configuration must hold."""


def rescore(folder: Path) -> str:
    """The table as the rules judge it now, and the episodes that are judged differently.

    Raises: BadOutput for a folder without results or configuration, or whose episode lists have
        changed since; BadSuite.
    """
    table = read(folder)
    if table.empty:
        raise BadOutput(
            f"rescore: {folder} holds no results; name the folder that eval or rollout wrote."
        )
    stored = {key_of(row): row for row in table.to_dict("records")}
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
        before = kept.pop(key)
        judged.append({**before, "outcome": outcome.status, **cells})
        if any(before[name] is not cell and before[name] != cell for name, cell in cells.items()):
            changed.append(" ".join(map(str, key)))
    scores = ordered(score([*judged, *kept.values()]), study["tasks"], study["methods"])
    verdict = f"{len(changed)} of {len(judged)} episodes judged differently"
    if changed:
        verdict += ": " + "; ".join(changed[:10])
    verdict += f"; {len(kept)} without a saved state or in error kept as they were."
    return f"{results_table(scores)}\n\n{verdict}"


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


def _rows_by_key(study: Mapping[str, Any]) -> dict[tuple[Any, ...], EpisodeRow]:
    """The rows of a study's episode lists by suite, task, seed and episode."""
    more = {name: study[name] for name in ("seed", "seeds")} | {"n": study["episodes"]}
    more |= {"own_target": study.get("object", ""), "split": study.get("split", "")}
    listed = [row for suite, task in study["tasks"] for row in suites.listed(suite, task, **more)]
    return {(row.suite, row.task, row.seed, row.episode): row for row in listed}


def _judge(row: EpisodeRow, truths: list[Truth]) -> Outcome:
    sizes_m = {place.model: extent_m(get_object(place.model)) for place in row.placements}
    return rejudge(row, sizes_m, truths).outcome()
