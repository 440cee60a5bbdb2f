"""Tables of attention in, matplotlib figures out."""

from typing import TYPE_CHECKING

import numpy as np

from vap_core.analysis.attention.patterns import LOCALISATIONS, over_views
from vap_core.analysis.attention.report import in_order
from vap_core.base.pictures import FRAME, OTHER, TEXT, WINNER, empty_figure
from vap_core.study.store import KEY

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

QUERY_COLOURS = {
    "token": "#009e73",
    "colour": "#c0392b",
    "category": "#7f5af0",
    "action": "#3b3b3b",
}
SUCCESS, FAILURE = TEXT, FRAME
CALLS_BEFORE = 8
LEAST_EPISODES = 4
"""Calls before the first touch that are shown, and episodes behind a point."""


def where_figure(table: "pd.DataFrame") -> "Figure":
    """Density of attention on the target and on its look-alikes, by suite, method and query.

    `table` is `report.where_queries_look`'s; 1 is what an even attention would have, bars of error
    are 95 % intervals over layouts.
    """
    lines = in_order(table).iloc[::-1].reset_index(drop=True)
    figure = empty_figure(7.2, 0.3 * len(lines) + 1.1)
    axes = figure.subplots()
    places = np.arange(len(lines))
    for name, label, colour, offset in (
        ("lift", "target", WINNER, 0.19),
        ("lift_lookalikes", "look-alikes", OTHER, -0.19),
    ):
        value = lines[name].to_numpy(float)
        low = value - lines[f"{name}_low"].to_numpy(float)
        high = lines[f"{name}_high"].to_numpy(float) - value
        axes.barh(places + offset, value, 0.36, color=colour, label=label)
        axes.errorbar(
            value, places + offset, xerr=[low, high], fmt="none", ecolor="black", elinewidth=0.7
        )
    axes.axvline(1, color="black", linewidth=0.8, linestyle=":", label="even attention")
    names = []
    for line in lines.itertuples():
        names.append(f"{line.suite} · {line.method} · {line.query} (n = {line.n})")
    axes.set_yticks(places, names, fontsize=8)
    axes.set_ylim(-0.6, len(lines) - 0.4)
    axes.set_xlabel("attention per area before the first touch, whole view = 1")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper right", ncols=3, frameon=False, fontsize=8)
    return figure


def layers_figure(table: "pd.DataFrame") -> "Figure":
    """Density on the target by layer; `table` is `report.layer_table`'s.

    A column of panels a suite, a row a method. Words of the last layer have no effect on the
    actions: their points are hollow.
    """
    figure, grid = _grid(table, width=2.6, height=2.3)
    legend: dict[str, Artist] = {}
    for (suite, method), axes in grid.items():
        panel = table[(table["suite"] == suite) & (table["method"] == method)]
        for query, lines in panel.groupby("query", observed=True, sort=False):
            ordered = lines.sort_values("layer")
            colour = QUERY_COLOURS[str(query)]
            layers = ordered["layer"].to_numpy() + 1
            lift = ordered["lift"].to_numpy()
            axes.plot(layers, lift, color=colour, label=str(query), linewidth=1.5)
            last = (layers == layers.max()) & (query != "action")
            axes.scatter(layers[~last], lift[~last], color=colour, s=22, zorder=3)
            axes.scatter(
                layers[last], lift[last], facecolor="white", edgecolor=colour, s=26, zorder=3
            )
        axes.axhline(1, color="black", linewidth=0.8, linestyle=":", label="even attention")
        axes.set_title(f"{suite}, {method}", fontsize=9)
        axes.set_xlabel("layer")
        axes.set_xticks(sorted(set(panel["layer"] + 1)))
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            legend[label] = handle
    figure.supylabel("attention per area on the target", fontsize=9)
    figure.legend(
        legend.values(), legend.keys(), loc="outside lower center", ncols=5, frameon=False
    )
    return figure


