"""Episode lists on disk: one JSON row per line, one file per suite, their hashes in the manifest.

Errors name row and field.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

from jaxtyping import TypeCheckError

from vap_core.base.errors import BadSuite
from vap_core.base.files import DATA, parse_json, read_file, write_atomic
from vap_core.simulation import robots
from vap_core.simulation.suites.suite import VARIANTS, Suite
from vap_core.simulation.types import EpisodeRow, Owned, Placement, SubGoal

FOLDER = DATA / "suites"
CLOSE_M = 0.02
"""Objects keep at least this far apart."""
FAR_M = 2.0
"""Objects stand within so much of the robot."""
FIELDS = (
    "suite", "task", "instruction", "category", "rule", "goal", "split", "variant", "episode",
    "seed", "max_steps", "cameras", "placements",
)  # fmt: skip
SHARED_FIELDS = ("speaker", "owned", "subgoals")
"""Of rows of shared scenes alone."""
WRONG_TYPE = re.compile(
    r"parameter '(?P<name>\w+)'\.\s*Actual value: (?P<found>.*?)\s*"
    r"Expected type: (?P<wanted>.*?)\.\s*(?:----|$)",
    re.DOTALL,
)
"""What jaxtyping says of a field whose value has another type than its annotation."""


def write(name: str, rows: Sequence[EpisodeRow], folder: Path = FOLDER) -> str:
    """Write a suite's list and enter it in the manifest; returns the file's sha256."""
    folder.mkdir(parents=True, exist_ok=True)
    data = "".join(map(to_line, rows)).encode()
    digest = hashlib.sha256(data).hexdigest()
    write_atomic(folder / f"{name}.jsonl", data)
    manifest = _manifest(folder) if (folder / "manifest.json").exists() else {}
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
    lines = data.decode(errors="replace").splitlines()
    rows = [_parse_row(line, f"{path.name} row {i}") for i, line in enumerate(lines, 1)]
    numbers: dict[str, int] = {}
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
        _check(row, f"row {i}")
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
    fields = {name: getattr(row, name) for name in FIELDS}
    fields["placements"] = [[place.model, place.x, place.y, place.yaw] for place in row.placements]
    if row.speaker or row.owned or row.subgoals:
        owned = [[each.model, each.owner, each.known_as] for each in row.owned]
        subgoals = [asdict(each) for each in row.subgoals]
        fields |= {"speaker": row.speaker, "owned": owned, "subgoals": subgoals}
    return json.dumps(fields, separators=(",", ":")) + "\n"


def _manifest(folder: Path) -> dict[str, Any]:
    path = folder / "manifest.json"
    try:
        return dict(parse_json(read_file(path)))
    except (OSError, ValueError, TypeError) as error:
        raise BadSuite(
            f"suites: {path} cannot be read; "
            "restore it, or run notebooks/01_benchmark_building.ipynb."
        ) from error


def _parse_row(line: str, where: str) -> EpisodeRow:
    """One line as a row, every field checked."""
    try:
        fields = parse_json(line)
    except ValueError as error:
        raise BadSuite(f"suites: {where} is not JSON ({error}).") from error
    if not isinstance(fields, dict) or {*fields} - {*SHARED_FIELDS} != {*FIELDS}:
        odd = sorted({*FIELDS} ^ ({*fields} - {*SHARED_FIELDS})) if isinstance(fields, dict) else []
        raise BadSuite(
            f"suites: {where}, field {(odd or ['everything'])[0]!r}: missing or unknown; a row has "
            f"{', '.join(sorted(FIELDS))}."
        )
    for name, make in NESTED.items():
        given = fields.get(name, [])
        try:
            if not isinstance(given, list):
                raise TypeError(f"{given!r} is no list")
            fields[name] = tuple(make(each) for each in given)
        except (TypeError, ValueError) as error:
            raise BadSuite(f"suites: {where}, field {name!r}: {said(error)}") from error
    try:
        row = EpisodeRow(**fields)
    except TypeError as error:
        raise BadSuite(f"suites: {where}: {said(error)}") from error
    _check(row, where)
    return row


NESTED: Mapping[str, Callable[[Any], Any]] = {
    "placements": lambda each: Placement(each[0], *map(float, each[1:])),
    "cameras": lambda name: name,
    "owned": lambda each: Owned(each[0], each[1], *map(tuple, each[2:])),
    "subgoals": lambda each: SubGoal(**each),
}
"""Fields that hold lists, and what their entries become."""


def said(error: BaseException) -> str:
    """An error as one line: of a field of another type than its annotation, what it must be."""
    wrong = WRONG_TYPE.search(str(error)) if isinstance(error, TypeCheckError) else None
    if wrong is None:
        return f"{type(error).__name__}: {' '.join(str(error).split()).removesuffix('.')}."
    found, wanted = " ".join(wrong["found"].split()), wrong["wanted"].removeprefix("typing.")
    if wanted.startswith("<class '"):
        wanted = wanted[8:-2].rpartition(".")[2]
    mend = f"it must be of type {wanted}"
    if found.startswith("[") and wanted.startswith("tuple"):
        mend = "it must be a tuple, in round brackets"
    elif wanted == "float":
        mend = "it must be a float"
        if found.lstrip("-").isdecimal():
            mend += f", as in {found}.0"
    short = found if len(found) <= 60 else f"{found[:60]}..."
    return f"{wrong['name']} is {short}; {mend}."


def _check(row: EpisodeRow, where: str) -> None:
    for field, reason in _faults(row):
        raise BadSuite(f"suites: {where}, field {field!r}: {reason}.")


def _faults(row: EpisodeRow) -> Iterator[tuple[str, str]]:
    """The fields that will not do, and why."""
    for name, least in (("episode", 0), ("seed", 0), ("max_steps", 1)):
        if getattr(row, name) < least:
            yield name, f"{getattr(row, name)} is less than {least}"
    if row.variant not in VARIANTS:
        yield "variant", f"{row.variant!r} is unknown; known: {', '.join(VARIANTS)}"
    names = [place.model for place in row.placements]
    if not names:
        yield "placements", "empty; the first one is the target"
    for place in row.placements:
        away_m = max(abs(place.x), abs(place.y))
        if not away_m <= FAR_M or not abs(place.yaw) < 1e6:
            yield (
                "placements",
                f"{place.model!r} stands {away_m:g} m away, turned by {place.yaw:g}; metres, "
                f"within {FAR_M:g} of the robot, and radians",
            )
    if len(set(names)) < len(names):
        yield "placements", f"an object is placed twice in {names}"
    for one, other in combinations(row.placements, 2):
        if max(abs(one.x - other.x), abs(one.y - other.y)) < CLOSE_M:
            yield (
                "placements",
                f"{other.model!r} and {one.model!r} stand in the same place; objects keep at least "
                f"{CLOSE_M} m apart",
            )
    needs_goal = bool(row.goal) if row.rule == "official" else row.rule in ("near", "put")
    if bool(row.goal) != needs_goal or row.goal not in ("", *names[1:]):
        yield (
            "goal",
            f"{row.goal!r} for rule {row.rule!r}; near and put name a placed object other than the "
            "target, the others none",
        )
    for each in row.owned:
        if each.model not in names:
            yield "owned", f"{each.model!r} is not placed"
    for step in row.subgoals:
        others = {*names} - {step.target}
        goals = others if step.rule in ("near", "put") else {""}
        if step.target not in names or step.goal not in goals or step.max_steps < 1:
            yield "subgoals", f"{step.rule} {step.target!r} with the goal {step.goal!r} will not do"
    if row.subgoals and row.subgoals[0].target != names[0]:
        yield "subgoals", f"the first is about {row.subgoals[0].target!r}, not the target"
