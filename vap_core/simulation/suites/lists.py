"""Episode lists on disk: one JSON row per line, one file per suite, their hashes in the manifest.

Errors name row and field.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, get_args

from vap_core.base.errors import BadSuite
from vap_core.base.files import DATA, parse_json, read_file, write_atomic
from vap_core.simulation import robots
from vap_core.simulation.suites.shared_fields import BadField, from_json, to_json
from vap_core.simulation.suites.suite import Suite
from vap_core.simulation.suites.variants import VARIANTS
from vap_core.simulation.types import EpisodeRow, Placement, SuccessRule

FOLDER = DATA / "suites"
CLOSE_M = 0.02
"""Objects keep at least this far apart."""
FAR = 1e6
"""Every number of a placement is smaller; nan and inf are not."""
_TEXT = ("suite", "task", "instruction", "category", "rule", "goal", "split", "variant")
_COUNT = ("episode", "seed", "max_steps")
_FIELDS = {*_TEXT, *_COUNT, "placements", "cameras"}
_SHARED = {"speaker", "owned", "subgoals"}
"""Fields of a shared scene's rows; the others have none of them."""


def write(name: str, rows: Sequence[EpisodeRow], folder: Path = FOLDER) -> str:
    """Write a suite's list and enter it in the manifest; returns the file's sha256."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = []
    for row in rows:
        lines.append(to_line(row))
    data = "".join(lines).encode()
    digest = hashlib.sha256(data).hexdigest()
    write_atomic(folder / f"{name}.jsonl", data)
    manifest = _manifest(folder, missing_is_empty=True)
    manifest[name] = {"sha256": digest, "episodes": len(rows)}
    text = json.dumps(manifest, indent=1, sort_keys=True) + "\n"
    write_atomic(folder / "manifest.json", text.encode())
    read.cache_clear()
    return digest


@cache
def read(name: str, folder: Path = FOLDER) -> tuple[EpisodeRow, ...]:
    """Every row of a suite's list, in order.

    Raises: BadSuite when the file is absent, differs from its hash in the manifest, or holds a
        malformed row; the message names row and field.
    """
    path = folder / f"{name}.jsonl"
    try:
        data = read_file(path)
    except OSError as error:
        raise BadSuite(
            f"suites: {path} cannot be read ({error.strerror}); "
            "notebooks/01_benchmark_building.ipynb makes it."
        ) from error
    wanted = digest(name, folder)
    if hashlib.sha256(data).hexdigest() != wanted:
        raise BadSuite(
            f"suites: {path} changed since its hash {wanted[:12]} was taken; "
            "restore it (git checkout), or enter it anew with suites.lists.write."
        )
    rows = []
    numbers: dict[str, int] = {}
    lines = data.decode(errors="replace").splitlines()
    for i, line in enumerate(lines, 1):
        rows.append(_parse_row(line, f"{path.name} row {i}"))
    for i, row in enumerate(rows, 1):
        if row.suite != name:
            raise BadSuite(
                f"suites: {path.name} row {i}, field 'suite': "
                f"{row.suite!r} in the list of {name!r}."
            )
        if numbers.setdefault(row.key, i) != i:
            raise BadSuite(
                f"suites: {path.name} row {i}, field 'episode': {row.episode} of task "
                f"{row.task!r} is already row {numbers[row.key]}."
            )
    return tuple(rows)


def digest(name: str, folder: Path = FOLDER) -> str:
    """The sha256 that the manifest holds for a suite's list. Raises: BadSuite."""
    try:
        return str(_manifest(folder)[name]["sha256"])
    except (KeyError, TypeError) as error:
        raise BadSuite(
            f"suites: {folder / 'manifest.json'} has no hash of {name!r}; "
            "notebooks/01_benchmark_building.ipynb enters it."
        ) from error


def check(rows: Iterable[EpisodeRow], suite: Suite) -> None:
    """Refuse rows that could not be run. Raises: BadSuite, naming row and field."""
    n_joints = len(robots.get(suite.robot).joints)
    for i, row in enumerate(rows, 1):
        text = json.dumps(_to_json(row))
        _parse_row(text, f"row {i}")
        start = row.start
        for field, n, most in (
            ("start.offsets", len(start.offsets), len(row.placements)),
            ("start.joints_rad", len(start.joints_rad), n_joints),
        ):
            if n not in (0, most):
                raise BadSuite(f"suites: row {i}, field {field!r}: {n} entries, and not {most}.")
        for camera in row.cameras:
            if camera not in suite.cameras:
                raise BadSuite(
                    f"suites: row {i}, field 'cameras': {camera!r} is none of "
                    f"{', '.join(suite.cameras)}."
                )


def to_line(row: EpisodeRow) -> str:
    """A row as a line of a list."""
    return json.dumps(_to_json(row), separators=(",", ":")) + "\n"


