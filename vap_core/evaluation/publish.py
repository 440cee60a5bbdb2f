"""Keeps the results of finished runs as one small table, with their manifests (run.json)."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.errors import BadOutput
from vap_core.base.files import check_regular, parse_json, write_atomic
from vap_core.evaluation.measurements import encode_table
from vap_core.evaluation.run_schema import check_run, require_episodes
from vap_core.evaluation.store import KEY, read, read_manifest
from vap_core.simulation import suites

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

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
