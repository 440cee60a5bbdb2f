"""A SQL condition on any table."""

from typing import TYPE_CHECKING

from vap_core.base.errors import BadStudy

if TYPE_CHECKING:
    import pandas as pd


def rows_matching(table: "pd.DataFrame", condition: str) -> "pd.DataFrame":
    """The rows for which a SQL condition holds, such as "margin < 0.05 and success = false".

    Raises: BadStudy.
    """
    import pyarrow as pa
    from datafusion import SessionContext

    flat = table.reset_index(drop=True)
    arrow = pa.Table.from_pandas(flat.assign(line=flat.index), preserve_index=False)
    lines: list[int] = []
    try:
        context = SessionContext()
        context.register_record_batches("episodes", [arrow.to_batches()])
        for batch in context.table("episodes").filter(condition).select("line").collect():
            lines += batch["line"].to_pylist()
    except Exception as error:  # datafusion raises bare exceptions
        reason = " ".join(str(error).split())[:200]
        columns = ", ".join(map(str, table.columns))
        raise BadStudy(
            f"condition: {condition!r} is none on this table ({reason}); its columns are {columns}."
        ) from error
    return flat.loc[sorted(lines)]