def patterns_figure(counts: "pd.DataFrame") -> "Figure":
    """Episodes of every localisation, successes and failures; `counts` is `pattern_counts`'.

    A column of panels a suite, a row a method.
    """
    figure, grid = _grid(counts, width=2.7, height=2.2)
    for line in counts.to_dict("records"):
        axes = grid[line["suite"], line["method"]]
        places = np.arange(len(LOCALISATIONS))
        wins = np.array([line[f"{name}, success"] for name in LOCALISATIONS])
        total = np.array([line[name] for name in LOCALISATIONS])
        axes.bar(places, 100 * wins / line["n"], 0.7, color=SUCCESS, label="success")
        lost = 100 * (total - wins) / line["n"]
        axes.bar(places, lost, 0.7, 100 * wins / line["n"], color=FAILURE, label="failure")
        for place, won, of in zip(places, wins, total, strict=True):
            axes.text(
                float(place), 100 * of / line["n"] + 1, f"{won}/{of}", ha="center", fontsize=7
            )
        axes.set_xticks(places, LOCALISATIONS, fontsize=7)
        axes.set_ylim(0, 108)
        axes.set_title(f"{line['suite']}, {line['method']} (n = {line['n']})", fontsize=8)
    figure.supylabel("% of episodes", fontsize=9)
    handles = next(iter(grid.values())).get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    return figure


def _grid(
    table: "pd.DataFrame", *, width: float, height: float
) -> "tuple[Figure, dict[tuple[str, str], Axes]]":
    """A panel for every suite and method of a table, suites from left to right."""
    suites = list(dict.fromkeys(in_order(table)["suite"].astype(str)))
    methods = list(dict.fromkeys(table["method"].astype(str)))
    figure = empty_figure(max(4.0, width * len(suites) + 0.4), height * len(methods) + 0.5)
    panels = figure.subplots(len(methods), len(suites), squeeze=False, sharey=True)
    found = set(zip(table["suite"].astype(str), table["method"].astype(str), strict=True))
    grid = {}
    for row, method in enumerate(methods):
        for column, suite in enumerate(suites):
            axes = panels[row, column]
            axes.spines[["top", "right"]].set_visible(False)
            if (suite, method) in found:
                grid[suite, method] = axes
            else:
                axes.set_axis_off()
    return figure, grid


def time_figure(calls: "pd.DataFrame", episodes: "pd.DataFrame") -> "Figure":
    """Share of peaks on the target by the number of calls left to the first touch of anything.

    Episodes that succeed and that fail apart, without those that touch nothing; `calls` are of one
    query a method.
    """
    merged = over_views(calls).merge(episodes, on=KEY)
    touched = merged[merged["first_touch"].notna() & (merged["step"] < merged["first_touch"])]
    keys = [touched[name] for name in KEY]
    left = touched.groupby(keys, observed=True)["step"].rank(ascending=False) - 1
    shown = touched.assign(left=left)[left <= CALLS_BEFORE]
    methods = list(dict.fromkeys(shown["method"].astype(str)))
    figure = empty_figure(3.6 * len(methods), 3.1)
    row = figure.subplots(1, len(methods), squeeze=False, sharey=True)[0]
    for axes, method in zip(row, methods, strict=True):
        of_method = shown[shown["method"].astype(str) == method]
        for success, colour, line in ((True, SUCCESS, "o-"), (False, FAILURE, "s--")):
            group = of_method[of_method["success"] == success].groupby("left")
            rates = 100 * group["hit"].mean()[group.size() >= LEAST_EPISODES]
            name = "success" if success else "failure"
            n = len(of_method[of_method["success"] == success][KEY].drop_duplicates())
            ended = episodes[(episodes["method"] == method) & (episodes["success"] == success)]
            axes.plot(
                -rates.index,
                rates,
                line,
                markersize=4,
                color=colour,
                label=f"{name} ({n} of {len(ended)})",
            )
        axes.axhline(
            100 * of_method["chance_hit"].mean(),
            color="black",
            linewidth=0.8,
            linestyle=":",
            label="chance",
        )
        axes.set_title(method, fontsize=9)
        axes.set_xlabel("calls before the first touch")
        axes.spines[["top", "right"]].set_visible(False)
        below = (0.5, -0.24)
        axes.legend(loc="upper center", bbox_to_anchor=below, ncols=2, frameon=False, fontsize=7)
    row[0].set_ylabel("peak on the target, %")
    return figure
