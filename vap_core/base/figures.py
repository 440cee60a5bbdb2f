"""Matplotlib figures: an empty one, a reproducible file, and the colours that figures share."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WINNER, OTHER = "#f28e2b", "#4e79a7"
"""The elected candidate or the target; every other one."""
GENERIC, OURS = "#9aa0a6", "#c0392b"
METHOD_COLOURS = {"generic": GENERIC, "vap": OURS}
TIER_COLOURS = {"personal": "#f28e2b", "hard": "#c0392b", "medium": "#b8860b", "easy": "#3a7d44"}
"""The personal object, and its look-alikes by hardness."""


def empty_figure(width: float, height: float) -> "Figure":
    """A figure of that size (inches) with constrained layout; matplotlib loads when this is
    called."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def write_png(figure: "Figure", path: Path, dpi: int = 110) -> None:
    """Save a figure; the file depends on nothing but the figure."""
    figure.savefig(path, dpi=dpi, metadata={"Software": None})
