"""The tables that commands write and read again: Parquet files, read in one place."""

from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.errors import BadOutput
from vap_core.base.files import check_regular

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


def read_arrow(path: Path, caller: str, remedy: str) -> "pa.Table":
    """A table with its notes. Raises: BadOutput, of one line that ends with the `remedy`."""
    from pyarrow import ArrowException
    from pyarrow.parquet import read_table

    try:
        check_regular(path)
        return read_table(path)
    except (ArrowException, OSError, ValueError) as error:
        raise BadOutput(f"{caller}: {path} is damaged; {remedy}.") from error


def read_parquet(path: Path, caller: str, remedy: str) -> "pd.DataFrame":
    """The rows of a table. Raises: BadOutput, of one line that ends with the `remedy`."""
    return read_arrow(path, caller, remedy).to_pandas()
