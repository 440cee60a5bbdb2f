"""Rows of text cells as aligned text, Markdown and LaTeX (booktabs); the first is the header."""

from collections.abc import Sequence

Rows = Sequence[Sequence[str]]
"""The header first; every row has as many cells."""
_LATEX = str.maketrans(
    {
        "%": r"\%",
        "&": r"\&",
        "_": r"\_",
        "#": r"\#",
        "$": r"\$",
        "{": r"\{",
        "}": r"\}",
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
    }
)


def align(rows: Rows) -> str:
    """Plain text with aligned columns."""
    return _render(rows, "simple")


def markdown(rows: Rows) -> str:
    """A pipe table that is aligned as plain text, too."""
    safe = []
    for row in rows:
        safe.append([cell.replace("|", "\\|") for cell in row])
    return _render(safe, "github")


def latex(rows: Rows) -> str:
    """A booktabs tabular."""
    return _render(rows, "latex_booktabs") + "\n"


def escape(cell: str) -> str:
    """Text as LaTeX source that prints it unchanged."""
    return cell.translate(_LATEX)


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
