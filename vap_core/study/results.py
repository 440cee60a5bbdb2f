"""Finished runs as tables: read, checked, published, and counted, with where they come from.

What is missing is counted, nothing is dropped. Rates and differences are fractions.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.errors import LARGEST_SEED, BadOutput, VapError, command
from vap_core.base.files import check_regular, parse_json, write_atomic
from vap_core.policies.protocol import PRIVILEGED
from vap_core.simulation import suites
from vap_core.study import paper
from vap_core.study.stats import (
    ALL_TASKS,
    MEASURES,
    PAIR_KEY,
    RATES,
    SCORE_KEY,
    TRACK,
    Comparison,
    count,
    intervals,
    layout_clusters,
    layout_interval,
    layout_names,
)
from vap_core.study.store import KEY, ROW_KEY, encode_table, read, read_manifest
from vap_core.study.trials import DEMO, Study, policy_today

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

TEXT_COLUMNS = ("suite", "task", "method", "policy", "outcome")
OPTIONAL_TEXT_COLUMNS = ("split", "variant", "case", "sub_case", "detail")
WHOLE_NUMBER_COLUMNS = ("seed", "episode", "steps")
NUMBER_COLUMNS = ("attempt", "deciding_frame", "case_confidence")
FLAG_COLUMNS = ("success", "success_once", "cmr", "wrong_object", "first_object_correct", "touched")
"""True, False, or nothing."""
EXECUTED = "suite_files"
"""A study's files of own suites. They are the user's to name: none is taken from a file of results.
"""
LARGEST = 1_000_000
"""Counts are smaller."""
NEEDED_SETTINGS = {"tasks", "methods", "episodes", "seed", "policy"}
"""What the configuration of a run of eval, rollout or demo holds."""


def _is_whole_number(value: Any, end: int = LARGEST) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < end


def _is_count(value: Any) -> bool:
    return _is_whole_number(value) and value > 0


def _is_seed(value: Any) -> bool:
    return _is_whole_number(value, LARGEST_SEED)


def _is_count_or_all(value: Any) -> bool:
    return value is None or _is_count(value)


def _is_temperature(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < LARGEST


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _are_texts(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(map(_is_text, value))


def _are_tasks(value: Any) -> bool:
    return (
        isinstance(value, list)
        and bool(value)
        and all(_are_texts(pair) and len(pair) == 2 for pair in value)
    )


def _are_digests(value: Any) -> bool:
    return isinstance(value, dict) and all(map(_is_text, value.values()))


SETTINGS: Mapping[str, Callable[[Any], bool]] = {
    "tasks": _are_tasks,
    "methods": _are_texts,
    "episodes": _is_count_or_all,
    "seed": _is_seed,
    "seeds": _is_count,
    "policy": _is_text,
    "temperature": _is_temperature,
    "object": _is_text,
    "lists": _are_digests,
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


def require_episodes(source: Path, configuration: Mapping[str, Any], command: str) -> None:
    """Raises: BadOutput for a run of another command than eval, rollout or demo."""
    if not configuration.keys() >= NEEDED_SETTINGS:
        raise BadOutput(
            f"{command}: {source} holds no run of eval, rollout or demo; name the folder that one "
            "of them wrote."
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

    for name in episodes.columns.intersection([*TEXT_COLUMNS, *OPTIONAL_TEXT_COLUMNS]):
        kept = episodes[name]
        if name in OPTIONAL_TEXT_COLUMNS:
            kept = kept.dropna()
        if not kept.map(_is_text).all():
            return f"the column {name} holds what is no text"
    for name in episodes.columns.intersection(WHOLE_NUMBER_COLUMNS):
        if len(episodes) and not is_integer_dtype(episodes[name]):
            return f"the column {name} holds what is no whole number"
    for name in episodes.columns.intersection(NUMBER_COLUMNS):
        if len(episodes) and not is_numeric_dtype(episodes[name]):
            return f"the column {name} holds what is no number"
    for name in episodes.columns.intersection(FLAG_COLUMNS):
        if not episodes[name].dropna().isin([True, False]).all():
            return f"the column {name} holds what is neither true nor false"
    return ""


if TYPE_CHECKING:
    type Run = tuple[dict[str, Any], pd.DataFrame]
    """A run's manifest and its episodes."""


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
        raise BadOutput(
            f"published: {path} is no table of finished runs ({type(error).__name__}); publish "
            "writes one."
        ) from error
    return runs


