"""The pictures of failures: what they are of, and on which stage of the road episodes are lost."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from vap_core.failures import CASES, STAGES
from vap_core.plots import empty_figure
from vap_core.report.failures import Road

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure

CASE_SHADES = {"case 1": "Reds", "case 2": "Purples", "case 3": "Blues", "unprompted": "Greys", "unlabelled": "Greens"}
LABEL_APART = 6.0
"""Percent between two numbers at the ends of lines, so that both can be read."""


def funnel_figure(roads: Sequence[Road], colours: Mapping[str, str]) -> "Figure":
    """Per suite, how many percent of the episodes are still on the road after each stage: a line per method of `colours`, bounds dashed.

    A method that highlights nothing begins with the touch.
    """
    suites = list(dict.fromkeys(road.suite for road in roads))
    columns = min(2, len(suites))
    figure = empty_figure(5.4 * columns, 2.9 * -(-len(suites) // columns) + 0.4)
    grid = figure.subplots(-(-len(suites) // columns), columns, squeeze=False, sharey=True).ravel()
    drawn: dict[str, Artist] = {}
    for axes, suite in zip(grid, suites, strict=False):
        ends: list[tuple[float, str]] = []
        for road in (road for road in roads if road.suite == suite and road.method in colours):
            held = [(i, 100 * left / road.n) for i, left in enumerate(road.left) if left is not None]
            at, share = [i for i, _ in held], [value for _, value in held]
            dashes = "--" if road.method.startswith("oracle") else "-"
            (drawn[road.method],) = axes.plot(at, share, dashes, marker="o", markersize=4, color=colours[road.method], linewidth=1.8)
            ends.append((share[-1], colours[road.method]))
        lowest = -LABEL_APART
        for value, colour in sorted(ends):
            lowest = max(value, lowest + LABEL_APART)
            axes.annotate(f"{value:.0f}", (len(STAGES) - 1, lowest), (5, 0), textcoords="offset points", fontsize=8, color=colour, va="center")
        n = next(road.n for road in roads if road.suite == suite)
        axes.set_xticks(range(len(STAGES)), STAGES, fontsize=8, rotation=20)
        axes.set(title=f"{suite} (n {n})", ylim=(0, 104))
        axes.grid(color="#eeeeee")
        axes.spines[["top", "right"]].set_visible(False)
    for axes in grid[len(suites) :]:
        axes.set_axis_off()
    for axes in grid[::columns]:
        axes.set_ylabel("% of episodes still on the road", fontsize=8)
    figure.legend(drawn.values(), drawn.keys(), loc="outside lower center", ncols=6, frameon=False)
    return figure


def cases_figure(counts: "pd.DataFrame") -> "Figure":
    """One bar per suite and method: its failures by sub-case, in percent of them; one hue a case, from the picture to the hand."""
    import matplotlib

    lines = counts[counts["failed"] > 0].to_dict("records")
    figure = empty_figure(10.5, 0.42 * len(lines) + 1.9)
    axes = figure.subplots()
    start = np.zeros(len(lines))
    for case, parts in CASES.items():
        shades = matplotlib.colormaps[CASE_SHADES[case]](np.linspace(0.85, 0.35, len(parts)))
        for part, colour in zip(parts, shades, strict=True):
            share = np.array([100 * line[f"{case}: {part}"] / line["failed"] for line in lines])
            if share.any():
                bars = axes.barh(range(len(lines)), share, left=start, color=colour, edgecolor="white", linewidth=0.6, label=f"{case}: {part}")
                texts = [f"{value:.0f}" if value >= 4 else "" for value in share]
                axes.bar_label(bars, texts, label_type="center", fontsize=7.5, color="white" if sum(colour[:3]) < 1.7 else "black")
            start += share
    axes.set_yticks(range(len(lines)), [f"{line['suite']} · {line['method']} ({line['failed']} of {line['n']})" for line in lines], fontsize=8)
    axes.invert_yaxis()
    axes.set(xlim=(0, 100), xlabel="% of the failures")
    axes.spines[["top", "right", "left"]].set_visible(False)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure
