"""A SQL condition on any table."""

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
    import pyarrow as pa

    _check_size(condition)
    flat = table.reset_index(drop=True)
    arrow = pa.Table.from_pandas(flat.assign(**{LINE: flat.index}), preserve_index=False)
    lines: list[int] = []
    try:
        context = _small_context()
        # A table without rows has no batch, and datafusion panics at none.
        batches = arrow.to_batches() or [pa.RecordBatch.from_pylist([], schema=arrow.schema)]
        context.register_record_batches("episodes", [batches])
        for batch in context.table("episodes").filter(condition).select(LINE).collect():
            lines += batch[LINE].to_pylist()
    except Exception as error:  # datafusion raises bare exceptions
        reason = " ".join(str(error).split())[:200]
        columns = ", ".join(map(str, table.columns))
        raise BadStudy(
            f"condition: {condition[:200]!r} is none on this table ({reason}); its columns are "
            f"{columns}."
        ) from error
    return flat.loc[sorted(lines)]


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