def scene_of(study: Mapping[str, Any]) -> str:
    """What a configuration's scenes have beside what its lists say, in words."""
    scene = f"{study.get('robots', 'plain')} robots"
    if study.get("object"):
        scene += f" and the object {study['object']}"
    return scene


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


def publish(
    sources: Sequence[Path],
    target: Path,
    *,
    replace: bool = False,
    supersede: bool = False,
    suite_names: Sequence[str] = (),
    methods: Sequence[str] = (),
) -> int:
    """Write every episode of the runs, with their manifests in the file's metadata.

    A source is a run's folder, or a table that `publish` wrote, whose runs are taken as they are.
    Tracebacks, wall times and memory use are left out. With `supersede`, a method
    that later sources have read again, for all the same episodes and with the same policy, leaves
    the earlier source (`superseded` in its manifest). Of the runs only those of `suite_names`, and
    of each only its `methods` (the others are `left_out` in its manifest, and may be unfinished),
    are taken, where these are given.

    Returns: the number of episodes.

    Raises: BadOutput for a folder that holds no run or an unfinished one, for two runs of the same
        episodes or of one task with other objects or robots, for sources of which nothing is left,
        or a target that is no new Parquet file.
    """
    import pyarrow as pa

    if target.suffix != ".parquet" or target.is_dir():
        raise BadOutput(f"publish: {target} is no name of a table; end it with .parquet.")
    if target.exists() and not replace:
        raise _exists(target)
    runs: list[Run] = []
    named = []
    for source in sources:
        for manifest, episodes in read_runs(source):
            require_episodes(source, manifest["configuration"], "publish")
            if not suite_names or _is_of(manifest, suite_names):
                _require_finished(source, manifest, episodes, methods)
                runs.append((manifest, episodes))
                named.append((source, manifest))
    require_same_scenes(named, "publish", "publish them in tables of their own")
    if suite_names:
        _require_whole(runs, suite_names)
    if methods:
        runs = _of_methods(runs, methods)
    if supersede:
        runs = _without_superseded(runs)
    tables = []
    for manifest, episodes in runs:
        kept = episodes[_published_columns(episodes)].assign(configuration=manifest["digest"])
        tables.append(pa.Table.from_pandas(kept, preserve_index=False))
    manifests = [manifest for manifest, _ in runs]
    whole = pa.concat_tables(tables, promote_options="permissive")
    if whole.select([*KEY, "policy"]).to_pandas().duplicated().any():
        raise BadOutput(
            f"publish: two of {', '.join(map(str, sources))} hold the same episodes; name each run "
            "once, or pass --supersede to keep the later ones."
        )
    metadata = {
        **(whole.schema.metadata or {}),
        b"runs": json.dumps(manifests, sort_keys=True).encode(),
    }
    _write(whole.replace_schema_metadata(metadata), target, replace)
    return whole.num_rows


def _require_finished(
    source: Path, manifest: dict[str, Any], episodes: "pd.DataFrame", methods: Sequence[str]
) -> None:
    """Raises: BadOutput for a run whose `methods` (all, where none is named) lack episodes."""
    of_run = manifest["configuration"]["methods"]
    names = [name for name in of_run if name in methods] if methods else of_run
    n_wanted = _count_wanted(_with_methods(manifest, names)["configuration"])
    n_there = int(episodes["method"].isin(names).sum())
    if n_there < n_wanted:
        raise BadOutput(
            f"publish: {source} holds {n_there} of {n_wanted} episodes of {', '.join(names)}; run "
            "the same command again to finish it, or name what is finished with --methods."
        )


def _is_of(manifest: dict[str, Any], names: Sequence[str]) -> bool:
    """Whether a run has one of these suites."""
    return any(suite in names for suite, _ in manifest["configuration"]["tasks"])


