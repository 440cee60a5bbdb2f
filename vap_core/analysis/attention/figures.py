"""Tables of attention in, matplotlib figures out."""

from typing import TYPE_CHECKING

import numpy as np

from vap_core.analysis.attention.patterns import LOCALISATIONS, over_views
from vap_core.base.figures import OTHER, WINNER, empty_figure
from vap_core.evaluation.store import KEY

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

QUERY_COLOURS = {
    "token": "#009e73",
    "colour": "#c0392b",
    "category": "#7f5af0",
    "action": "#3b3b3b",
}
SUCCESS, FAILURE = "#3a7d44", "#c9ccd1"
CALLS_BEFORE = 8
LEAST_EPISODES = 4
"""Calls before the first touch that are shown, and episodes behind a point."""


def where_figure(table: "pd.DataFrame") -> "Figure":
    """Density of attention on the target and on its look-alikes, by method and query.

    `table` is `report.where_queries_look`'s; 1 is what an even attention would have.
    """
    lines = table.iloc[::-1].reset_index(drop=True)
    figure = empty_figure(7.2, 0.36 * len(lines) + 0.9)
    axes = figure.subplots()
    places = np.arange(len(lines))
    axes.barh(places + 0.19, lines["lift"], 0.36, color=WINNER, label="target")
    axes.barh(places - 0.19, lines["lift_lookalikes"], 0.36, color=OTHER, label="look-alikes")
    axes.axvline(1, color="black", linewidth=0.8, linestyle=":")
    names = []
    for line in lines.itertuples():
        names.append(f"{line.suite} · {line.method} · {line.query} (n = {line.n})")
    axes.set_yticks(places, names, fontsize=8)
    axes.set_xlabel("attention per area, whole view = 1")
    axes.legend(fontsize=8, loc="upper right")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def layers_figure(table: "pd.DataFrame") -> "Figure":
    """Density on the target by layer; `table` is `report.layer_table`'s, one panel a method.

    Words of the last layer have no effect on the actions: their points are hollow.
    """
    panels = list(table.groupby(["suite", "method"], observed=True, sort=False))
    figure = empty_figure(3.3 * len(panels), 2.7)
    row = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for axes, ((suite, method), panel) in zip(row, panels, strict=True):
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
        axes.axhline(1, color="black", linewidth=0.8, linestyle=":")
        axes.set_title(f"{suite}, {method}", fontsize=9)
        axes.set_xlabel("layer")
        axes.set_xticks(sorted(set(panel["layer"] + 1)))
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(fontsize=7)
    row[0].set_ylabel("attention per area on the target")
    return figure


def patterns_figure(counts: "pd.DataFrame") -> "Figure":
    """Episodes of every localisation, successes and failures; `counts` is `pattern_counts`'."""
    figure = empty_figure(1.6 + 2.6 * len(counts), 2.8)
    row = figure.subplots(1, len(counts), squeeze=False, sharey=True)[0]
    for axes, line in zip(row, counts.to_dict("records"), strict=True):
        places = np.arange(len(LOCALISATIONS))
        wins = np.array([line[f"{name}, success"] for name in LOCALISATIONS])
        total = np.array([line[name] for name in LOCALISATIONS])
        axes.bar(places, 100 * wins / line["n"], 0.7, color=SUCCESS, label="success")
        lost = 100 * (total - wins) / line["n"]
        axes.bar(places, lost, 0.7, 100 * wins / line["n"], color=FAILURE, label="failure")
        for place, won, of in zip(places, wins, total, strict=True):
            axes.text(place, 100 * of / line["n"] + 1, f"{won}/{of}", ha="center", fontsize=8)
        axes.set_xticks(places, LOCALISATIONS, fontsize=8)
        axes.set_title(f"{line['suite']}, {line['method']} (n = {line['n']})", fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
    row[0].set_ylabel("% of episodes")
    row[0].legend(fontsize=8)
    return figure


def time_figure(calls: "pd.DataFrame", episodes: "pd.DataFrame") -> "Figure":
    """Share of peaks on the target by the number of calls left to the first touch of anything.

    Episodes that succeed and that fail apart; `calls` are of one query a method.
    """
    merged = over_views(calls).merge(episodes, on=KEY)
    touched = merged[merged["first_touch"].notna() & (merged["step"] < merged["first_touch"])]
    keys = [touched[name] for name in KEY]
    left = touched.groupby(keys, observed=True)["step"].rank(ascending=False) - 1
    shown = touched.assign(left=left)[left <= CALLS_BEFORE]
    methods = list(dict.fromkeys(shown["method"].astype(str)))
    figure = empty_figure(3.4 * len(methods), 2.7)
    row = figure.subplots(1, len(methods), squeeze=False, sharey=True)[0]
    for axes, method in zip(row, methods, strict=True):
        of_method = shown[shown["method"].astype(str) == method]
        for success, colour in ((True, SUCCESS), (False, "#c0392b")):
            group = of_method[of_method["success"] == success].groupby("left")
            rates = 100 * group["hit"].mean()[group.size() >= LEAST_EPISODES]
            name = "success" if success else "failure"
            n = len(of_method[of_method["success"] == success][KEY].drop_duplicates())
            axes.plot(
                -rates.index,
                rates,
                marker="o",
                markersize=3,
                color=colour,
                label=f"{name} (n = {n})",
            )
        axes.axhline(
            100 * of_method["chance_hit"].mean(), color="black", linewidth=0.8, linestyle=":"
        )
        axes.set_title(method, fontsize=9)
        axes.set_xlabel("calls before the first touch")
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(fontsize=7)
    row[0].set_ylabel("peak on the target, %")
    return figure
