"""Finished runs as tables: read, checked, published, and counted, with where they come from.

What is missing is counted, nothing is dropped. Rates and differences are fractions.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.errors import LARGEST_SEED, BadOutput, VapError, command
from vap_core.base.files import check_regular, parse_json, write_atomic
from vap_core.policies.names import PRIVILEGED
from vap_core.simulation import suites
from vap_core.study import paper
from vap_core.study.stats import (
    ALL_TASKS,
    MEASURES,
    PAIR_KEY,
    RATES,
    SCORE_KEY,
    TRACK,
    add_rate,
    layout_clusters,
    layout_interval,
    layout_names,
    score,
)
from vap_core.study.store import KEY, ROW_KEY, encode_table, read, read_manifest
from vap_core.study.trials import DEMO, Study, policy_today

if TYPE_CHECKING:
    import pandas as pd

    type Run = tuple[dict[str, Any], pd.DataFrame]
    """A run's manifest and its episodes."""

EXECUTED = "suite_files"
"""A study's files of own suites. They are the user's to name: none is taken from a file of results.
"""
LARGEST = 1_000_000
"""Counts are smaller."""
NEEDED_SETTINGS = {"tasks", "methods", "episodes", "seed", "policy"}
"""What the configuration of a run of eval, rollout or demo holds."""