def _require_whole(runs: "list[Run]", names: Sequence[str]) -> None:
    """Raises: BadOutput for no run of these suites, and for one of others, too."""
    for manifest, _ in runs:
        there = {suite for suite, _ in manifest["configuration"]["tasks"]}
        if not there.issubset(names):
            raise BadOutput(
                f"publish: one run has {', '.join(sorted(there))}, and is taken whole; name all of "
                "them with --suite, or none."
            )
    if not runs:
        raise BadOutput(f"publish: the sources hold no run of {', '.join(names)}.")


def _of_methods(runs: "list[Run]", names: Sequence[str]) -> "list[Run]":
    """The runs with these methods alone. Raises: BadOutput for a method that none has."""
    there = {method for manifest, _ in runs for method in manifest["configuration"]["methods"]}
    missing = [name for name in names if name not in there]
    if missing:
        raise BadOutput(
            f"publish: the sources lack {', '.join(missing)}; they have {', '.join(sorted(there))}."
        )
    kept = []
    for manifest, episodes in runs:
        of_run = manifest["configuration"]["methods"]
        left = [name for name in of_run if name in names]
        if left:
            changed = _with_methods(manifest, left)
            out = [name for name in of_run if name not in names]
            changed["left_out"] = [*manifest.get("left_out", []), *out]
            kept.append((changed, episodes[episodes["method"].isin(left)]))
    return kept


def _with_methods(manifest: dict[str, Any], methods: list[str]) -> dict[str, Any]:
    return {**manifest, "configuration": {**manifest["configuration"], "methods": methods}}


def _without_superseded(runs: "list[Run]") -> "list[Run]":
    """The runs without the methods that later ones have for all the same episodes."""
    kept = []
    for i, run in enumerate(runs):
        manifest, episodes = _supersede(run, runs[i + 1 :])
        if len(episodes):
            kept.append((manifest, episodes))
    return kept


def _supersede(run: "Run", later: "list[Run]") -> "Run":
    """A run without the methods that later ones, one or several together, have read again.

    Raises: BadOutput where they have only a part of a method's episodes.
    """
    manifest, episodes = run
    names = [*KEY, "policy"]
    gone = np.zeros(len(episodes), bool)
    notes = []
    for newer, again in later:
        merged = episodes[names].merge(again[names], how="left", indicator=True)
        repeated = (merged["_merge"] == "both").to_numpy()
        if repeated.any():
            of_newer = sorted(set(episodes["method"][repeated]))
            notes.append({"methods": of_newer, "by": newer["digest"]})
        gone |= repeated
    methods = sorted(set(episodes["method"][gone]))
    if not methods:
        return run
    if gone.sum() < episodes["method"].isin(methods).sum():
        raise BadOutput(
            f"publish: the later runs have only a part of the episodes of {', '.join(methods)}; "
            "supersede a method by runs of the whole list."
        )
    left = [name for name in manifest["configuration"]["methods"] if name not in methods]
    changed = _with_methods(manifest, left)
    changed["superseded"] = [*manifest.get("superseded", []), *notes]
    return changed, episodes[~gone]


def _count_wanted(study: dict[str, Any]) -> int:
    """How many episodes a finished run of a configuration has."""
    rows = 0
    for suite, task in study["tasks"]:
        rows += len(
            suites.listed(
                suite,
                task,
                n=study["episodes"],
                seed=study["seed"],
                seeds=study.get("seeds", 1),
                split=study.get("split", ""),
            )
        )
    return len(study["methods"]) * rows


def _published_columns(episodes: "pd.DataFrame") -> list[str]:
    columns = []
    for name in episodes.columns:
        if name not in ("detail", "peak_mb") and not name.startswith("seconds_"):
            columns.append(name)
    return columns


def _exists(target: Path) -> BadOutput:
    return BadOutput(f"publish: {target} exists; choose another name with --to, or pass --replace.")


def _write(table: "pa.Table", target: Path, replace: bool) -> None:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(target, encode_table(table), replace=replace)
    except OSError as error:
        if target.exists() and not replace:
            raise _exists(target) from error
        raise BadOutput(
            f"publish: {target} cannot be written ({error.strerror}); choose another place with "
            "--to."
        ) from error


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


OUTCOMES = ("success", "failure", "error")


