"""lerobot's policies, imported in less time: a process that imports this has them ready.

transformers asks at its import which distribution every installed package is of. Python's answer
parses the metadata once for every package and looks for every installed file: over a second. The
names alone are in the lists of files.
"""

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import Distribution, distributions
from inspect import getmodulename
from pathlib import PurePosixPath
from unittest.mock import patch


def distributions_of_packages() -> dict[str, list[str]]:
    """What importlib.metadata.packages_distributions says, but for files that were deleted."""
    found: dict[str, list[str]] = {}
    for distribution in distributions():
        name = _name(distribution)
        for package in _packages(distribution):
            found.setdefault(package, []).append(name)
    return found


@contextmanager
def quick_distributions() -> Iterator[None]:
    """Within this block packages_distributions is the quick one."""
    with patch("importlib.metadata.packages_distributions", distributions_of_packages):
        yield


def _name(distribution: Distribution) -> str:
    """The name in a distribution's metadata, of which only that line is parsed."""
    for line in (distribution.read_text("METADATA") or "").splitlines():
        key, _, value = line.partition(":")
        if key.lower() == "name":
            return value.strip()
        if not line:
            break
    return distribution.name


def _packages(distribution: Distribution) -> list[str]:
    """The packages and modules that a distribution says it brings, else those of its files."""
    declared = (distribution.read_text("top_level.txt") or "").split()
    if declared:
        return declared
    record = distribution.read_text("RECORD")
    if record is None:
        files = [str(file) for file in distribution.files or ()]
    else:
        files = [row[0] for row in csv.reader(record.splitlines()) if row]
    names: dict[str, None] = {}
    for file in files:
        parts = PurePosixPath(file).parts
        name = parts[0] if len(parts) > 1 else getmodulename(file)
        if name is not None and "." not in name:
            names[name] = None
    return list(names)


with quick_distributions():
    import lerobot.policies  # noqa: F401
