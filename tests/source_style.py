"""Line lengths, comprehensions and file sizes of source files, and those of other packages."""

import ast
from dataclasses import dataclass
from pathlib import Path

import numpy as np

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
