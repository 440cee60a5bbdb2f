"""A report as one HTML page that needs nothing else: result, funnel, failures with their pictures.

Pictures are inside the page; links to recordings are relative to its folder.
"""

import base64
import os
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing, suppress
from html import escape
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from vap_core.base.commands import command
from vap_core.base.errors import BadRecording
from vap_core.base.palette import METHODS, method_marks
from vap_core.base.tables import Rows
from vap_core.evaluation.report.failures import (
    DIAGNOSIS_COLUMNS,
    diagnosed,
    funnel_table,
    older_text,
    why_other,
)
from vap_core.evaluation.report.funnel import funnel_figure

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from vap_core.base.types import Rgb

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