def _manifest(folder: Path, missing_is_empty: bool = False) -> dict[str, Any]:
    path = folder / "manifest.json"
    if missing_is_empty and not path.exists():
        return {}
    try:
        manifest = parse_json(read_file(path))
    except (OSError, ValueError) as error:
        raise BadSuite(
            f"suites: {path} cannot be read; "
            "restore it, or run notebooks/01_benchmark_building.ipynb."
        ) from error
    if not isinstance(manifest, dict):
        raise BadSuite(
            f"suites: {path} holds no table of hashes; "
            "restore it, or run notebooks/01_benchmark_building.ipynb."
        )
    return manifest


def _to_json(row: EpisodeRow) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    for name in (*_TEXT, *_COUNT):
        fields[name] = getattr(row, name)
    fields["cameras"] = list(row.cameras)
    fields["placements"] = []
    for place in row.placements:
        fields["placements"].append([place.model, place.x, place.y, place.yaw])
    return {**fields, **to_json(row)}


def _parse_row(line: str, where: str) -> EpisodeRow:
    """One line as a row, every field checked."""
    try:
        fields = parse_json(line)
    except ValueError as error:
        raise BadSuite(f"suites: {where} is not JSON ({error}).") from error
    try:
        _check_fields(fields)
        _check_placements(fields["placements"])
        _check_goal(fields)
        shared = from_json(fields)
    except BadField as error:
        raise BadSuite(f"suites: {where}, field {error.field!r}: {error.reason}.") from None
    placements = []
    for model, x, y, yaw in fields["placements"]:
        placements.append(Placement(model=model, x=float(x), y=float(y), yaw=float(yaw)))
    fields["placements"] = tuple(placements)
    fields["cameras"] = tuple(fields["cameras"])
    return EpisodeRow(**{**fields, **shared})


def _check_fields(fields: Any) -> None:
    """The names of the fields, and the values of all but the placements and the goal."""
    expected = ", ".join(sorted(_FIELDS))
    if not isinstance(fields, Mapping):
        raise BadField("everything", f"missing or unknown; a row has {expected}")
    if set(fields) - _SHARED != _FIELDS:
        odd = sorted(_FIELDS ^ (set(fields) - _SHARED))
        raise BadField(odd[0], f"missing or unknown; a row has {expected}")
    for name in _TEXT:
        if not isinstance(fields[name], str):
            raise BadField(name, f"{fields[name]!r} is no text")
    for name in _COUNT:
        least = 1 if name == "max_steps" else 0
        if type(fields[name]) is not int or fields[name] < least:
            kind = "positive whole number" if least else "whole number"
            raise BadField(name, f"{fields[name]!r} is no {kind}")
    rules = get_args(SuccessRule)
    if fields["rule"] not in rules:
        raise BadField("rule", f"{fields['rule']!r} is unknown; known: {', '.join(rules)}")
    if fields["variant"] not in VARIANTS:
        known = ", ".join(VARIANTS)
        raise BadField("variant", f"{fields['variant']!r} is unknown; known: {known}")
    cameras = fields["cameras"]
    if not isinstance(cameras, list) or not all(isinstance(name, str) for name in cameras):
        raise BadField("cameras", f"{cameras!r} is no list of camera names")


def _check_placements(placements: Any) -> None:
    if not isinstance(placements, list) or not placements:
        raise BadField("placements", "empty; the first one is the target")
    for i, place in enumerate(placements):
        if not (isinstance(place, list) and len(place) == 4 and isinstance(place[0], str)):
            raise BadField("placements", f"number {i} is {place!r}, not [model, x, y, yaw]")
        model, x, y, yaw = place
        if not (_is_number(x) and _is_number(y) and _is_number(yaw)):
            raise BadField(
                "placements",
                f"{model!r} stands at {place[1:]}; x, y (m) and yaw (rad) must be finite numbers",
            )
        away_m = max(abs(x), abs(y))
        if away_m > 2.0:
            raise BadField(
                "placements",
                f"{model!r} stands {away_m:g} m away; metres, within 2 of the robot",
            )
        for other_model, other_x, other_y, _ in placements[:i]:
            apart_m = max(abs(x - other_x), abs(y - other_y))
            if model != other_model and apart_m < CLOSE_M:
                raise BadField(
                    "placements",
                    f"{model!r} and {other_model!r} stand in the same place; "
                    f"objects keep at least {CLOSE_M} m apart",
                )


def _is_number(number: Any) -> bool:
    """Whether it is an int or a float, and finite."""
    return type(number) in (int, float) and abs(number) < FAR


def _check_goal(fields: Mapping[str, Any]) -> None:
    names = [place[0] for place in fields["placements"]]
    if len(set(names)) < len(names):
        raise BadField("placements", f"an object is placed twice in {names}")
    goal = fields["goal"]
    needs_goal = fields["rule"] in ("near", "put")
    if bool(goal) != needs_goal or (goal and goal not in names[1:]):
        raise BadField(
            "goal",
            f"{goal!r} for rule {fields['rule']!r}; near and put name a placed object "
            "other than the target, the others none",
        )
