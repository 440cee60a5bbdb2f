"""The one printer of tables: aligned text, Markdown, HTML or CSV.

Text that came from files is escaped here, where it leaves: control characters, and what Markdown,
HTML or a spreadsheet would take for more than text.
"""

import re
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any, Literal

from vap_core.base.errors import printable

if TYPE_CHECKING:
    import pandas as pd

type Style = Literal["text", "markdown", "html", "csv"]
FORMULA = re.compile(r"[=@\uff1d\uff20\uff0b\uff0d\t\r\n]|[+-](?![\d.]*$)")
"""How a cell begins that a spreadsheet would compute."""


def printed(table: "pd.DataFrame | Sequence[Sequence[str]]", style: Style = "text") -> str:
    """A table, or rows of text of which the first is the header; what is not defined is "-"."""
    import pandas as pd
    from tabulate import tabulate

    if style == "csv":
        frame = (
            table if isinstance(table, pd.DataFrame) else pd.DataFrame(table[1:], columns=table[0])
        )
        texts = frame.select_dtypes(exclude=["number", "bool"]).columns
        return frame.assign(**{name: frame[name].map(_no_formula) for name in texts}).to_csv(
            index=False
        )
    if isinstance(table, pd.DataFrame):
        table = [list(map(str, table.columns)), *table.itertuples(index=False, name=None)]
    head, *body = [[text_of(cell) for cell in row] for row in table]
    if style == "html":
        rows = [[f"<th>{escape(cell)}</th>" for cell in head]]
        rows += [[f"<td>{escape(cell)}</td>" for cell in row] for row in body]
        lines = "".join(f"<tr>{''.join(row)}</tr>" for row in rows)
        return f"<div class='wide'><table>{lines}</table></div>"
    if style == "markdown":
        head, *body = [list(map(_in_markdown, row)) for row in (head, *body)]
    form = {"text": "simple", "markdown": "github"}[style]
    text = tabulate(body, headers=head, tablefmt=form, disable_numparse=True)
    return "\n".join(line.rstrip() for line in text.splitlines())


def text_of(cell: Any) -> str:
    """A cell as one line of printable text."""
    if cell is None or cell != cell:
        return "-"
    return printable(f"{cell:.6g}" if isinstance(cell, float) else str(cell), "")


def _in_markdown(cell: str) -> str:
    """Text in which Markdown finds no tag, entity, link or picture, and no other column.

    "p < 0.001" is no tag.
    """
    text = re.sub(r"<(?=[A-Za-z/!?])", "&lt;", re.sub(r"&(?=#?\w+;)", "&amp;", cell))
    return re.sub(r"(\\*)\|", r"\1\1\\|", text.replace("](", "]\\("))


def _no_formula(cell: Any) -> Any:
    return f"'{cell}" if isinstance(cell, str) and FORMULA.match(cell) else cell


def percent(fraction: float) -> str:
    """A fraction as percent without the sign, "-" where it is not defined."""
    return "-" if fraction != fraction else f"{100 * fraction:.1f}"


def percent_interval(middle: float, low: float, high: float) -> str:
    """A fraction and its interval as percent without the sign, "-" where it is not defined."""
    return "-" if low != low else f"{100 * middle:.1f} [{100 * low:.1f}, {100 * high:.1f}]"
