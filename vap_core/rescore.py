"""Judge a finished run again from its saved states, without a simulator."""

from pathlib import Path
from typing import Any

from vap_core import suites, traces
from vap_core.errors import BadOutput
from vap_core.metrics import score
from vap_core.report import ordered, results_table
from vap_core.sim.objects import extent_m, get
from vap_core.store import KEY, note, read
from vap_core.suites.rules import rejudge

RULED = ("success", "success_once", "held_steps", "cmr", "wrong_object", "first_object_correct", "steps")
"""What the rules decide of an episode."""


def rescore(folder: Path) -> str:
    """The table as the rules judge it now, and whose outcome differs from the stored one.

    Raises: BadOutput for a folder without results or configuration, or whose episode lists have changed since; BadSuite.
    """
    table = read(folder)
    if table.empty:
        raise BadOutput(f"rescore: {folder} holds no results; name the folder that eval or rollout wrote.")
    study = note(folder)["configuration"]
    if not {"lists", "tasks", "methods", "episodes", "seed", "seeds"} <= study.keys():
        raise BadOutput(f"rescore: {folder} was written by an older version, without the hashes of its episode lists; run it again.")
    for suite, digest in study["lists"].items():
        if suites.lists.digest(suite) != digest:
            raise BadOutput(f"rescore: the list of {suite} has changed since {folder} was run; its states fit no row of today. Run it again.")
    rows = {
        (r.suite, r.task, r.seed, r.episode): r
        for suite, task in study["tasks"]
        for r in suites.listed(suite, task, study["episodes"], study["seed"], study["seeds"])
    }
    stored = {tuple(row[name] for name in KEY): row for row in table.to_dict("records")}
    again: list[dict[str, Any]] = []
    judged, changed = set(), []
    for key, truths in traces.read(folder):
        if key not in stored or stored[key]["outcome"] == "error":
            continue
        suite, task, _, seed, episode = key
        row = rows[suite, task, seed, episode]
        outcome = rejudge(row, {place.model: extent_m(get(place.model)) for place in row.placements}, truths).outcome()
        ruled = {name: getattr(outcome, name) for name in RULED}
        judged.add(key)
        again.append({str(name): cell for name, cell in stored[key].items()} | {"outcome": outcome.status} | ruled)
        if any(stored[key][name] is not cell and stored[key][name] != cell for name, cell in ruled.items()):
            changed.append(" ".join(str(part) for part in key))
    kept = [{str(name): cell for name, cell in row.items()} for key, row in stored.items() if key not in judged]
    scores = ordered(score(again + kept), study["tasks"], study["methods"])
    verdict = f"{len(changed)} of {len(again)} episodes judged differently" + (": " + "; ".join(changed[:10]) if changed else "")
    return "\n".join([results_table(scores), "", f"{verdict}; {len(kept)} without a saved state or in error kept as they were."])
