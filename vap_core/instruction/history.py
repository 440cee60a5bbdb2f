"""What was asked for before: one line of JSON per use, beside the remembered objects."""

import json
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from vap_core.base.errors import BadMemory
from vap_core.base.files import folder_locked, parse_json, read_file, write_atomic, writing
from vap_core.base.types import value

FILE = "history.jsonl"
MAX_USES = 1000
"""So many uses are read, the last ones."""


@value
class Use:
    """One object that was asked for: by whom ("" where nobody said), and when (ISO 8601)."""

    object: str
    by: str
    at: str

    def __post_init__(self) -> None:
        datetime.fromisoformat(self.at)


def read_uses(bank: Path) -> tuple[Use, ...]:
    """The uses that a memory keeps, oldest first; none where there is no history yet.

    Raises: BadMemory: it cannot be read, or a line is damaged.
    """
    path = bank / FILE
    uses = []
    try:
        for line in _lines(path)[-MAX_USES:]:
            row = parse_json(line.decode("utf-8"))
            uses.append(Use(object=row["object"], by=row["by"], at=row["at"]))
    except (FileNotFoundError, NotADirectoryError):
        return ()
    except OSError as error:
        raise BadMemory(
            f"history: {path} cannot be read ({error.strerror or error}); check its permissions, "
            "or choose another folder with --memory."
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise BadMemory(
            f"history: {path} is damaged ({type(error).__name__}); delete it to start a new one."
        ) from error
    return tuple(uses)


def add_uses(bank: Path, objects: Sequence[str], by: str, at: datetime) -> None:
    """Add one use per object; the last MAX_USES uses are kept. Raises: BadOutput."""
    if not objects:
        return
    added = []
    for name in objects:
        row = {"object": name, "by": by, "at": at.isoformat(timespec="seconds")}
        added.append(json.dumps(row, ensure_ascii=False).encode("utf-8"))
    path = bank / FILE
    with writing(bank, "history", "choose another folder with --memory"):
        bank.mkdir(parents=True, exist_ok=True)
        with folder_locked(bank):
            lines = _lines(path) if path.exists() else []
            whole = [*lines, *added][-MAX_USES:]
            write_atomic(path, b"".join(line + b"\n" for line in whole))


def _lines(path: Path) -> list[bytes]:
    """The lines of a history; not one without an end, of which the writing failed.

    Raises: OSError.
    """
    *lines, _ = read_file(path).split(b"\n")
    return [line for line in lines if line.strip()]
