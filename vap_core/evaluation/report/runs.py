"""Finished, unfinished and damaged runs, read for a report.

What is missing is counted, nothing is dropped.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import BadOutput
from vap_core.evaluation.layouts import layout_names
from vap_core.evaluation.metrics import MEASURES, SCORE_KEY, TRACK
from vap_core.evaluation.publish import read_runs, require_same_scenes
from vap_core.evaluation.run_schema import require_episodes
from vap_core.evaluation.statistics import PAIR_KEY
from vap_core.evaluation.store import ROW_KEY
from vap_core.simulation import suites

if TYPE_CHECKING:
    import pandas as pd

SETTINGS = ("stack", "follow")
"""What a run saw with; two runs that differ in it can be paired all the same."""
NEEDED_COLUMNS = list(dict.fromkeys((*PAIR_KEY, *SCORE_KEY, "outcome", "steps", *MEASURES)))


@dataclass(frozen=True)
class Runs:
    """Every episode of some runs, and what there should be.

    `table` has one row per episode (`Episode.summary`, `attempt` nan where it was not kept) and its
    starting `layout`. `wanted` has one row per run, suite, task, split, method, policy and seed,
    with the episodes `asked` for and `listed` in the suite's whole list. `manifests` are the runs'
    run.json by name, `unfinished` a sentence for each unfinished run.
    """

    table: "pd.DataFrame"
    wanted: "pd.DataFrame"
    manifests: Mapping[Path, dict[str, Any]]
    unfinished: tuple[str, ...]

    @property
    def methods(self) -> list[str]:
        return list(dict.fromkeys(self.wanted["method"]))

    @property
    def unlike(self) -> list[str]:
        """A sentence for each of SETTINGS in which runs of one suite and policy differ."""
        lines = []
        for setting in SETTINGS:
            by_run = {
                str(name): one["configuration"].get(setting) for name, one in self.manifests.items()
            }
            told = self.wanted.assign(used=self.wanted["run"].map(by_run)).dropna(subset="used")
            for (suite, _), used in told.groupby(["suite", "policy"], sort=False)["used"]:
                if used.nunique() > 1:
                    lines.append(
                        f"the runs of {suite} differ in {setting} ({', '.join(used.unique())}); a "
                        "comparison over several of them compares that, too."
                    )
        return list(dict.fromkeys(lines))


def load_runs(sources: Sequence[Path]) -> Runs:
    """Read runs of eval, rollout or demo: their folders, or tables that `publish` made of them.

    Raises: BadOutput for a folder that holds no run, no episode, damaged parts or episodes it was
        not asked for, for two runs of the same episodes or of one task with other objects or
        robots, and for a run whose episode list has changed since; BadSuite.
    """
    import pandas as pd

    tables = []
    wanted = []
    unfinished = []
    manifests = {}
    for name, manifest, table in _named_runs(sources):
        manifests[name] = manifest
        study = manifest["configuration"]
        _check_run(name, study, table)
        # A checkpoint goes by its label, not by its path.
        labels = dict(table.groupby("suite")["policy"].first())
        asked = _count_asked(study, labels)
        _check_rows(name, study, table)
        total = asked["asked"].sum()
        if len(table) < total:
            unfinished.append(
                f"{name} is unfinished: {len(table)} of {total} episodes; run the same command "
                "again to finish it."
            )
        tables.append(table)
        wanted.append(asked.assign(run=str(name)))
    require_same_scenes(manifests.items(), "report", "report them one by one")
    whole = _joined(tables)
    if whole.duplicated([*PAIR_KEY, "method"]).any():
        raise BadOutput(
            f"report: two of {', '.join(map(str, manifests))} hold the same episodes; name each "
            "run once, or report them one by one."
        )
    expected = _in_order(pd.concat(wanted, ignore_index=True))
    return Runs(
        table=_sorted_as(whole, expected),
        wanted=expected,
        manifests=manifests,
        unfinished=tuple(unfinished),
    )


def _named_runs(sources: Sequence[Path]) -> "Iterator[tuple[Path, dict[str, Any], pd.DataFrame]]":
    """Every run with a name of its own: its folder, or the published table and the run's digest.

    Published parts of one run share its digest and are told apart by their methods.
    """
    for source in dict.fromkeys(sources):
        found = read_runs(source)
        shared = Counter(manifest["digest"] for manifest, _ in found)
        for manifest, table in found:
            name = str(source)
            if source.suffix == ".parquet":
                name += f"@{manifest['digest'][:8]}"
                if shared[manifest["digest"]] > 1:
                    name += f" ({', '.join(manifest['configuration']['methods'])})"
            yield Path(name), manifest, table


def _check_run(name: Path, study: dict[str, Any], table: "pd.DataFrame") -> None:
    """Refuse what is no run, what is empty or too old, and a run of other episode lists."""
    require_episodes(name, study, "report")
    for suite in suites.changed_lists(study.get("lists", {})):
        raise BadOutput(
            f"report: the list of {suite} has changed since {name} was run; use the version that "
            "ran it, or run it again."
        )
    if table.empty:
        raise BadOutput(
            f"report: {name} holds no finished episode yet; run the same command again, it goes on "
            "where it stopped."
        )
    missing = [column for column in NEEDED_COLUMNS if column not in table]
    if missing:
        raise BadOutput(
            f"report: {name} lacks the columns {', '.join(missing)}; an older version wrote it. "
            "Run it again in another folder."
        )


def _check_rows(name: Path, study: dict[str, Any], table: "pd.DataFrame") -> None:
    """Refuse rows that the configuration does not explain."""
    import pandas as pd

    known = []
    for suite, task, seed, rows in _asked_rows(study):
        for episode, _ in rows:
            known.append((suite, task, seed, episode))
    strange = ~pd.MultiIndex.from_frame(table[ROW_KEY]).isin(pd.MultiIndex.from_tuples(known))
    strange |= ~table["method"].isin(study["methods"]).to_numpy()
    if strange.any():
        first = table[strange].iloc[0]
        raise BadOutput(
            f"report: {name} is damaged: it was never asked for {strange.sum()} of its episodes, "
            f"the first {first.suite}/{first.task} episode {first.episode} seed {first.seed} of "
            f"method {first.method}. Run it again."
        )


def _count_asked(study: dict[str, Any], labels: Mapping[str, str]) -> "pd.DataFrame":
    """How many episodes a run was asked for, and how many the whole lists hold.

    `labels` are the labels of the policy by suite.
    """
    import pandas as pd

    lines = []
    for suite, task, seed, rows in _asked_rows(study):
        asked = whole = _count_by_split(rows)
        if suites.has_list(suite):
            whole = _count_by_split(_episodes(suite, task, None, 0))
        policy = labels.get(suite, study["policy"])
        for method in study["methods"]:
            for split, n in asked.items():
                lines.append((suite, task, split, method, policy, seed, n, whole[split]))
    return pd.DataFrame(lines, columns=[*SCORE_KEY, "seed", "asked", "listed"])


def _count_by_split(rows: Sequence[tuple[int, str]]) -> Counter[str]:
    counts: Counter[str] = Counter()
    for _, split in rows:
        counts[split] += 1
    return counts


def _asked_rows(
    study: dict[str, Any],
) -> Iterator[tuple[str, str, int, tuple[tuple[int, str], ...]]]:
    """Suite, task, seed, and the episode and split of all rows that a run was asked for."""
    split = study.get("split", "")
    for suite, task in study["tasks"]:
        for seed in range(study["seed"], study["seed"] + study.get("seeds", 1)):
            # The rows of a list do not depend on the seed.
            drawn_from = 0 if suites.has_list(suite) else seed
            yield suite, task, seed, _episodes(suite, task, study["episodes"], drawn_from, split)


@cache
def _episodes(
    suite: str, task: str, n: int | None, seed: int, split: str = ""
) -> tuple[tuple[int, str], ...]:
    """The episode and split of the rows of a task."""
    episodes = []
    for row in suites.rows(suite, task, n=n, seed=seed, split=split):
        episodes.append((row.episode, row.split))
    return tuple(episodes)


def _joined(tables: "Sequence[pd.DataFrame]") -> "pd.DataFrame":
    """The episodes of all runs; columns that a run lacks are None."""
    import pandas as pd

    kept = [table.dropna(axis="columns", how="all") for table in tables]
    whole = pd.concat(kept, ignore_index=True)
    for column in (*NEEDED_COLUMNS, "attempt", "detail"):
        if column not in whole:
            whole[column] = None
    whole[["split", "variant"]] = whole[["split", "variant"]].fillna("")
    return whole


def _in_order(wanted: "pd.DataFrame") -> "pd.DataFrame":
    """Suite by suite and track by track; tasks and methods in the order of the runs."""
    ranks = []
    for by in (["suite"], TRACK, ["suite", "task"]):
        rank = "rank of " + " and ".join(by)
        wanted = wanted.assign(**{rank: wanted.groupby(by, sort=False).ngroup()})
        ranks.append(rank)
    return wanted.sort_values(ranks, kind="stable", ignore_index=True).drop(columns=ranks)


def _sorted_as(episodes: "pd.DataFrame", wanted: "pd.DataFrame") -> "pd.DataFrame":
    """The episodes in the order of the lines of `wanted`, with their layouts."""
    import pandas as pd

    key = list(SCORE_KEY)
    lines = pd.MultiIndex.from_frame(wanted[key]).drop_duplicates()
    order = lines.get_indexer(pd.MultiIndex.from_frame(episodes[key])).argsort(kind="stable")
    episodes = episodes.assign(layout=layout_names(episodes))
    return episodes.iloc[order].reset_index(drop=True)
