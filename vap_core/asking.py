"""A condition asked of all recordings of a run: "margin < 0.05 and success = false" -> recordings -> frames."""

from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.condition import matching
from vap_core.errors import BadStudy
from vap_core.report.text import align
from vap_core.values import value

if TYPE_CHECKING:
    import pandas as pd

SHOWN = ("suite", "task", "method", "episode", "status", "failure_case", "sub_case")


@value
class Answer:
    """`found` has one row per recording in which the condition holds: SHOWN, `file`, how many `steps`, and the `first` and `last` of them.

    `asked` recordings were read, and `unreadable` says why others were not.
    """

    found: "pd.DataFrame"
    asked: int
    unreadable: dict[Path, str]


def ask(run: Path, where: str) -> Answer:
    """Raises: BadRecording without readable recordings; BadStudy for a condition that cannot be read."""
    from vap_core.record import steps

    folder = run / "recordings" if (run / "recordings").is_dir() else run
    held = steps(folder)
    rows = matching(held.table, where).fillna({"failure_case": "", "sub_case": ""})
    grouped = rows.groupby(["file", *SHOWN], sort=False, dropna=False)["frame_index"]
    found = grouped.agg(steps="size", first="min", last="max").reset_index()
    return Answer(found, int(held.table["file"].nunique()), held.unreadable)


def text(answer: Answer, limit: int = 20) -> str:
    """The recordings found, numbered as `frame` takes them, and what could not be read."""
    shown = answer.found.head(limit)
    head = ["#", *SHOWN, "steps", "first", "last"]
    rows = [[str(i), *(str(line[name]) for name in head[1:])] for i, line in enumerate(shown.to_dict("records"))]
    lines = [f"{len(answer.found)} of {answer.asked} recordings, {int(answer.found['steps'].sum())} steps", *([align([head, *rows])] if rows else [])]
    if len(answer.found) > len(shown):
        lines.append(f"and {len(answer.found) - len(shown)} more; --limit shows them.")
    return "\n".join([*lines, *(f"note: {path} was left out: {why}" for path, why in answer.unreadable.items())])


def frame(answer: Answer, number: int) -> tuple[Path, int]:
    """The file of one of the recordings found, and the first step for which the condition holds. Raises: BadStudy."""
    if not 0 <= number < len(answer.found):
        raise BadStudy(f"query: no recording #{number}; {len(answer.found)} were found, counted from 0.")
    line = answer.found.iloc[number]
    return Path(str(line["file"])), int(line["first"])
