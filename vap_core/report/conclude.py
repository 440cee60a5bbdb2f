"""What a finished run says: the table, the time of a step by part, summary.json and one figure."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.errors import BadOutput
from vap_core.files import write_atomic
from vap_core.metrics import Score, rate, score, step_times
from vap_core.plots import scores_figure, write_png
from vap_core.report.text import align

if TYPE_CHECKING:
    import pandas as pd

    from vap_core.experiments import Study


def conclude(study: "Study", table: "pd.DataFrame", folder: Path) -> str:
    """Write `summary.json` and `figure.png` into the run's folder, and return the text to print. Raises: BadOutput."""
    scores, figure = ordered(score(table), study.tasks, study.methods), folder / "figure.png"
    summary = json.dumps([{**s.to_json(), "seed": study.seed, "seeds": study.seeds} for s in scores], indent=1)
    try:
        write_atomic(folder / "summary.json", summary.encode())
        write_png(scores_figure(scores), figure)
    except OSError as error:
        raise BadOutput(f"conclude: {folder} cannot be written ({error.strerror}); make room and run the same command again.") from error
    times = {(s.suite, s.method): step_times(table[(table["suite"] == s.suite) & (table["method"] == s.method)]) for s in scores}
    lines = [results_table(scores), *_overall(scores), "", "time per control step, ms by part:", times_table(times)]
    recordings = sorted((folder / "recordings").glob("*.rrd")) if (folder / "recordings").is_dir() else []
    size = sum(path.stat().st_size for path in recordings) / 1e6
    held = f", {len(recordings)} recordings ({size:.0f} MB) in {folder / 'recordings'}" if recordings else ""
    lines += ["", f"wrote {folder / 'summary.json'}, {figure}{held}"]
    if recordings:
        lines.append(f"look at one: .venv/bin/rerun --bind 127.0.0.1 {next((r for r in recordings if '.vap.' in r.name), recordings[0])}")
    if table["outcome"].eq("failure").any():
        lines.append(f"why they failed: python -m vap_core diagnose {folder}")
    return "\n".join(lines)


def results_table(scores: list[Score]) -> str:
    """Aligned text; every rate with its 95 % Wilson interval."""
    head = ["suite", "task", "method", "policy", "n", "errors", "SR % [95 %]", "CMR % [95 %]", "wrong object % [95 %]"]
    body = [[s.suite, f"{s.task} ({s.split})" if s.split else s.task, s.method, s.policy,
             *map(str, (s.n, s.errors, s.sr, s.cmr, s.wrong_object))] for s in scores]  # fmt: skip
    return align([head, *body])


def ordered(scores: list[Score], tasks: Sequence[Sequence[str]], methods: Sequence[str]) -> list[Score]:
    """In the order in which a study names its tasks and methods."""
    places = [tuple(task) for task in tasks]
    return sorted(scores, key=lambda s: (places.index((s.suite, s.task)), methods.index(s.method)))


def _overall(scores: list[Score]) -> list[str]:
    """Success of all tasks of a track together, per method, where there is more than one."""
    lines = []
    for suite, split, method in dict.fromkeys((s.suite, s.split, s.method) for s in scores):
        part = [s for s in scores if (s.suite, s.split, s.method) == (suite, split, method)]
        if len(part) > 1:
            total = rate(sum(s.sr.k for s in part), sum(s.n for s in part))
            least = min(part, key=lambda s: s.sr.value)
            track = f"{suite} ({split})" if split else suite
            lines.append(f"{track} {method}: {total.k} of {total.n} succeed, SR {total}; least {least.task} {least.sr}")
    return ["", *lines] if lines else []


def times_table(times: dict[tuple[str, str], dict[str, float]]) -> str:
    """Milliseconds of one control step, one row per suite and method."""
    parts = list(dict.fromkeys(part for row in times.values() for part in row))
    head = ["suite", "method", *parts, "total"]
    body = [[*key, *(f"{row.get(part, 0.0):.1f}" for part in parts), f"{sum(row.values()):.1f}"] for key, row in times.items()]
    return align([head, *body])
