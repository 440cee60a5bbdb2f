"""Starting layouts: the independent units of a statistical comparison.

A layout of a list returns under other seeds and, in simpler-fractal, under every variant.
"""

from functools import cache
from typing import TYPE_CHECKING

from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow

if TYPE_CHECKING:
    import pandas as pd


def layout_names(episodes: "pd.DataFrame") -> "pd.Series":
    """The name of every episode's starting layout, which begins with its suite and task.

    Needs the columns suite, task, episode and seed.

    Raises: BadSuite for a benchmark whose list is damaged.
    """
    import pandas as pd

    lines: list[tuple[str, str, int, str]] = []
    for suite in dict.fromkeys(episodes["suite"]):
        if suites.has_list(suite):
            lines += _listed_layouts(suite)
    keys = ["suite", "task", "episode"]
    listed = pd.DataFrame(lines, columns=[*keys, "layout"])
    layout = episodes[keys].merge(listed, on=keys, how="left")["layout"].set_axis(episodes.index)
    # A warm-up suite has no list: its layouts are drawn from the seed.
    episode = episodes["episode"].astype(str)
    seed = episodes["seed"].astype(str)
    drawn = "episode " + episode + " seed " + seed
    return episodes["suite"] + " " + episodes["task"] + " " + layout.where(layout.notna(), drawn)


def layout_name(row: EpisodeRow) -> str:
    """Where the target, its look-alikes and its goal start; other objects do not count."""
    parts = []
    for place in row.placements:
        lookalike = "-lookalike-" in place.model or place.model.startswith(f"{row.target}-")
        if lookalike or place.model in (row.target, row.goal):
            parts.append(f"{place.model} {place.x:g} {place.y:g} {place.yaw:g}")
    return "; ".join(parts)


@cache
def _listed_layouts(suite: str) -> tuple[tuple[str, str, int, str], ...]:
    """Suite, task, episode and layout of every row of a benchmark's list."""
    rows = suites.benchmark(suite)
    return tuple((row.suite, row.task, row.episode, layout_name(row)) for row in rows)
