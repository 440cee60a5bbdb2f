"""Finished, unfinished and damaged runs, read for a report; whatever is missing is counted, nothing is dropped."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core import suites
from vap_core.errors import BadOutput
from vap_core.metrics import MEASURES, TRACK
from vap_core.publish import runs as read_runs
from vap_core.statistics import EPISODE, layouts

if TYPE_CHECKING:
    import pandas as pd

ASKED = {"tasks", "methods", "episodes", "seed", "policy"}
NEEDED = dict.fromkeys((*EPISODE, *TRACK, "outcome", "steps", *MEASURES))


@dataclass(frozen=True)
class Runs:
    """Every episode of some runs, and what there should be.

    `table` has one row per episode (`Episode.summary`, `attempt` nan where it was not kept) and its starting `layout`; `wanted` one row per run,
    suite, task, split, method, policy and seed with the episodes `asked` for and `listed` in the suite's whole list; `notes` are the runs' run.json.
    """

    table: "pd.DataFrame"
    wanted: "pd.DataFrame"
    notes: dict[Path, dict[str, Any]]
    unfinished: tuple[str, ...]

    @property
    def methods(self) -> list[str]:
        return list(dict.fromkeys(self.wanted["method"]))


def load(folders: Sequence[Path]) -> Runs:
    """Read runs of eval, rollout or demo: their folders, or tables that `publish` made of them.

    Raises: BadOutput for a folder that holds no run, no episode, damaged parts or episodes it was not asked for, for two runs of the same episodes,
    and for a run whose episode list has changed since; BadSuite.
    """
    import pandas as pd

    tables, wanted, unfinished, notes = [], [], [], {}
    for folder, about, table in (run for place in dict.fromkeys(folders) for run in _runs(place)):
        notes[folder], study = about, about["configuration"]
        if not isinstance(study, dict) or not study.keys() >= ASKED:
            raise BadOutput(f"report: {folder} holds no run of eval, rollout or demo; name the folder that one of them wrote.")
        _same_lists(folder, study)
        if table.empty:
            raise BadOutput(f"report: {folder} holds no finished episode yet; run the same command again, it goes on where it stopped.")
        if NEEDED.keys() - table.columns:
            missing = ", ".join(name for name in NEEDED if name not in table)
            raise BadOutput(f"report: {folder} lacks the columns {missing}; an older version wrote it. Run it again in another folder.")
        asked = _asked(study, dict(table.groupby("suite")["policy"].first()))  # a checkpoint goes by its label, not by its path
        _expected(folder, study, table)
        if len(table) < asked["asked"].sum():
            unfinished.append(f"{folder} is unfinished: {len(table)} of {asked['asked'].sum()} episodes; run the same command again to finish it.")
        tables.append(table)
        wanted.append(asked.assign(run=str(folder)))
    whole = pd.concat([table.dropna(axis="columns", how="all") for table in tables], ignore_index=True)
    for name in (*NEEDED, "attempt", "detail"):  # undefined everywhere
        if name not in whole:
            whole[name] = None
    whole[["split", "variant"]] = whole[["split", "variant"]].fillna("")
    everything = _by_track(pd.concat(wanted, ignore_index=True))
    if whole.duplicated([*EPISODE, "method"]).any():
        raise BadOutput(f"report: two of {', '.join(map(str, notes))} hold the same episodes; name each run once, or report them one by one.")
    lines = pd.MultiIndex.from_frame(everything[list(TRACK)]).drop_duplicates()
    place = lines.get_indexer(pd.MultiIndex.from_frame(whole[list(TRACK)]))
    whole = whole.assign(layout=layouts(whole)).iloc[place.argsort(kind="stable")].reset_index(drop=True)
    return Runs(whole, everything, notes, tuple(unfinished))


def _runs(place: Path) -> "Iterator[tuple[Path, dict[str, Any], pd.DataFrame]]":
    """Every run of a place with a name of its own: the folder, or the table and the digest."""
    for about, table in read_runs(place):
        yield Path(f"{place}@{about['digest'][:8]}") if place.suffix == ".parquet" else place, about, table


def _by_track(wanted: "pd.DataFrame") -> "pd.DataFrame":
    """Suite by suite and track by track, tasks and methods in the order in which the runs name them."""
    keys = [wanted.groupby(by, sort=False).ngroup() for by in (["suite"], ["suite", "split"], ["suite", "task"])]
    return wanted.assign(a=keys[0], b=keys[1], c=keys[2]).sort_values(["a", "b", "c"], kind="stable", ignore_index=True).drop(columns=["a", "b", "c"])


def _same_lists(folder: Path, study: dict[str, Any]) -> None:
    for suite, digest in study.get("lists", {}).items():
        if suites.lists.digest(suite) != digest:
            raise BadOutput(f"report: the list of {suite} has changed since {folder} was run; use the version that ran it, or run it again.")


@cache
def _rows(suite: str, task: str, episodes: int | None, seed: int) -> tuple[tuple[int, str], ...]:
    return tuple((row.episode, row.split) for row in suites.rows(suite, task, episodes, seed))


def _listed(study: dict[str, Any]) -> Iterator[tuple[str, str, int, tuple[tuple[int, str], ...]]]:
    """Suite, task, seed, and the episode and split of all rows asked for; a benchmark's do not depend on the seed."""
    for suite, task in study["tasks"]:
        for seed in range(study["seed"], study["seed"] + study.get("seeds", 1)):
            yield suite, task, seed, _rows(suite, task, study["episodes"], 0 if suite in suites.BENCHMARKS else seed)


def _asked(study: dict[str, Any], labels: dict[str, str]) -> "pd.DataFrame":
    import pandas as pd

    lines = []
    for suite, task, seed, rows in _listed(study):
        asked = Counter(split for _, split in rows)
        whole = Counter(split for _, split in _rows(suite, task, None, 0)) if suite in suites.BENCHMARKS else asked
        for method in study["methods"]:
            policy = labels.get(suite, study["policy"])
            lines += [(suite, task, split, method, policy, seed, n, whole[split]) for split, n in asked.items()]
    return pd.DataFrame(lines, columns=[*TRACK, "seed", "asked", "listed"])


def _expected(folder: Path, study: dict[str, Any], table: "pd.DataFrame") -> None:
    """Refuse rows that the configuration does not explain."""
    import pandas as pd

    known = pd.MultiIndex.from_tuples([(suite, task, seed, episode) for suite, task, seed, rows in _listed(study) for episode, _ in rows])
    strange = ~pd.MultiIndex.from_frame(table[["suite", "task", "seed", "episode"]]).isin(known)
    strange |= ~table["method"].isin(study["methods"]).to_numpy()
    if strange.any():
        odd = table[strange].iloc[0]
        where = f"{odd.suite}/{odd.task} episode {odd.episode} seed {odd.seed} of method {odd.method}"
        raise BadOutput(f"report: {folder} is damaged: it was never asked for {strange.sum()} of its episodes, the first {where}. Run it again.")
