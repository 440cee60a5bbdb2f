"""SQL on any tables."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

from vap_core.base.errors import BadStudy

if TYPE_CHECKING:
    import pandas as pd
    from datafusion import SessionContext

LONGEST, DEEPEST = 4_000, 40
"""Characters and nested brackets of a condition. The parser recurses: far more end the process."""
FUNCTIONS = frozenset(
    "abs ceil char_length character_length coalesce contains ends_with exp floor greatest isnan "
    "least left length ln log10 lower nullif power regexp_like right round signum sqrt "
    "starts_with strpos substr substring trim btrim trunc upper".split()
)
"""What a condition may call. Others can make a value of any length, and exhaust the memory."""
LINE = "__vap_line__"
"""The column with a row's number; no table of ours has one of this name."""


def rows_matching(table: "pd.DataFrame", condition: str) -> "pd.DataFrame":
    """The rows for which a SQL condition holds, such as "margin < 0.05 and success = false".

    Raises: BadStudy.
    """
    flat = table.reset_index(drop=True)
    with _asked({"episodes": flat.assign(**{LINE: flat.index})}, condition) as context:
        lines: list[int] = []
        for batch in context.table("episodes").filter(condition).select(LINE).collect():
            lines += batch[LINE].to_pylist()
    return flat.loc[sorted(lines)]


def select(tables: "Mapping[str, pd.DataFrame]", sql: str) -> "pd.DataFrame":
    """What a SQL query over tables finds; it can change nothing. Raises: BadStudy."""
    from datafusion import SQLOptions

    options = SQLOptions().with_allow_ddl(False).with_allow_dml(False).with_allow_statements(False)
    with _asked(tables, sql) as context:
        return context.sql_with_options(sql, options).to_pandas()


@contextmanager
def _asked(tables: "Mapping[str, pd.DataFrame]", sql: str) -> "Iterator[SessionContext]":
    """A session with some tables; what is wrong with a question to them is one line."""
    import pyarrow as pa

    _check_size(sql)
    context = _small_context()
    for name, table in tables.items():
        arrow = pa.Table.from_pandas(table, preserve_index=False)
        # A table without rows has no batch, and datafusion panics at none.
        batches = arrow.to_batches() or [pa.RecordBatch.from_pylist([], schema=arrow.schema)]
        context.register_record_batches(name, [batches])
    try:
        yield context
    except Exception as error:  # datafusion raises bare exceptions
        reason = " ".join(str(error).split())[:200]
        columns = "; of ".join(
            f"{name} its columns are {', '.join(str(c) for c in table.columns if c != LINE)}"
            for name, table in tables.items()
        )
        raise BadStudy(
            f"condition: {sql[:200]!r} is none on this table ({reason}); {columns}."
        ) from error


def _check_size(condition: str) -> None:
    depth = deepest = 0
    for character in condition:
        depth += (character == "(") - (character == ")")
        deepest = max(deepest, depth)
    if len(condition) > LONGEST or deepest > DEEPEST:
        raise BadStudy(
            f"condition: it has {len(condition):,} characters and {deepest} nested brackets; "
            f"{LONGEST:,} and {DEEPEST} are the most."
        )


def _small_context() -> "SessionContext":
    """A session that knows FUNCTIONS alone."""
    from datafusion import SessionContext

    context = SessionContext()
    for name in context.udfs():
        if name not in FUNCTIONS:
            context.deregister_udf(name)
    return context
