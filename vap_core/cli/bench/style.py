"""Line lengths, comprehensions and file sizes of the source, beside those of other packages."""

import ast
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import vap_core
from vap_core.base.tables import align

ANCHORS = {
    "mink": (82, 0.2, 0.3),
    "optimistix": (86, 0.0, 0.0),
    "supervision": (82, 0.7, 0.4),
    "Gymnasium": (113, 0.9, 0.2),
    "lerobot": (94, 0.8, 0.7),
}
"""95th percentile of line lengths, and comprehensions and ternaries per 100 lines, of packages."""
COMPREHENSIONS = ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp


@dataclass(frozen=True)
class Style:
    """Figures of some source files; lines that are empty do not count."""

    lines: int
    line_length_p95: float
    comprehensions: int
    ternaries: int
    longest_file: int

    def per_100_lines(self, count: int) -> float:
        """A count of something per 100 lines."""
        return 100 * count / max(self.lines, 1)


def measure(paths: list[Path]) -> Style:
    """The figures of some source files together."""
    lengths: list[int] = []
    comprehensions = 0
    ternaries = 0
    longest = 0
    for path in paths:
        text = path.read_text()
        lines = text.splitlines()
        longest = max(longest, len(lines))
        for line in lines:
            if line.strip():
                lengths.append(len(line))
        for node in ast.walk(ast.parse(text)):
            comprehensions += isinstance(node, COMPREHENSIONS)
            ternaries += isinstance(node, ast.IfExp)
    return Style(
        lines=len(lengths),
        line_length_p95=float(np.percentile(lengths, 95)) if lengths else 0.0,
        comprehensions=comprehensions,
        ternaries=ternaries,
        longest_file=longest,
    )


def run() -> str:
    """A row per folder of the package, one for all of it, and one per anchor."""
    root = Path(vap_core.__file__).parent
    header = ["", "files", "lines", "p95 of line length", "comprehensions", "ternaries", "longest"]
    rows = [header]
    for folder in sorted(root.iterdir()):
        if folder.is_dir() and folder.name != "__pycache__":
            rows.append(_row(f"{folder.name}/", sorted(folder.rglob("*.py"))))
    rows.append(_row("the method", sorted(root.glob("*.py"))))
    rows.append(_row("vap_core", sorted(root.rglob("*.py"))))
    for name, (length, comprehensions, ternaries) in ANCHORS.items():
        rows.append([name, "", "", str(length), f"{comprehensions:.1f}", f"{ternaries:.1f}", ""])
    return f"{align(rows)}\n\nComprehensions and ternaries are counts per 100 lines."


def _row(name: str, paths: list[Path]) -> list[str]:
    style = measure(paths)
    return [
        name,
        str(len(paths)),
        str(style.lines),
        f"{style.line_length_p95:.0f}",
        f"{style.per_100_lines(style.comprehensions):.1f}",
        f"{style.per_100_lines(style.ternaries):.1f}",
        str(style.longest_file),
    ]
