"""CSV files of named columns: those that people write are read with the number of each line."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from vap_core.base.errors import VapError
from vap_core.base.files import check_regular, write_atomic


def write_rows(path: Path, rows: Iterable[Sequence[object]]) -> None:
    """Write rows, the columns' names first; a cell with a comma or a quote is quoted.

    Raises: OSError.
    """
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_atomic(path, text.getvalue().encode())


def read_rows(
    path: Path,
    columns: Sequence[str],
    *,
    optional: Sequence[str] = (),
    caller: str,
    error: type[VapError],
) -> list[tuple[int, dict[str, str]]]:
    """Every row that is not empty, with the number of its line; a cell that is absent is "".

    `caller` is the command that an error names.

    Raises: `error`, for a file that cannot be read, or that lacks one of `columns`.
    """
    names = (*columns, *optional)
    try:
        check_regular(path)
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            for name in columns:
                if name not in (reader.fieldnames or ()):
                    raise error(
                        f"{caller}: {path} lacks the column {name!r}; its first line is "
                        f"{','.join(names)}."
                    )
            rows = []
            for row in reader:
                cells = {name: (row.get(name) or "").strip() for name in names}
                if any(cells.values()):
                    rows.append((reader.line_num, cells))
            return rows
    except (OSError, UnicodeDecodeError, csv.Error) as failure:
        raise error(
            f"{caller}: {path} cannot be read ({failure!s:.100}); save it as UTF-8 with commas."
        ) from failure
