"""From the table of a run to the frame that explains a failure.

    failures = list_failures(Path("data/results/mini_pi0.parquet"), case=2, suite="vlabench")
    print(failures_text(failures))
    path = recording_of(failures, 0)

`recordings` has the functions that open a failure.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.condition import rows_matching
from vap_core.base.errors import BadOutput, BadStudy
from vap_core.base.tables import align
from vap_core.evaluation.corrections import with_corrections
from vap_core.evaluation.publish import read_runs, scene_of
from vap_core.evaluation.report.failures import (
    SUBGOAL,
    breakdown,
    breakdown_rows,
    check_diagnosed,
    diagnosed,
    older_text,
    sub_cases_text,
    undiagnosed,
)
from vap_core.evaluation.store import KEY

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = {
    "suite": "suite",
    "task": "task",
    "method": "method",
    "episode": "episode",
    "seed": "seed",
    "subgoal": "sub-goal",
    "case": "case",
    "sub_case": "sub_case",
    "deciding_frame": "frame",
    "case_confidence": "confidence",
    "case_sentence": "why",
}
"""The columns that `failures_text` shows, and their titles; the sub-goal where there are any."""
UNSAFE = r"[^\w.@-]|^\.+"
"""What is replaced in the name of a folder: characters of a policy's label, and dots before it."""
ARTIFACTS = Path("data/runs")
"""Below it are the recordings and corrections of published tables."""


@dataclass(frozen=True)
class Failures:
    """The failed episodes of runs (folders, or published tables) that were asked for.

    `manifests` are the runs' run.json by digest. `all_episodes` are all episodes of the runs,
    failed or not; `episodes` those of the suite, task and method asked for; `table` the failures
    among them that are left. Each table has the run's digest as `configuration`, its `source`, and
    as `folder` where the recordings and corrections of the row are. `notes` are sentences on what
    none of them has.
    """

    manifests: Mapping[str, dict[str, Any]]
    all_episodes: "pd.DataFrame"
    episodes: "pd.DataFrame"
    table: "pd.DataFrame"
    notes: tuple[str, ...] = ()


def list_failures(
    *sources: Path,
    suite: str | None = None,
    task: str | None = None,
    method: str | None = None,
    case: int | str | None = None,
    sub_case: str | None = None,
    where: str | None = None,
) -> Failures:
    """The failures in run folders or published tables, narrowed down.

    An episode that several sources hold is of the first of them that was diagnosed.

    `where` is a SQL condition on the table's columns.

    Raises: BadOutput when there is no such run, or it was never diagnosed; BadStudy for a name or a
        condition that fits nothing in it.
    """
    manifests, once = _read_once(sources)
    older = undiagnosed(once)
    known = diagnosed(once).reset_index(drop=True)
    all_episodes = with_corrections(_with_folders(known))
    selected = all_episodes
    for column, wanted in (("suite", suite), ("task", task), ("method", method)):
        selected = _select(selected, column, wanted)
        if wanted is not None:
            older = older[older[column] == wanted]
    table = selected[selected["outcome"].eq("failure")]
    table = _select(table, "case", f"case {case}" if str(case).isdigit() else case)
    table = _select(table, "sub_case", sub_case)
    if where is not None:
        table = rows_matching(table, where)
    return Failures(
        manifests=manifests,
        all_episodes=all_episodes,
        episodes=selected,
        table=table.reset_index(drop=True),
        notes=tuple(_notes_of_older(older)),
    )


def failures_text(failures: Failures, limit: int = 20) -> str:
    """How the failures divide, and the first of them, numbered as `recording_of` takes them."""
    counts = breakdown(failures.episodes)
    parts = [align(breakdown_rows(counts)), sub_cases_text(counts), *failures.notes]
    if failures.table.empty:
        return "\n\n".join([*parts, "no failure is left of what was asked for."])
    shown = failures.table.head(limit)
    if shown["corrected"].any():
        parts.append("* as corrected by hand")
    listing = _listing(shown)
    rest = len(failures.table) - len(shown)
    if rest:
        listing += (
            f"\nand {rest} more; --limit shows them, --case, --suite, --where narrow them down."
        )
    return "\n\n".join([*parts, listing])


def failure_row(failures: Failures, number: int) -> dict[str, Any]:
    """The row of one listed failure. Raises: BadStudy for a number that is not listed."""
    if not 0 <= number < len(failures.table):
        raise BadStudy(
            f"diagnose: no failure #{number}; there are {len(failures.table)}, counted from 0."
        )
    return failures.table.iloc[number].to_dict()


