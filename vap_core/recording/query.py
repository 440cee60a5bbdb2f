"""A condition on all recordings of a run: "margin < 0.05 and success = false"."""

from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.condition import rows_matching
from vap_core.base.errors import BadStudy
from vap_core.base.tables import align
from vap_core.base.types import value
from vap_core.recording.catalog import load_steps
from vap_core.recording.reading import recordings_folder

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ("suite", "task", "method", "episode", "outcome", "case", "sub_case")
MATCH_COLUMNS = ("matching_steps", "first_step", "last_step")
"""How many steps of a recording match, and which are the first and the last of them."""
UNFINISHED = "unfinished"
"""The outcome of a recording that has none; a condition may name it."""


@value
class QueryResult:
    """`matches` has one row per recording with a matching step: COLUMNS, `file`, MATCH_COLUMNS.

    `n_recordings` were read, and `unreadable` says why others were not.
    """

    matches: "pd.DataFrame"
    n_recordings: int
    unreadable: dict[Path, str]


def run_query(run: Path, where: str) -> QueryResult:
    """Find the steps of a run's recordings for which a SQL condition holds.

    Raises: BadRecording without readable recordings; BadStudy for a condition that fits no table.
    """
    steps = load_steps(recordings_folder(run))
    table = steps.table.fillna({"outcome": UNFINISHED})
    rows = rows_matching(table, where).fillna({"case": "", "sub_case": ""})
    grouped = rows.groupby(["file", *COLUMNS], sort=False, dropna=False)["frame_index"]
    matches = grouped.agg(matching_steps="size", first_step="min", last_step="max")
    n_recordings = int(steps.table["file"].nunique())
    return QueryResult(matches.reset_index(), n_recordings, steps.unreadable)


def format_result(result: QueryResult, limit: int = 20) -> str:
    """The matching recordings, numbered as `first_match` takes them, and the unreadable files."""
    n_matches = len(result.matches)
    n_steps = int(result.matches["matching_steps"].sum())
    lines = [f"{n_matches} of {result.n_recordings} recordings, {n_steps} steps"]
    names = [*COLUMNS, *MATCH_COLUMNS]
    shown = result.matches.head(limit)
    rows = [["#", *names]]
    for i, match in enumerate(shown.to_dict("records")):
        rows.append([str(i), *[str(match[name]) for name in names]])
    if len(shown):
        lines.append(align(rows))
    if n_matches > len(shown):
        lines.append(f"and {n_matches - len(shown)} more; --limit shows them.")
    for path, reason in result.unreadable.items():
        lines.append(f"note: {path} was left out: {reason}")
    return "\n".join(lines)


def first_match(result: QueryResult, number: int) -> tuple[Path, int]:
    """The file of one matching recording, and its first matching step. Raises: BadStudy."""
    n_matches = len(result.matches)
    if not 0 <= number < n_matches:
        raise BadStudy(f"query: no recording #{number}; {n_matches} were found, counted from 0.")
    match = result.matches.iloc[number]
    return Path(str(match["file"])), int(match["first_step"])