def results(runs: Runs) -> "pd.DataFrame":
    """One row per suite, task, split, method and policy, in the order of the runs.

    After the tasks of each track that has several, rows of ALL_TASKS follow; their `listed` counts
    the tasks that any method of the track was asked for. `n` of `listed` episodes were run, `asked`
    were asked for. `sr_k` of `sr_n` episodes succeed; `sr_low` and
    `sr_high` are Wilson's. `sr_layout_*` is the cluster bootstrap
    over starting layouts where a layout was run more than once, else nan. `bound` marks a method or
    policy that reads the simulator. `paper_*` are the paper's numbers.

    Raises: BadOutput, as `paper.ledger`.
    """
    import pandas as pd

    key = list(SCORE_KEY)
    table, wanted = _with_totals(runs)
    counts = count(table, key).rename(columns=_count_columns()).drop(columns="steps")
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
        _add_rate(lines, name)
    lines = lines.merge(_layout_intervals(table), on=key, how="left")
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
    own = []
    for manifest in runs.manifests.values():
        if manifest["configuration"].get("object"):
            own += [tuple(task) for task in manifest["configuration"]["tasks"]]
    if not own:
        return published
    tasks = pd.MultiIndex.from_frame(published[["suite", "task"]])
    return published[~tasks.isin(own)]


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
    lines = []
    for text, n in counts.head(limit).items():
        lines.append(f"{n} x {text}")
    if len(counts) > limit:
        rest = counts.iloc[limit:].sum()
        lines.append(f"and {rest} of {len(counts) - limit} other kinds")
    return lines


def comparisons(compared: Sequence[Comparison]) -> "pd.DataFrame":
    """One row per comparison."""
    import pandas as pd

    columns = list(Comparison.__dataclass_fields__)
    return pd.DataFrame([asdict(comparison) for comparison in compared], columns=columns)


def _count_columns() -> dict[str, str]:
    """The columns of `metrics.count` as this table names them."""
    names = {}
    for name, measure in zip(RATES, MEASURES, strict=True):
        names[measure] = f"{name}_k"
        names[f"{measure}_n"] = f"{name}_n"
    return names


def _add_rate(lines: "pd.DataFrame", name: str) -> None:
    """Add a rate with Wilson's interval."""
    k = lines[f"{name}_k"].to_numpy()
    n = lines[f"{name}_n"].to_numpy()
    lines[name] = np.divide(k, n, out=np.full(len(k), np.nan), where=n > 0)
    lines[f"{name}_low"], lines[f"{name}_high"] = intervals(k, n)


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


def _layout_intervals(table: "pd.DataFrame") -> "pd.DataFrame":
    """The number of layouts of each line, and the cluster bootstrap of SR where layouts return."""
    import pandas as pd

    key = list(SCORE_KEY)
    clusters = layout_clusters(table, by=key).reset_index()
    lines = []
    for names, part in clusters.groupby(key, sort=False):
        low, high = layout_interval(part["won"].to_numpy(), part["n"].to_numpy())
        lines.append((*names, len(part), low, high))
    return pd.DataFrame(lines, columns=[*key, "layouts", "sr_layout_low", "sr_layout_high"])


def reads_simulator(table: "pd.DataFrame") -> "pd.DataFrame":
    """The episodes whose method or policy reads the simulator; older runs say it of no method."""
    bound = np.zeros(len(table), bool)
    if "policy" in table:
        bound |= table["policy"].isin(PRIVILEGED)
    if "bound" in table:
        bound |= table["bound"].eq(True)
    return table[bound]


EVAL_ONLY = ("seeds", "temperature", "images_every", "follow", "split", "audit")
"""Fields of a study that `eval` has options for, and `rollout` has none."""


