"""A condition in the words of SQL, on any table."""

from typing import TYPE_CHECKING

from vap_core.errors import BadStudy

if TYPE_CHECKING:
    import pandas as pd


def matching(table: "pd.DataFrame", where: str) -> "pd.DataFrame":
    """The rows for which a SQL condition holds, such as "margin < 0.05 and success = false". Raises: BadStudy."""
    import pyarrow as pa
    from datafusion import SessionContext

    flat = table.reset_index(drop=True)
    arrow = pa.Table.from_pandas(flat.assign(line=flat.index), preserve_index=False)
    try:
        context = SessionContext()
        context.register_record_batches("episodes", [arrow.to_batches()])
        held = [line for batch in context.table("episodes").filter(where).select("line").collect() for line in batch["line"].to_pylist()]
    except Exception as error:  # datafusion raises bare exceptions
        told = " ".join(str(error).split())[:200]
        raise BadStudy(f"condition: {where!r} is none on this table ({told}); its columns are {', '.join(map(str, table.columns))}.") from error
    return flat.loc[sorted(held)]
