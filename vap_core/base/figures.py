"""Matplotlib figures: an empty one, and a reproducible file. Their colours are in `palette`."""

from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.files import replacing
from vap_core.base.palette import FRAME, LOOKALIKES, METHODS, ROLES, SUITES, TARGET, TIERS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WINNER, OTHER = TARGET, LOOKALIKES[0]
"""The elected candidate or the target; every other one."""
GENERIC, OURS = FRAME, METHODS["vap"][0]
TIER_COLOURS = TIERS
LINE_COLOURS = tuple(SUITES[name][0] for name in ("simpler-fractal", "vlabench", "simpler-bridge"))
"""The curves of what is no suite."""
BAR_COLOURS = (*LINE_COLOURS[:2], ROLES["other objects"], LINE_COLOURS[2])
"""The bars of a group, in their order; told apart in grey, too."""
POLICY_MARKERS = ("o", "^", "s", "v", "X")
"""Markers of a method's policies where its colour alone says the method, in the order of
appearance."""
FURTHER_POLICY_MARKERS = ("d", "*", "8")
"""Markers of a method's third policy and all further ones where the first two have the method's
own, filled and then hollow, as these are."""


def empty_figure(width: float, height: float) -> "Figure":
    """A figure of that size (inches) with constrained layout; matplotlib loads when this is
    called."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def write_png(figure: "Figure", path: Path, dpi: int = 110) -> None:
    """Save a figure; the file is whole or absent, and depends on nothing but the figure."""
    with replacing(path) as part:
        figure.savefig(part, dpi=dpi, format="png", metadata={"Software": None})