def _is_whole(value: Any, first: int = 0, end: int = LARGEST) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and first <= value < end


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _are_texts(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(map(_is_text, value))


SETTINGS: Mapping[str, Callable[[Any], bool]] = {
    "tasks": lambda tasks: (
        isinstance(tasks, list)
        and bool(tasks)
        and all(_are_texts(pair) and len(pair) == 2 for pair in tasks)
    ),
    "methods": _are_texts,
    "episodes": lambda n: n is None or _is_whole(n, 1),
    "seed": lambda n: _is_whole(n, end=LARGEST_SEED),
    "seeds": lambda n: _is_whole(n, 1),
    "policy": _is_text,
    "temperature": lambda x: isinstance(x, float) or _is_whole(x),
    "object": _is_text,
    "lists": lambda lists: isinstance(lists, dict) and all(map(_is_text, lists.values())),
}
"""Settings of a study that are read back, and what they must be where they are there."""


def check_run(source: Path, manifest: Any, episodes: "pd.DataFrame") -> None:
    """Check the types of a run's manifest and of its columns.

    Raises: BadOutput, which names what is wrong.
    """
    wrong = _wrong_setting(manifest) or _wrong_column(episodes)
    if wrong:
        raise BadOutput(
            f"run: {source} is damaged: {wrong}; run the same command again with another --out, or "
            "publish the table anew."
        )


def _wrong_setting(manifest: Any) -> str:
    if not isinstance(manifest, dict) or not isinstance(manifest.get("configuration"), dict):
        return "its manifest has no configuration"
    if not _is_text(manifest.get("digest")):
        return "its manifest has no digest"
    configuration = manifest["configuration"]
    if EXECUTED in configuration:  # no run writes it
        return f"its manifest has {EXECUTED}, which name code to execute"
    for name, fits in SETTINGS.items():
        if name in configuration and not fits(configuration[name]):
            return f"the setting {name} is {str(configuration[name])[:40]!r}"
    return ""


def _wrong_column(episodes: "pd.DataFrame") -> str:
    from pandas.api.types import is_integer_dtype, is_numeric_dtype

    def is_flag(kept: "pd.Series") -> bool:
        return bool(kept.dropna().isin([True, False]).all())

    checks = {
        "text": (lambda kept: bool(kept.map(_is_text).all()), "suite task method policy outcome"),
        "text, or nothing": (
            lambda kept: bool(kept.dropna().map(_is_text).all()),
            "split variant case sub_case detail",
        ),
        "whole numbers": (lambda kept: kept.empty or is_integer_dtype(kept), "seed episode steps"),
        "numbers": (
            lambda kept: kept.empty or is_numeric_dtype(kept),
            "attempt deciding_frame case_confidence",
        ),
        "true or false": (
            is_flag,
            "success success_once cmr wrong_object first_object_correct touched",
        ),
    }
    for kind, (fits, names) in checks.items():
        for name in episodes.columns.intersection(names.split()):
            if not fits(episodes[name]):
                return f"the column {name} holds other than {kind}"
    return ""


def require_episodes(source: Path, configuration: Mapping[str, Any], command: str) -> None:
    """Raises: BadOutput for a run of another command than eval, rollout or demo."""
    if not configuration.keys() >= NEEDED_SETTINGS:
        raise BadOutput(
            f"{command}: {source} holds no run of eval, rollout or demo; name the folder that one "
            "of them wrote."
        )


def read_published(path: Path) -> "list[Run]":
    """Every run in a table that `publish` wrote: its manifest, and its episodes.

    Raises: BadOutput when `publish` did not write it.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        check_regular(path)
        arrow = pq.read_table(path)
        manifests = parse_json((arrow.schema.metadata or {})[b"runs"])
        table = arrow.to_pandas()
        runs = []
        for manifest in manifests:
            # Parts of one run have its digest each.
            of_run = table["configuration"] == manifest["digest"]
            episodes = table[of_run & table["method"].isin(manifest["configuration"]["methods"])]
            runs.append((manifest, episodes.drop(columns="configuration")))
            check_run(path, *runs[-1])
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError) as error:
        fault = getattr(error, "strerror", None) or type(error).__name__
        raise BadOutput(
            f"published: {path} is no table of finished runs ({fault}); publish writes one."
        ) from error
    return runs


def read_runs(source: Path) -> "list[Run]":
    """The run of a folder, or every run of a published table: its manifest, and its episodes.

    Raises: BadOutput.
    """
    if source.suffix == ".parquet":
        return read_published(source)
    manifest = read_manifest(source)
    episodes = read(source)
    check_run(source, manifest, episodes)
    return [(manifest, episodes)]


def scene_of(study: Mapping[str, Any]) -> str:
    """What a configuration's scenes have beside what its lists say, in words."""
    own = f" and the object {study['object']}" if study.get("object") else ""
    return f"{study.get('robots', 'plain')} robots{own}"


def require_same_scenes(
    named: Iterable[tuple[Path, Mapping[str, Any]]], command: str, mend: str
) -> None:
    """Refuse runs that play one task with another object or with other robots.

    Their rows have the same names, and are other episodes. `named` are runs with their manifests.

    Raises: BadOutput, with `mend`.
    """
    scenes: dict[tuple[str, str], tuple[Path, str]] = {}
    for name, manifest in named:
        study = manifest["configuration"]
        scene = scene_of(study)
        for suite, task in study["tasks"]:
            first, before = scenes.setdefault((suite, task), (name, scene))
            if scene != before:
                raise BadOutput(
                    f"{command}: {suite}/{task} has {before} in {first}, and {scene} in {name}: "
                    f"these are other episodes; {mend}."
                )


def publish(
    sources: Sequence[Path], target: Path, *, replace: bool = False, methods: Sequence[str] = ()
) -> int:
    """Write every episode of the runs, with their manifests in the file's metadata.

    A source is a run's folder, or a table that `publish` wrote, whose runs are taken as they are.
    Tracebacks, wall times and memory use are left out. Of each run only its `methods` (the others
    are `left_out` in its manifest, and may be unfinished) are taken, where any are given.

    Returns: the number of episodes.

    Raises: BadOutput for a folder that holds no run or an unfinished one, for two runs of the same
        episodes or of one task with other objects or robots, for sources of which nothing is left,
        or a target that is no new Parquet file.
    """
    import pyarrow as pa

    if target.suffix != ".parquet" or target.is_dir():
        raise BadOutput(f"publish: {target} is no name of a table; end it with .parquet.")
    exists = BadOutput(
        f"publish: {target} exists; choose another name with --to, or pass --replace."
    )
    if target.exists() and not replace:
        raise exists
    runs: list[tuple[Path, dict[str, Any], pd.DataFrame]] = []
    there: dict[str, None] = {}
    for source in sources:
        for manifest, episodes in read_runs(source):
            require_episodes(source, manifest["configuration"], "publish")
            of_run = manifest["configuration"]["methods"]
            there |= dict.fromkeys(of_run)
            taken = [name for name in of_run if name in methods] if methods else of_run
            episodes = episodes[episodes["method"].isin(taken)]
            changed = {**manifest, "configuration": {**manifest["configuration"], "methods": taken}}
            if methods:
                out = [name for name in of_run if name not in taken]
                changed["left_out"] = [*manifest.get("left_out", []), *out]
            if taken:
                _require_finished(source, changed["configuration"], len(episodes))
                runs.append((source, changed, episodes))
    missing = [name for name in methods if name not in there]
    if missing:
        raise BadOutput(
            f"publish: the sources lack {', '.join(missing)}; they have {', '.join(sorted(there))}."
        )
    named = ((source, manifest) for source, manifest, _ in runs)
    require_same_scenes(named, "publish", "publish them in tables of their own")
    kept = [
        episodes.loc[:, ~episodes.columns.str.fullmatch("detail|peak_mb|seconds_.*")].assign(
            configuration=manifest["digest"]
        )
        for _, manifest, episodes in runs
    ]
    tables = [pa.Table.from_pandas(table, preserve_index=False) for table in kept]
    whole = pa.concat_tables(tables, promote_options="permissive")
    if whole.select([*KEY, "policy"]).to_pandas().duplicated().any():
        raise BadOutput(
            f"publish: two of {', '.join(map(str, sources))} hold the same episodes; name each run "
            "once."
        )
    notes = json.dumps([manifest for _, manifest, _ in runs], sort_keys=True).encode()
    whole = whole.replace_schema_metadata({**(whole.schema.metadata or {}), b"runs": notes})
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(target, encode_table(whole), replace=replace)
    except OSError as error:
        if target.exists() and not replace:
            raise exists from error
        raise BadOutput(
            f"publish: {target} cannot be written ({error.strerror}); choose another place with "
            "--to."
        ) from error
    return int(whole.num_rows)


def _require_finished(source: Path, study: Mapping[str, Any], n_there: int) -> None:
    """Raises: BadOutput for a run that lacks episodes."""
    more = dict(n=study["episodes"], seed=study["seed"], seeds=study.get("seeds", 1))
    more["split"] = study.get("split", "")
    rows = sum(len(suites.listed(suite, task, **more)) for suite, task in study["tasks"])
    n_wanted = rows * len(study["methods"])
    if n_there < n_wanted:
        raise BadOutput(
            f"publish: {source} holds {n_there} of {n_wanted} episodes of "
            f"{', '.join(study['methods'])}; run the same command again to finish it, or name what "
            "is finished with --methods."
        )


SEEN_WITH = ("stack", "follow")
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
        """A sentence for each of SEEN_WITH in which runs of one suite and policy differ."""
        lines = []
        for setting in SEEN_WITH:
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

    tables, wanted, unfinished = [], [], []
    manifests = {}
    for name, manifest, table in _named_runs(sources):
        manifests[name] = manifest
        study = manifest["configuration"]
        _check_episodes(name, study, table)
        # A checkpoint goes by its label, not by its path.
        asked = _count_asked(study, dict(table.groupby("suite")["policy"].first()))
        _check_rows(name, study, table)
        total = asked["asked"].sum()
        if len(table) < total:
            unfinished.append(
                f"{name} is unfinished: {len(table)} of {total} episodes; run the same command "
                "again to finish it."
            )
        tables.append(table.dropna(axis="columns", how="all"))
        wanted.append(asked.assign(run=str(name)))
    require_same_scenes(manifests.items(), "report", "report them one by one")
    whole = pd.concat(tables, ignore_index=True)
    for column in (*NEEDED_COLUMNS, "attempt", "detail"):
        if column not in whole:
            whole[column] = None
    whole[["split", "variant"]] = whole[["split", "variant"]].fillna("")
    if whole.duplicated([*PAIR_KEY, "method"]).any():
        raise BadOutput(
            f"report: two of {', '.join(map(str, manifests))} hold the same episodes; name each "
            "run once, or report them one by one."
        )
    expected = _in_order(pd.concat(wanted, ignore_index=True))
    key = list(SCORE_KEY)
    lines = pd.MultiIndex.from_frame(expected[key]).drop_duplicates()
    order = lines.get_indexer(pd.MultiIndex.from_frame(whole[key])).argsort(kind="stable")
    whole = whole.assign(layout=layout_names(whole)).iloc[order].reset_index(drop=True)
    return Runs(whole, expected, manifests, tuple(unfinished))


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


def _check_episodes(name: Path, study: dict[str, Any], table: "pd.DataFrame") -> None:
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

    known = [
        (suite, task, seed, episode)
        for suite, task, seed, rows in _asked_rows(study)
        for episode, _ in rows
    ]
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
        asked = whole = Counter(split for _, split in rows)
        if suites.has_list(suite):
            whole = Counter(split for _, split in _episodes(suite, task, None, 0))
        policy = labels.get(suite, study["policy"])
        for method in study["methods"]:
            for split, n in asked.items():
                lines.append((suite, task, split, method, policy, seed, n, whole[split]))
    return pd.DataFrame(lines, columns=[*SCORE_KEY, "seed", "asked", "listed"])


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
    rows = suites.rows(suite, task, n=n, seed=seed, split=split)
    return tuple((row.episode, row.split) for row in rows)


def _in_order(wanted: "pd.DataFrame") -> "pd.DataFrame":
    """Suite by suite and track by track; tasks and methods in the order of the runs."""
    ranks = []
    for by in (["suite"], TRACK, ["suite", "task"]):
        rank = "rank of " + " and ".join(by)
        wanted = wanted.assign(**{rank: wanted.groupby(by, sort=False).ngroup()})
        ranks.append(rank)
    return wanted.sort_values(ranks, kind="stable", ignore_index=True).drop(columns=ranks)


OUTCOMES = ("success", "failure", "error")


def results(runs: Runs) -> "pd.DataFrame":
    """One row per suite, task, split, method and policy, in the order of the runs.

    After the tasks of each track that has several, rows of ALL_TASKS follow; their `listed` counts
    the tasks that any method of the track was asked for. `n` of `listed` episodes were run, `asked`
    were asked for. `sr_k` of `sr_n` episodes succeed; `sr_low` and `sr_high` are Wilson's.
    `sr_layout_*` is the cluster bootstrap over starting layouts where a layout was run more than
    once, else nan. `bound` marks a method or policy that reads the simulator. `paper_*` are the
    paper's numbers.

    Raises: BadOutput, as `paper.ledger`.
    """
    import pandas as pd

    key = list(SCORE_KEY)
    table, wanted = _with_totals(runs)
    rates = [f"{name}{part}" for name in RATES for part in ("", "_low", "_high")]
    counts = score(table, key).drop(columns=["steps", *rates])
    lines = (
        wanted.groupby(key, sort=False)
        .agg(asked=("asked", "sum"), listed=("listed", "sum"), seeds=("seed", "nunique"))
        .reset_index()
        .merge(counts, on=key, how="left")
    )
    total = lines["task"] == ALL_TASKS
    lines.loc[total, "listed"] = _listed_together(runs, lines[total], TRACK)
    counted = counts.columns.drop(key)
    lines[counted] = lines[counted].fillna(0).astype(int)
    for name in RATES:
        add_rate(lines, name)
    layouts = []
    for names, part in layout_clusters(table, by=key).reset_index().groupby(key, sort=False):
        ends = layout_interval(part["won"].to_numpy(), part["n"].to_numpy())
        layouts.append((*names, len(part), *ends))
    columns = [*key, "layouts", "sr_layout_low", "sr_layout_high"]
    lines = lines.merge(pd.DataFrame(layouts, columns=columns), on=key, how="left")
    reading = pd.MultiIndex.from_frame(reads_simulator(table)[key])
    lines["bound"] = pd.MultiIndex.from_frame(lines[key]).isin(reading)
    lines["layouts"] = lines["layouts"].fillna(0).astype(int)
    published = paper_results(runs).rename(columns={"sr": "paper_sr", "cmr": "paper_cmr"})
    return lines.merge(published, on=[*TRACK, "task", "method"], how="left")


def paper_results(runs: Runs) -> "pd.DataFrame":
    """The paper's main results, without tasks that a run plays with an object of one's own.

    Raises: BadOutput, as `paper.ledger`.
    """
    import pandas as pd

    published = paper.main_results()
    studies = [manifest["configuration"] for manifest in runs.manifests.values()]
    own = [tuple(task) for study in studies if study.get("object") for task in study["tasks"]]
    tasks = pd.MultiIndex.from_frame(published[["suite", "task"]])
    return published[~tasks.isin(own)] if own else published


def outcomes(runs: Runs) -> "pd.DataFrame":
    """Per suite, method and policy: how many episodes were asked for, and how they ended.

    `retried` is nan where attempts were not kept.
    """
    by = ["suite", "method", "policy"]
    attempt = runs.table["attempt"].astype(float)
    retried = (attempt > 1).astype(float).where(attempt.notna())
    flat = runs.table[by].assign(run=1, retried=retried, attempts=attempt)
    for outcome in OUTCOMES:
        flat[outcome] = runs.table["outcome"].eq(outcome).astype(int)
    groups = flat.groupby(by, sort=False)
    ended = groups[["run", *OUTCOMES]].sum()
    ended["retried"] = groups["retried"].sum(min_count=1)
    ended["most_attempts"] = groups["attempts"].max()
    wanted = runs.wanted.groupby(by, sort=False)
    lines = wanted[["listed", "asked"]].sum().join(wanted["seed"].nunique().rename("seeds"))
    lines = lines.join(ended).reset_index()
    lines["listed"] = _listed_together(runs, lines, ["suite"])
    lines = lines.drop(columns="seeds")
    lines[["run", *OUTCOMES]] = lines[["run", *OUTCOMES]].fillna(0).astype(int)
    return lines


def errors(runs: Runs, limit: int = 5) -> list[str]:
    """The last lines of the commonest tracebacks, with how often they occurred."""
    details = runs.table.loc[runs.table["outcome"].eq("error"), "detail"].fillna("").astype(str)
    last_lines = details.str.strip().str.rsplit("\n", n=1).str[-1].str.slice(0, 160)
    counts = last_lines.replace("", "(no traceback was kept)").value_counts(sort=True)
    lines = [f"{n} x {text}" for text, n in counts.head(limit).items()]
    if len(counts) > limit:
        lines.append(f"and {counts.iloc[limit:].sum()} of {len(counts) - limit} other kinds")
    return lines


def _with_totals(runs: Runs) -> "tuple[pd.DataFrame, pd.DataFrame]":
    """The episodes and the wanted counts; both again as ALL_TASKS, where a track has several."""
    import pandas as pd

    tasks = runs.wanted.groupby(TRACK, sort=False)["task"].nunique()
    several = tasks[tasks > 1].index

    def with_total(table: "pd.DataFrame") -> "pd.DataFrame":
        repeated = table[pd.MultiIndex.from_frame(table[TRACK]).isin(several)]
        return pd.concat([table, repeated.assign(task=ALL_TASKS)], ignore_index=True)

    wanted = with_total(runs.wanted)
    order = wanted.groupby(TRACK, sort=False).ngroup().sort_values(kind="stable").index
    return with_total(runs.table), wanted.loc[order].reset_index(drop=True)


def _listed_together(runs: Runs, lines: "pd.DataFrame", where: Sequence[str]) -> "pd.Series[int]":
    """`listed` of lines over all tasks that any method was asked for `where` a line is.

    A suite without a list has no more than a method was asked for.
    """
    by_task = runs.wanted.groupby([*TRACK, "task"], sort=False)["listed"].max().reset_index()
    together = by_task.groupby(list(where), sort=False)["listed"].sum().rename("together")
    found = lines.join(together, on=list(where))
    whole = found["seeds"] * found["together"]
    return whole.where(found["suite"].map(suites.has_list), found["listed"])


def reads_simulator(table: "pd.DataFrame") -> "pd.DataFrame":
    """The episodes whose method or policy reads the simulator; older runs say it of no method."""
    bound = np.zeros(len(table), bool)
    if "policy" in table:
        bound |= table["policy"].isin(PRIVILEGED)
    if "bound" in table:
        bound |= table["bound"].eq(True)
    return table[bound]


EVAL_ONLY = ("seeds", "temperature", "follow", "split", "audit")
"""Fields of a study that `eval` has options for, and `rollout` has none."""


def provenance(runs: Runs) -> "pd.DataFrame":
    """One row per run: its digest, versions, seed, checksums, and the command that makes it.

    `policy` is what the run was given; the command names it as it is named here today, so that a
    default that has been replaced since is told by its folder.
    """
    import pandas as pd

    lines = []
    for name, manifest in runs.manifests.items():
        study = manifest["configuration"]
        first, count = study["seed"], study.get("seeds", 1)
        about = {
            "run": str(name),
            "digest": manifest["digest"],
            "version": study.get("version", ""),
            "policy": study["policy"],
            "seed": str(first) if count == 1 else f"{first}..{first + count - 1}",
        }
        about |= {part: study.get(part, "") for part in ("stack", "robots", "world")}
        about |= {part: _shortened(study.get(part, {})) for part in ("weights", "lists")}
        today = {**study, "policy": _policy(runs, name)}
        about["command"] = str(manifest.get("command") or command_line(today))
        lines.append(about)
    return pd.DataFrame(lines)


def _policy(runs: Runs, name: Path) -> str:
    """How the policy of a run is named here; as the run named it, where its suites have several."""
    given = str(runs.manifests[name]["configuration"]["policy"])
    of_run = runs.wanted[runs.wanted["run"] == str(name)]
    pairs = of_run[["policy", "suite"]].drop_duplicates().itertuples(index=False, name=None)
    named = {policy_today(given, label, suite) for label, suite in pairs}
    return named.pop() if len(named) == 1 else given


def command_line(study: dict[str, Any]) -> str:
    """The command line that runs a configuration, without --out; in code where no command does.

    It finds the user's own suites, where they are known here.
    """
    files = suites.own_files(suite for suite, _ in study["tasks"])
    changed = {
        "tasks": tuple(tuple(task) for task in study["tasks"]),
        "methods": tuple(study["methods"]),
    }
    for field in fields(Study)[len(changed) :]:
        setting = files if field.name == EXECUTED else study.get(field.name, field.default)
        if setting != field.default:
            changed[field.name] = setting
    is_demo = (changed["tasks"], changed["methods"]) == (DEMO.tasks, DEMO.methods)
    if is_demo and changed.keys() - {"tasks", "methods", "seed"} == {"episodes"}:
        given = ("--episodes", str(study["episodes"]), "--seed", str(study["seed"]))
        return command("demo", *given)
    whole = "images_every" not in changed
    whole &= _are_whole_suites(changed["tasks"], study.get("object", ""))
    names = list(dict.fromkeys(suite for suite, _ in changed["tasks"]))
    suits_rollout = len(names) == 1 and changed.keys().isdisjoint({*EVAL_ONLY, "images_every"})
    if suits_rollout and suites.has_list(names[0]):
        suits_rollout = study.get("episodes") is not None
    if not whole and not suits_rollout:
        return f"Study({', '.join(f'{name}={setting!r}' for name, setting in changed.items())})"
    words = ["eval" if whole else "rollout"]
    for name in names:
        words += ["--suite", name]
    if not whole:
        for _, task in changed["tasks"]:
            words += ["--task", task]
    for method in study["methods"]:
        words += ["--method", method]
    options = ["episodes", "seed", "policy", "stack", "robots", "object", "split", "temperature"]
    asked = {name: study.get(name) for name in options}
    if whole:
        asked["seeds"] = study["seeds"] if study.get("seeds", 1) > 1 else None
        asked["follow"] = study.get("follow")
    for name, setting in asked.items():
        if setting is not None:
            words += [f"--{name}", str(setting)]
    if study.get("audit"):
        words.append("--audit")
    return command(*words, environment=suites.own.environment(files))


def _are_whole_suites(tasks: tuple[tuple[str, str], ...], own: str) -> bool:
    """Whether `eval` runs these tasks: every one, or with an `own` object those of its category."""
    try:
        return tasks == suites.tasks_of(dict(tasks), own)
    except VapError:
        if not own:
            raise
        return False  # the object was imported elsewhere


def _shortened(checksums: Any) -> str:
    if not isinstance(checksums, dict):
        return str(checksums)
    return " ".join(f"{name}:{str(digest)[:12]}" for name, digest in checksums.items())


def track_title(suite: str, split: str) -> str:
    """A suite, and its split where it has several."""
    return f"{suite}, {split}" if split else suite
