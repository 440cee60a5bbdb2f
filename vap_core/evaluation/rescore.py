"""Judges a finished run again from its saved states, without a simulator."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vap_core.base.errors import BadOutput
from vap_core.evaluation import state_log
from vap_core.evaluation.metrics import score
from vap_core.evaluation.report import ordered, results_table
from vap_core.evaluation.store import key_of, read, read_manifest
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import extent_m, get_object
from vap_core.simulation.suites.rules import rejudge
from vap_core.simulation.types import EpisodeRow, Outcome, Truth

RULED = (
    "success",
    "success_once",
    "held_steps",
    "cmr",
    "wrong_object",
    "first_object_correct",
    "steps",
)
"""The columns of a results table that the rules decide."""
Key = tuple[Any, ...]
NEEDED = {"lists", "tasks", "methods", "episodes", "seed", "seeds"}
"""What a run's configuration must hold."""


def rescore(folder: Path) -> str:
    """The table as the rules judge it now, and the episodes that are judged differently.

    Raises: BadOutput for a folder without results or configuration, or whose episode lists have
        changed since; BadSuite.
    """
    stored = _stored_episodes(folder)
    study = _checked_configuration(folder)
    rows = _rows_by_key(study)
    judged: list[dict[str, Any]] = []
    kept = dict(stored)
    changed = []
    for key, truths in state_log.read(folder):
        if key not in stored or stored[key]["outcome"] == "error":
            continue
        suite, task, _, seed, episode = key
        outcome = _judge(rows[suite, task, seed, episode], truths)
        cells = {name: getattr(outcome, name) for name in RULED}
        judged.append({**stored[key], "outcome": outcome.status, **cells})
        del kept[key]
        if _differs(stored[key], cells):
            changed.append(" ".join(map(str, key)))
    scores = ordered(score([*judged, *kept.values()]), study["tasks"], study["methods"])
    verdict = f"{len(changed)} of {len(judged)} episodes judged differently"
    if changed:
        verdict += ": " + "; ".join(changed[:10])
    verdict += f"; {len(kept)} without a saved state or in error kept as they were."
    return f"{results_table(scores)}\n\n{verdict}"


def _stored_episodes(folder: Path) -> dict[Key, dict[Any, Any]]:
    """The rows of a run's table by their key (store.KEY)."""
    table = read(folder)
    if table.empty:
        raise BadOutput(
            f"rescore: {folder} holds no results; name the folder that eval or rollout wrote."
        )
    episodes: dict[Key, dict[Any, Any]] = {}
    for row in table.to_dict("records"):
        episodes[key_of(row)] = row
    return episodes


def _checked_configuration(folder: Path) -> dict[str, Any]:
    """The configuration of a run whose episode lists have not changed."""
    study = read_manifest(folder)["configuration"]
    if not study.keys() >= NEEDED:
        raise BadOutput(
            f"rescore: {folder} was written by an older version, without the hashes of its "
            "episode lists; run it again."
        )
    for suite in suites.changed_lists(study["lists"]):
        raise BadOutput(
            f"rescore: the list of {suite} has changed since {folder} was run; its states fit no "
            "row of today. Run it again."
        )
    return study


def _rows_by_key(study: Mapping[str, Any]) -> dict[Key, EpisodeRow]:
    """The rows of a study's episode lists by suite, task, seed and episode."""
    rows: dict[Key, EpisodeRow] = {}
    for suite, task in study["tasks"]:
        for row in suites.listed(
            suite,
            task,
            n=study["episodes"],
            seed=study["seed"],
            seeds=study["seeds"],
            own_target=study.get("object", ""),
            split=study.get("split", ""),
        ):
            rows[row.suite, row.task, row.seed, row.episode] = row
    return rows


def _judge(row: EpisodeRow, truths: list[Truth]) -> Outcome:
    sizes_m = {}
    for place in row.placements:
        sizes_m[place.model] = extent_m(get_object(place.model))
    return rejudge(row, sizes_m, truths).outcome()


def _differs(stored: Mapping[str, Any], cells: Mapping[str, Any]) -> bool:
    return any(stored[name] is not cell and stored[name] != cell for name, cell in cells.items())