def deciding_frame(failures: Failures, number: int) -> int:
    """The control step that decides a listed failure; 0 where none does.

    Raises: BadStudy for a number that is not listed.
    """
    return max(0, int(failure_row(failures, number)["deciding_frame"]))


def _read_once(sources: Sequence[Path]) -> "tuple[dict[str, dict[str, Any]], pd.DataFrame]":
    """The manifests of all runs, by digest, and every episode once; a diagnosed one goes first.

    Raises: BadOutput.
    """
    import pandas as pd

    manifests = {}
    tables = []
    for source in dict.fromkeys(sources):
        for manifest, episodes in read_runs(source):
            manifests[manifest["digest"]] = manifest
            if not episodes.empty:
                check_diagnosed(episodes)
                named = episodes.assign(configuration=manifest["digest"], source=str(source))
                tables.append(named)
    if not tables:
        raise BadOutput(
            f"diagnose: {' and '.join(map(str, sources))} hold no finished episode; run eval first."
        )
    whole = pd.concat(tables, ignore_index=True)
    ordered = whole.sort_values("case", key=pd.isna, kind="stable")
    return manifests, _without_repeated(ordered, manifests)


def _without_repeated(
    table: "pd.DataFrame", manifests: Mapping[str, dict[str, Any]]
) -> "pd.DataFrame":
    """Every episode once; those of other scenes or another perception stack are others."""
    settings = {}
    for digest, manifest in manifests.items():
        study = manifest["configuration"]
        settings[digest] = f"{scene_of(study)}, {study.get('stack', '')}"
    names = [name for name in (*KEY, "policy") if name in table]
    keys = table[names].assign(setting=table["configuration"].map(settings))
    return table[~keys.duplicated()].reset_index(drop=True)


def _notes_of_older(older: "pd.DataFrame") -> list[str]:
    """A sentence on the episodes of runs that are older than the diagnosis."""
    if older.empty:
        return []
    n_failures = int(older["outcome"].eq("failure").sum())
    return [f"{older_text(len(older))}; {n_failures} of them failed."]


def _with_folders(table: "pd.DataFrame") -> "pd.DataFrame":
    """With the folder of each row's recordings and corrections.

    That is the run's; a published table has one for each of its runs and policies.
    """
    named = table if "policy" in table else table.assign(policy="unnamed")
    folders = []
    for row in named[["source", "configuration", "policy"]].itertuples(index=False):
        folders.append(_artifacts_folder(*row))
    return table.assign(folder=folders)


def _artifacts_folder(source: str, digest: str, policy: str) -> str:
    if not _is_published(source):
        return source
    return str(_table_folder(source) / _folder_name(digest) / _folder_name(policy))


def _is_published(source: str) -> bool:
    return Path(source).suffix == ".parquet"


def _table_folder(source: str) -> Path:
    """What the folders of a published table lie in; tables of one file name share it."""
    return ARTIFACTS / f"{Path(source).stem}-diagnosed"


def _folder_name(label: object) -> str:
    return re.sub(UNSAFE, "-", str(label))


def _select(table: "pd.DataFrame", column: str, wanted: Any) -> "pd.DataFrame":
    """The rows that hold `wanted` in a column; all of them where it is None. Raises: BadStudy."""
    if wanted is None:
        return table
    known = sorted(set(table[column]))
    if wanted not in known:
        raise BadStudy(
            f"diagnose: no {column.replace('_', '-')} {wanted!r} here; there is "
            f"{', '.join(map(str, known)) or 'none'}."
        )
    return table[table[column] == wanted]


def _listing(shown: "pd.DataFrame") -> str:
    """A numbered line per failure; corrected ones have a star."""
    columns = dict(COLUMNS)
    if SUBGOAL not in shown or shown[SUBGOAL].isna().all():
        del columns[SUBGOAL]
    rows: list[Sequence[str]] = [["#", *columns.values()]]
    for i, line in enumerate(shown.to_dict("records")):
        number = f"{i}*" if line["corrected"] else str(i)
        rows.append([number, *(_cell(name, line[name]) for name in columns)])
    return align(rows)


def _cell(name: str, cell: Any) -> str:
    if name == SUBGOAL:
        return "-" if cell != cell else str(int(cell))
    if isinstance(cell, float):
        return f"{cell:.2f}"
    return str(cell)
