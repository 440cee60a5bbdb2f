"""Figures of learned tokens: what they recognize as they are learned, and how far words moved."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from vap_core.base.pictures import FRAME, GRID, OTHER, WINNER, empty_figure

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

COLOURS = {"own": WINNER, "look-alikes": OTHER, "other objects": FRAME}
"""The colour of each kind of photo."""


def token_curves_figure(curve: "pd.DataFrame") -> "Figure":
    """Yes to each kind of photo over the steps of a training, of `report.curve`.

    A panel per number of photos; bands are 95 % intervals.
    """
    ks = sorted(curve.k.unique())
    figure = empty_figure(max(4.6, 2.9 * len(ks) + 0.5), 3.2)
    grid = figure.subplots(1, len(ks), squeeze=False, sharey=True)[0]
    for axes, k in zip(grid, ks, strict=True):
        of_k = curve[curve.k == k]
        for kind, colour in COLOURS.items():
            part = of_k[of_k.kind == kind].sort_values("step")
            axes.plot(part.step, 100 * part.yes, "o-", color=colour, markersize=3, label=kind)
            axes.fill_between(
                part.step, 100 * part.low, 100 * part.high, color=colour, alpha=0.2, linewidth=0
            )
        photos = "photo" if k == 1 else "photos"
        axes.set(
            title=f"{k} {photos}, {int(of_k.objects.max())} objects",
            xlabel="optimiser steps",
            ylim=(-2, 102),
        )
        axes.grid(color=GRID)
        axes.spines[["top", "right"]].set_visible(False)
    grid[0].set_ylabel("yes, % of unseen photos")
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    return figure


def choice_figure(table: "pd.DataFrame", columns: "Mapping[str, str]") -> "Figure":
    """Shares of episodes with the right object, by suite; `table` is `choices.beside_policy`'s.

    `columns` are those that are shown, with their colours; lines are 95 % intervals, the dotted
    line is chance.
    """
    figure = empty_figure(max(6.0, 2.3 * len(table) + 1.2), 3.4)
    axes = figure.subplots()
    width = 0.8 / len(columns)
    for i, (name, colour) in enumerate(columns.items()):
        estimates = list(table[name])
        value = 100 * np.array([each.value for each in estimates])
        low = value - 100 * np.array([each.low for each in estimates])
        high = 100 * np.array([each.high for each in estimates]) - value
        places = np.arange(len(table)) + (i - (len(columns) - 1) / 2) * width
        axes.bar(places, value, 0.9 * width, color=colour, label=name)
        ends = np.clip([low, high], 0, None)  # rounding may leave an end inside
        axes.errorbar(places, value, yerr=ends, fmt="none", ecolor="black", elinewidth=0.8)
    for place, chance in enumerate(table["chance"]):
        axes.hlines(
            100 * float(chance),
            place - 0.42,
            place + 0.42,
            "black",
            ":",
            linewidth=1,
            label="" if place else "chance",
        )
    names = []
    for suite, line in table.iterrows():
        names.append(f"{suite} (n = {line[next(iter(columns))].n})")
    axes.set_xticks(range(len(table)), names, fontsize=8)
    axes.set(ylabel="right object, % of episodes", ylim=(0, 104))
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=6, frameon=False, fontsize=8)
    return figure
