"""What a finished run says: the table, the time of a step by part, summary.json and one figure."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.experiments import Study
from vap_core.metrics import Score, score, step_times
from vap_core.plots import scores_figure, write_png
from vap_core.store import write_atomic

if TYPE_CHECKING:
    import pandas as pd


def conclude(study: Study, table: "pd.DataFrame", folder: Path) -> str:
    """Write `summary.json` and `figure.png` into the run's folder, and return the text to print."""
    rows = table.to_dict("records")
    scores = score({str(key): cell for key, cell in row.items()} for row in rows)
    scores.sort(key=lambda s: (study.tasks.index((s.suite, s.task)), study.methods.index(s.method)))
    write_atomic(folder / "summary.json", json.dumps([{**s.to_json(), "seed": study.seed} for s in scores], indent=1).encode())
    figure = folder / "figure.png"
    write_png(scores_figure(scores), figure)
    times = {
        (s.suite, s.method): step_times(r for r in rows if (r["suite"], r["method"]) == (s.suite, s.method)) for s in scores
    }  # fmt: skip
    lines = [results_table(scores), "", "time per control step, ms by part:", times_table(times)]
    recordings = sorted((folder / "recordings").glob("*.rrd")) if (folder / "recordings").is_dir() else []
    lines += ["", f"wrote {folder / 'summary.json'}, {figure}" + (f", {len(recordings)} recordings in {folder / 'recordings'}" if recordings else "")]
    if recordings:
        lines.append(f"look at one: .venv/bin/rerun --bind 127.0.0.1 {next((r for r in recordings if '.vap.' in r.name), recordings[0])}")
    return "\n".join(lines)


def results_table(scores: list[Score]) -> str:
    """Aligned text; every rate with its 95 % Wilson interval."""
    head = ["suite", "task", "method", "policy", "n", "errors", "SR % [95 %]", "CMR % [95 %]", "wrong object % [95 %]"]
    body = [[s.suite, s.task, s.method, s.policy, str(s.n), str(s.errors), str(s.sr), str(s.cmr), str(s.wrong_object)] for s in scores]
    return align([head, *body])


def times_table(times: dict[tuple[str, str], dict[str, float]]) -> str:
    """Milliseconds of one control step, one row per suite and method."""
    parts = list(dict.fromkeys(part for row in times.values() for part in row))
    head = ["suite", "method", *parts, "total"]
    body = [[*key, *(f"{row.get(part, 0.0):.1f}" for part in parts), f"{sum(row.values()):.1f}"] for key, row in times.items()]
    return align([head, *body])


def align(rows: list[list[str]]) -> str:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    ruled = [rows[0], ["-" * width for width in widths], *rows[1:]]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in ruled)
