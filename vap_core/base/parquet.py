"""The tables that commands write and read again: Parquet files, read in one place."""

import errno
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.errors import BadOutput
from vap_core.base.files import check_regular

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

UNOPENED = (errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE, errno.EIO, errno.ENOMEM)
"""Errors of opening or reading a file that say nothing of what it holds."""


def read_arrow(path: Path, caller: str, remedy: str) -> "pa.Table":
    """A table with its notes.

    Raises: BadOutput, of one line. It ends with the `remedy`, unless the table only cannot be
        opened: then nothing says that it is damaged.
    """
    from pyarrow import ArrowException
    from pyarrow.parquet import read_table

    try:
        check_regular(path)
        return read_table(path)
    except (UnicodeEncodeError, OSError) as error:
        if isinstance(error, OSError) and error.errno not in UNOPENED:
            raise BadOutput(f"{caller}: {path} is damaged; {remedy}.") from error
        reason = getattr(error, "strerror", None) or "a name that is no text"
        raise BadOutput(
            f"{caller}: {ascii(str(path))[1:-1]} cannot be opened ({reason}); the table may be "
            "whole: mend that, and run the same command again."
        ) from error
    except (ArrowException, ValueError) as error:
        raise BadOutput(f"{caller}: {path} is damaged; {remedy}.") from error


def read_parquet(path: Path, caller: str, remedy: str) -> "pd.DataFrame":
    """The rows of a table. Raises: BadOutput, of one line that ends with the `remedy`."""
    return read_arrow(path, caller, remedy).to_pandas()
