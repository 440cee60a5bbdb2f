"""Rows of text cells as aligned text and Markdown; the first is the header."""

from collections.abc import Sequence

Rows = Sequence[Sequence[str]]
"""The header first; every row has as many cells."""


def align(rows: Rows) -> str:
    """Plain text with aligned columns."""
    return _render(rows, "simple")


def markdown(rows: Rows) -> str:
    """A pipe table that is aligned as plain text, too."""
    safe = []
    for row in rows:
        safe.append([cell.replace("|", "\\|") for cell in row])
    return _render(safe, "github")


def signed(value: float, digits: int = 0) -> str:
    """A rounded number with its sign: "+3", "-0.4"; "+0" for all that rounds to zero."""
    return f"{value:+z.{digits}f}"


def signed_interval(middle: float, low: float, high: float, digits: int = 0) -> str:
    """A signed number and its interval: "+3 [-1, +7]"."""
    return f"{signed(middle, digits)} [{signed(low, digits)}, {signed(high, digits)}]"


def _render(rows: Rows, style: str) -> str:
    from tabulate import tabulate

    text = tabulate(rows[1:], headers=rows[0], tablefmt=style, disable_numparse=True)
    return "\n".join(line.rstrip() for line in text.splitlines())
