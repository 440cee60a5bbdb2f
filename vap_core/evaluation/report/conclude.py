"""The end of a run: a table, the time of a step by part, summary.json and one figure."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.figures import write_png
from vap_core.base.files import write_atomic, writing
from vap_core.base.tables import align
from vap_core.evaluation.layouts import layout_names
from vap_core.evaluation.metrics import Score, rate, score, step_times
from vap_core.evaluation.report.pictures import forest_figure, scores_table

if TYPE_CHECKING:
    import pandas as pd

    from vap_core.evaluation.study import Study


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
