"""Episode lists on disk: one JSON row a line, one file a suite, their hashes in the manifest; whatever is wrong is said by row and field."""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, get_args

from vap_core.base.errors import BadSuite
from vap_core.base.files import DATA, write_atomic
from vap_core.simulation.suites.variants import VARIANTS
from vap_core.simulation.types import EpisodeRow, Placement, SuccessRule

FOLDER = DATA / "suites"
CLOSE_M = 0.02
FAR = 1e6
"""No honest number in a row is larger; nan and inf are not smaller either."""
_TEXT = ("suite", "task", "instruction", "category", "rule", "goal", "split", "variant")
_COUNT = ("episode", "seed", "max_steps")
_FIELDS = {*_TEXT, *_COUNT, "placements", "cameras"}


def write(name: str, rows: Sequence[EpisodeRow], folder: Path = FOLDER) -> str:
    """Write a suite's list and enter it in the manifest; returns the file's sha256."""
    folder.mkdir(parents=True, exist_ok=True)
    data = "".join(json.dumps(_to_json(row), separators=(",", ":")) + "\n" for row in rows).encode()
    digest = hashlib.sha256(data).hexdigest()
    write_atomic(folder / f"{name}.jsonl", data)
    listed = {
        **_manifest(folder, missing_is_empty=True),
        name: {"sha256": digest, "episodes": len(rows)},
    }
    write_atomic(
        folder / "manifest.json", (json.dumps(listed, indent=1, sort_keys=True) + "\n").encode()
    )
    read.cache_clear()
    return digest


@cache
def read(name: str, folder: Path = FOLDER) -> tuple[EpisodeRow, ...]:
    """Every row of a suite's list, in order.

    Raises:
        BadSuite: the file is absent, differs from its hash in the manifest, or holds a malformed row; the message names row and field.
    """
    path = folder / f"{name}.jsonl"
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadSuite(
            f"suites: {path} cannot be read ({error.strerror}); notebooks/01_benchmark_building.ipynb makes it."
        ) from error
    wanted = digest(name, folder)
    if hashlib.sha256(data).hexdigest() != wanted:
        raise BadSuite(
            f"suites: {path} changed since its hash {wanted[:12]} was taken; restore it (git checkout), or enter it anew with suites.lists.write."
        )
    rows = tuple(
        _row(line, f"{path.name} row {i}")
        for i, line in enumerate(data.decode(errors="replace").splitlines(), 1)
    )
    seen: dict[str, int] = {}
    for i, row in enumerate(rows, 1):
        if row.suite != name:
            raise BadSuite(
                f"suites: {path.name} row {i}, field 'suite': {row.suite!r} in the list of {name!r}."
            )
        if seen.setdefault(row.key, i) != i:
            raise BadSuite(
                f"suites: {path.name} row {i}, field 'episode': {row.episode} of task {row.task!r} is already row {seen[row.key]}."
            )
    return rows


def digest(name: str, folder: Path = FOLDER) -> str:
    """The sha256 that the manifest holds for a suite's list. Raises: BadSuite."""
    try:
        return str(_manifest(folder)[name]["sha256"])
    except (KeyError, TypeError) as error:
        raise BadSuite(
            f"suites: {folder / 'manifest.json'} has no hash of {name!r}; notebooks/01_benchmark_building.ipynb enters it."
        ) from error


def check(rows: Iterable[EpisodeRow]) -> None:
    """Refuse rows that could not be run. Raises: BadSuite, naming row and field."""
    for i, row in enumerate(rows, 1):
        _row(json.dumps(_to_json(row)), f"row {i}")


def _manifest(folder: Path, missing_is_empty: bool = False) -> dict[str, Any]:
    path = folder / "manifest.json"
    if missing_is_empty and not path.exists():
        return {}
    try:
        held = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise BadSuite(
            f"suites: {path} cannot be read; restore it, or run notebooks/01_benchmark_building.ipynb."
        ) from error
    if not isinstance(held, dict):
        raise BadSuite(
            f"suites: {path} holds no table of hashes; restore it, or run notebooks/01_benchmark_building.ipynb."
        )
    return held


