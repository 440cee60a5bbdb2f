"""Rows of cells as aligned text, as Markdown and as LaTeX (booktabs)."""

from collections.abc import Sequence

Rows = Sequence[Sequence[str]]
"""The heads first, then the lines; every row has as many cells."""
_LATEX = str.maketrans({char: f"\\{char}" for char in "%&_#${}"} | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"})


def align(rows: Rows) -> str:
    """Plain text, the columns under one another."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    ruled = [rows[0], ["-" * width for width in widths], *rows[1:]]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in ruled)


def markdown(rows: Rows) -> str:
    """A pipe table that reads well as plain text, too."""
    safe = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    widths = [max(3, *(len(row[i]) for row in safe)) for i in range(len(safe[0]))]
    ruled = [safe[0], ["-" * width for width in widths], *safe[1:]]
    return "\n".join(f"| {' | '.join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))} |" for row in ruled)


def latex(rows: Rows) -> str:
    """A booktabs tabular."""
    lines = [" & ".join(map(escape, row)) + r" \\" for row in rows]
    top = [rf"\begin{{tabular}}{{{'l' * len(rows[0])}}}", r"\toprule", lines[0], r"\midrule"]
    return "\n".join([*top, *lines[1:], r"\bottomrule", r"\end{tabular}", ""])


def escape(cell: str) -> str:
    """Text that LaTeX prints as it stands."""
    return cell.translate(_LATEX)
