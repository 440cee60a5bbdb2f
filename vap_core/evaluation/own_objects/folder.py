"""The folder that measure objects reads: imported objects, or 3-D files and a table of their kinds.

    objects.csv   file,category,height_cm,groups
    *.glb ...     the files

`height_cm` is empty where a file's units are metres; `groups` are words of one's own, joined by
semicolons, by which the report is split, or empty. A folder without objects.csv holds imported
objects, as `objects import --out` writes them.
"""

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from vap_core.base.commands import command
from vap_core.base.csv_rows import read_rows
from vap_core.base.errors import BadObject
from vap_core.base.types import value
from vap_core.memory import kind_instead
from vap_core.simulation.assets.scans import import_scan, storage

TABLE = "objects.csv"
COLUMNS = ("file", "category", "height_cm", "groups")


@value
class Source:
    """The objects of a folder by name, the files of those to be imported, and a checksum of all."""

    groups: Mapping[str, tuple[str, ...]]
    files: Mapping[str, Mapping[str, str]]
    sha256: str


def read_source(folder: Path) -> Source:
    """Read a folder in either form. Raises: BadObject, which names the line."""
    if not folder.is_dir():
        raise BadObject(
            f"measure objects: {folder} is no folder; see python -m vap_core measure objects "
            "--help."
        )
    if not (folder / TABLE).exists():
        return _imported(folder)
    groups: dict[str, tuple[str, ...]] = {}
    files: dict[str, Mapping[str, str]] = {}
    digest = hashlib.sha256()
    rows = read_rows(
        folder / TABLE, COLUMNS[:2], optional=COLUMNS[2:], caller="measure objects", error=BadObject
    )
    for line, row in rows:
        path = folder / row["file"]
        where = f"{folder / TABLE} line {line}"
        if not path.is_file():
            raise BadObject(f"measure objects: {where} names {row['file']!r}, which is not there.")
        name = import_scan.default_name(path)
        if name in groups:
            raise BadObject(f"measure objects: {where} names a second {name!r}; rename the file.")
        _check_category(row["category"], where)
        _check_height(row["height_cm"], where)
        groups[name] = tuple(word for word in map(str.strip, row["groups"].split(";")) if word)
        files[name] = row
        digest.update(f"{name} {row}".encode() + hashlib.sha256(path.read_bytes()).digest())
    if not groups:
        raise BadObject(f"measure objects: {folder / TABLE} names no file; give one in each line.")
    return Source(groups=groups, files=files, sha256=digest.hexdigest())


def import_missing(
    source: Source, folder: Path, target: Path, report: Callable[[str], None]
) -> dict[str, str]:
    """Import the files of a source that `target` lacks; why others cannot be, by name.

    Some ten seconds of CPU an object.

    Raises: BadOutput when `target` cannot be written.
    """
    refused = {}
    for name, row in source.files.items():
        if (target / name / storage.METADATA_FILE).exists():
            continue
        report(f"importing {name}")
        height_cm = float(row["height_cm"]) if row["height_cm"] else None
        try:
            metadata, scan = import_scan.import_scan(
                folder / row["file"],
                name,
                row["category"],
                height_cm=height_cm,
                report=lambda line: None,
            )
        except BadObject as error:
            refused[name] = f"{error}{_by_itself(folder, row, str(error))}"
            continue
        storage.save_scan(target, metadata, scan, replace=True)
    return refused


def _by_itself(folder: Path, row: Mapping[str, str], error: str) -> str:
    """How to import a file with the option that an error names; "" where it names none."""
    if " --" not in error:
        return ""
    words = ["objects", "import", str(folder / row["file"]), "--category", row["category"]]
    if row["height_cm"]:
        words += ["--height-cm", row["height_cm"]]
    if "pass --repair" in error:
        words.append("--repair")
    return f" Run: {command(*words, '--out', 'DIR')}; then measure objects DIR."


@contextmanager
def objects_in(folder: Path) -> Iterator[None]:
    """Look own objects up in `folder`, in this process and in those that it starts."""
    before = os.environ.get(storage.VARIABLE)
    os.environ[storage.VARIABLE] = str(folder.resolve())
    try:
        yield
    finally:
        if before is None:
            del os.environ[storage.VARIABLE]
        else:
            os.environ[storage.VARIABLE] = before


def _imported(folder: Path) -> Source:
    """A folder of imported objects."""
    groups: dict[str, tuple[str, ...]] = {}
    digest = hashlib.sha256()
    for path in sorted(folder.glob(f"[!.]*/{storage.METADATA_FILE}")):
        groups[path.parent.name] = ()
        digest.update(path.parent.name.encode() + path.read_bytes())
    if not groups:
        raise BadObject(
            f"measure objects: {folder} holds neither {TABLE} nor imported objects; write a line "
            f"{','.join(COLUMNS)} for every 3-D file into {folder / TABLE}."
        )
    return Source(groups=groups, files={}, sha256=digest.hexdigest())


def _check_category(text: str, where: str) -> None:
    kind = kind_instead(text)
    if kind:
        raise BadObject(
            f"measure objects: {where} has the category {text!r}; name the kind of thing alone, in "
            f"words, for example {kind}."
        )


def _check_height(text: str, where: str) -> None:
    if not text:
        return
    try:
        fits = 0 < float(text) < 1000
    except ValueError:
        fits = False
    if not fits:
        raise BadObject(
            f"measure objects: {where} has the height {text!r}; give centimetres, or nothing where "
            "the file's units are metres."
        )