def _to_json(row: EpisodeRow) -> dict[str, Any]:
    plain = {name: getattr(row, name) for name in (*_TEXT, *_COUNT)}
    return {
        **plain,
        "cameras": list(row.cameras),
        "placements": [[p.model, p.x, p.y, p.yaw] for p in row.placements],
    }


def _row(line: str, where: str) -> EpisodeRow:
    """One line as a row, every field checked."""

    def bad(field: str, why: str) -> BadSuite:
        return BadSuite(f"suites: {where}, field {field!r}: {why}.")

    try:
        raw = json.loads(line)
    except ValueError as error:
        raise BadSuite(f"suites: {where} is not JSON ({error}).") from error
    if not isinstance(raw, Mapping) or set(raw) != _FIELDS:
        odd = sorted(_FIELDS ^ set(raw)) if isinstance(raw, Mapping) else ["everything"]
        raise bad(odd[0], f"missing or unknown; a row has {', '.join(sorted(_FIELDS))}")
    for name in _TEXT:
        if not isinstance(raw[name], str):
            raise bad(name, f"{raw[name]!r} is no text")
    for name in _COUNT:
        if type(raw[name]) is not int or raw[name] < (name == "max_steps"):
            raise bad(
                name,
                f"{raw[name]!r} is no {'positive ' if name == 'max_steps' else ''}whole number",
            )
    if raw["rule"] not in get_args(SuccessRule):
        raise bad("rule", f"{raw['rule']!r} is unknown; known: {', '.join(get_args(SuccessRule))}")
    if raw["variant"] not in VARIANTS:
        raise bad("variant", f"{raw['variant']!r} is unknown; known: {', '.join(VARIANTS)}")
    if not isinstance(raw["cameras"], list) or not all(
        isinstance(name, str) for name in raw["cameras"]
    ):
        raise bad("cameras", f"{raw['cameras']!r} is no list of camera names")
    places = raw["placements"]
    if not isinstance(places, list) or not places:
        raise bad("placements", "empty; the first one is the target")
    for i, place in enumerate(places):
        if not (isinstance(place, list) and len(place) == 4 and isinstance(place[0], str)):
            raise bad("placements", f"number {i} is {place!r}, not [model, x, y, yaw]")
        if not all(type(number) in (int, float) and abs(number) < FAR for number in place[1:]):
            raise bad(
                "placements",
                f"{place[0]!r} stands at {place[1:]}; x, y (m) and yaw (rad) must be finite numbers",
            )
        if max(abs(place[1]), abs(place[2])) > 2.0:
            raise bad(
                "placements",
                f"{place[0]!r} stands {max(abs(place[1]), abs(place[2])):g} m away; metres, within 2 of the robot",
            )
        for other in places[:i]:
            if (
                place[0] != other[0]
                and max(abs(place[1] - other[1]), abs(place[2] - other[2])) < CLOSE_M
            ):
                raise bad(
                    "placements",
                    f"{place[0]!r} and {other[0]!r} stand in the same place; objects keep at least {CLOSE_M} m apart",
                )
    names = [place[0] for place in places]
    if len(set(names)) < len(names):
        raise bad("placements", f"an object is placed twice in {names}")
    if bool(raw["goal"]) != (raw["rule"] in ("near", "put")) or (
        raw["goal"] and raw["goal"] not in names[1:]
    ):
        raise bad(
            "goal",
            f"{raw['goal']!r} for rule {raw['rule']!r}; near and put name a placed object other than the target, the others none",
        )
    placed = tuple(Placement(model, float(x), float(y), float(yaw)) for model, x, y, yaw in places)
    return EpisodeRow(**{**raw, "placements": placed, "cameras": tuple(raw["cameras"])})