def provenance(runs: Runs) -> "pd.DataFrame":
    """One row per run: its digest, versions, seed, checksums, and the command that makes it.

    `policy` is what the run was given; the command names it as it is named here today, so that a
    default that has been replaced since is told by its folder.
    """
    import pandas as pd

    lines = []
    for name, manifest in runs.manifests.items():
        study: dict[str, Any] = manifest["configuration"]
        today = {**study, "policy": _policy(runs, name)}
        lines.append(
            {
                "run": str(name),
                "digest": manifest["digest"],
                "version": study.get("version", ""),
                "policy": study["policy"],
                "seed": _seeds(study),
                "stack": study.get("stack", ""),
                "robots": study.get("robots", ""),
                "world": study.get("world", ""),
                "weights": _shortened(study.get("weights", {})),
                "lists": _shortened(study.get("lists", {})),
                "command": str(manifest.get("command") or command_line(today)),
            }
        )
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
    study = {**study, "suite_files": files}
    tasks_by_suite: dict[str, list[str]] = {}
    for suite, task in study["tasks"]:
        tasks_by_suite.setdefault(suite, []).append(task)
    changed = _changed(study)
    whole = _are_whole_suites(changed["tasks"], study.get("object", ""))
    if _is_demo(study, changed):
        return command("demo", "--episodes", str(study["episodes"]), "--seed", str(study["seed"]))
    if not whole and not _suits_rollout(study, changed):
        return f"Study({', '.join(f'{name}={setting!r}' for name, setting in changed.items())})"
    words = ["eval" if whole else "rollout"]
    for suite, tasks in tasks_by_suite.items():
        words += ["--suite", suite]
        if not whole:
            for task in tasks:
                words += ["--task", task]
    for method in study["methods"]:
        words += ["--method", method]
    for name, setting in _options(study, whole).items():
        if setting is not None:
            words += [f"--{name}", str(setting)]
    if study.get("audit"):
        words.append("--audit")
    return command(*words, environment=suites.own.environment(files))


def _is_demo(study: dict[str, Any], changed: dict[str, Any]) -> bool:
    """Whether `demo` makes it, which has options for the number of episodes and the seed alone."""
    if (changed["tasks"], changed["methods"]) != (DEMO.tasks, DEMO.methods):
        return False
    rest = changed.keys() - {"tasks", "methods", "seed"}
    return study.get("episodes") is not None and rest == {"episodes"}


def _changed(study: dict[str, Any]) -> dict[str, Any]:
    """The fields of a configuration that differ from a study's defaults."""
    changed: dict[str, Any] = {
        "tasks": tuple(tuple(task) for task in study["tasks"]),
        "methods": tuple(study["methods"]),
    }
    for field in fields(Study)[len(changed) :]:
        setting = study.get(field.name, field.default)
        if setting != field.default:
            changed[field.name] = setting
    return changed


def _suits_rollout(study: dict[str, Any], changed: dict[str, Any]) -> bool:
    """Whether `rollout` runs some tasks: of one suite, and of a list never the whole."""
    names = {suite for suite, _ in study["tasks"]}
    if len(names) > 1 or not changed.keys().isdisjoint(EVAL_ONLY):
        return False
    return study.get("episodes") is not None or not suites.has_list(names.pop())


def _are_whole_suites(tasks: tuple[tuple[str, str], ...], own: str) -> bool:
    """Whether `eval` runs these tasks: every one, or with an `own` object those of its category."""
    try:
        return tasks == suites.tasks_of(dict(tasks), own)
    except VapError:
        if not own:
            raise
        return False  # the object was imported elsewhere


def _options(study: dict[str, Any], whole: bool) -> dict[str, Any]:
    """The options of a command and their settings, None where the default holds."""
    options = {}
    for name in ("episodes", "seed", "policy", "stack", "robots", "object", "split", "temperature"):
        options[name] = study.get(name)
    if whole:
        options["seeds"] = None
        if study.get("seeds", 1) > 1:
            options["seeds"] = study["seeds"]
        options["follow"] = study.get("follow")
        options["images-every"] = study.get("images_every") or None
    return options


def _seeds(study: dict[str, Any]) -> str:
    first = study["seed"]
    count = study.get("seeds", 1)
    if count == 1:
        return str(first)
    return f"{first}..{first + count - 1}"


def _shortened(checksums: Any) -> str:
    if not isinstance(checksums, dict):
        return str(checksums)
    parts = []
    for name, digest in checksums.items():
        parts.append(f"{name}:{str(digest)[:12]}")
    return " ".join(parts)


def track_title(suite: str, split: str) -> str:
    """A suite, and its split where it has several."""
    if not split:
        return suite
    return f"{suite}, {split}"
