"""Six charts, of tidy tables: dots, curves, bars, stacked bars, the funnel, and sheets of tiles.

A table has a row per mark: `value` with `low` and `high`, fractions, and columns that say where it
is drawn. `paper` is the paper's value beside it, `filled` false a hollow mark.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.pictures import (
    BAR_COLOURS,
    FRAME,
    FURTHER_POLICY_MARKERS,
    GRID,
    METHODS,
    POLICY_MARKERS,
    SUITES,
    TEXT,
    THIN_LINES,
    TIERS,
    empty_figure,
    method_marks,
)
from vap_core.base.pictures import CASES as CASE_COLOURS
from vap_core.base.types import Rgb, value

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAPER, PLAIN = "#d55e00", "#0072b2"
"""The paper's values, and marks that nothing else tells apart."""
MEANINGS = {
    "case 1": "Case 1: every view wrong alike",
    "case 2": "Case 2: views disagree",
    "case 3": "Case 3: right prompt, the hand fails",
    "unprompted": "unprompted: no mask to be wrong",
}
"""The cases in a legend."""
KINDS = {"own": TIERS["personal"], "look-alikes": "#2f5fd0", "other objects": FRAME}
"""The kinds of photos that a token is asked about."""


def names_in(table: "pd.DataFrame", column: str) -> list[str]:
    """The names in a column, each once, in the order of its categories, else of appearance; one
    empty name where no column is named.
    """
    if not column:
        return [""]
    names = table[column]
    if names.dtype.name == "category":
        names = names.cat.remove_unused_categories().cat.categories
    return list(map(str, dict.fromkeys(names)))


def colours_of(names: Sequence[str]) -> dict[str, str]:
    """The colours of series: methods, suites, tiers, cases and kinds have their own everywhere."""
    known = {**KINDS, **CASE_COLOURS, **TIERS}
    known |= {name: THIN_LINES.get(name, colour) for name, (colour, _) in SUITES.items()}
    if any(name.lower() in METHODS for name in names):
        known |= {name: colour for name, (colour, _) in method_marks(names).items()}
        known |= {name: METHODS[name.lower()][0] for name in names if name.lower() in METHODS}
    others = [name for name in names if name.partition(" (")[0] not in known]
    return {
        name: BAR_COLOURS[others.index(name) % len(BAR_COLOURS)]
        if name in others
        else known.get(name) or known[name.partition(" (")[0]]
        for name in names
    }


def _panels(
    table: "pd.DataFrame", panel: str, size: tuple[float, float], columns: int = 5, **options: Any
) -> "tuple[Figure, list[tuple[str, pd.DataFrame, Axes]]]":
    """A figure with a panel of that size for each name in the column `panel`."""
    names = names_in(table, panel) or [""]
    rows = -(-len(names) // columns)
    across = -(-len(names) // rows)
    figure = empty_figure(size[0] * across, size[1] * rows)
    grid = figure.subplots(rows, across, squeeze=False, **options).ravel()
    drawn = []
    for axes, name in zip(grid, names, strict=False):
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_title(name, fontsize=9)
        drawn.append((name, table[table[panel].astype(str) == name] if panel else table, axes))
    for axes in grid[len(names) :]:
        axes.set_axis_off()
    return figure, drawn


def _finish(figure: "Figure", title: str = "", columns: int = 4) -> "Figure":
    """The title, and one legend of what all panels show."""
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(name, handle)
    if handles:
        figure.legend(
            list(handles.values()),
            list(handles),
            loc="outside lower center",
            ncols=columns,
            frameon=False,
            fontsize=8,
        )
    if title:
        figure.suptitle(title, fontsize=11, fontweight="bold")
    return figure


def dots(
    table: "pd.DataFrame",
    line: str,
    *,
    group: str = "",
    panel: str = "",
    series: str = "",
    policy: str = "",
    label: str = "% of episodes that succeed, 95 % interval",
    title: str = "",
    limits: tuple[float, float] = (-3.0, 108.0),
    scale: float = 100.0,
) -> "Figure":
    """A line per name in the column `line`, below the bold heading of its `group`: the value by
    `scale` with its interval; the paper's is a diamond.

    A mark per `series` has its own colour and marker, and per `policy` of a series another marker.
    """
    figure, panels = _panels(table, panel, (1.0, 1.0))
    names = names_in(table, series)
    colours = colours_of(names) if series else {"": PLAIN}
    marks = {name: (colours[name], mark) for name, (_, mark) in method_marks(names).items()}
    policies = names_in(table, policy)
    heights = []
    ticks: list[list[str]] = []
    for _, part, axes in panels:
        labels: list[str] = []
        places: dict[tuple[str, ...], int] = {}
        bold = set()
        columns = [*filter(None, (group,)), line]
        for key in part[columns].astype(str).itertuples(index=False):
            if group and key[0] not in (seen[0] for seen in places):
                bold.add(len(labels))
                labels.append(key[0])
            if tuple(key) not in places:
                places[tuple(key)] = len(labels)
                labels.append(key[-1])
        of_line = part.groupby(columns, sort=False, observed=True)
        most = int(of_line.size().max())
        for row, i, n in zip(
            part.to_dict("records"),
            of_line.cumcount(),
            of_line[line].transform("size"),
            strict=True,
        ):
            y = places[tuple(str(row[name]) for name in columns)] + (i - (n - 1) / 2) * 0.8 / most
            name = str(row[series]) if series else ""
            colour, marker = marks[name]
            number = policies.index(str(row[policy])) if policy else 0
            marker = (marker, *FURTHER_POLICY_MARKERS)[number // 2 % 4]
            filled = row.get("filled", number % 2 == 0)
            several = policy and len(policies) > 1
            axes.errorbar(
                scale * row["value"],
                y,
                xerr=_ends([row], scale),
                fmt=marker,
                color=colour,
                markerfacecolor=colour if filled else "white",
                markersize=5,
                capsize=2.5,
                linewidth=1.2,
                label=(f"{name}, {row[policy]} policy" if several else name) or None,
            )
            if most == 1 and limits[0] > -10:
                end = np.nanmax([row["high"], row["value"]])
                axes.text(
                    scale * end + 2, y, f"{scale * row['value']:.0f}", va="center", fontsize=8
                )
            if row.get("paper", np.nan) == row.get("paper", np.nan):
                look: dict[str, Any] = dict(
                    color=PAPER, fillstyle="none", markersize=5, label="the paper's"
                )
                axes.plot(scale * row["paper"], y, "D", **look)
        shown = ["" if i in bold else name for i, name in enumerate(labels)]
        axes.set_yticks(range(len(labels)), shown, fontsize=8)
        for i in bold:
            look = dict(va="center", fontsize=8, fontweight="bold")
            place = limits[0] + 0.01 * (limits[1] - limits[0])
            axes.text(place, i, labels[i], in_layout=False, **look)
        if limits[0] <= -10:
            axes.axvline(0, color=TEXT, linewidth=0.8)
        axes.set(xlim=limits, ylim=(len(labels) - 0.4, -0.6))
        axes.grid(axis="x", color=GRID)
        axes.set_axisbelow(True)
        axes.tick_params(axis="y", length=0)
        heights.append((0.14 + 0.08 * min(most, 6)) * len(labels))
        ticks.append(labels)
    shared = len(panels) > 1 and all(labels == ticks[0] for labels in ticks)
    for _, _, axes in panels[1:] if shared else ():
        axes.set_yticklabels([])
    narrow = not group and (shared or len(panels) > 2)
    width = (2.6 if narrow else 4.6) * len(panels) + 1.6
    figure.set_size_inches(max(width, 5.5), max(heights) + 1.4)
    for _, _, axes in panels if len(panels) == 2 else [panels[len(panels) // 2]]:
        axes.set_xlabel(label, fontsize=9)
    return _finish(figure, title)


def curves(
    table: "pd.DataFrame",
    x: str,
    *,
    panel: str = "",
    series: str = "",
    label: str = "% of episodes",
    label_x: str = "",
    title: str = "",
    scale: float = 100.0,
    dashed: Sequence[str] = (),
    top: float | None = 103.0,
    apart: str = "",
) -> "Figure":
    """A line per name in the column `series` along `x`, with its interval where there is one; the
    paper's values are dashed diamonds, and so are the lines of the series `dashed`.

    The value at `apart` is no continuation of the others: no line leads to it.
    """
    figure, panels = _panels(table, panel, (3.2, 3.2), columns=4, sharey=True)
    colours = colours_of(names_in(table, series))
    figure.set_size_inches(max(5.6, figure.get_figwidth()), figure.get_figheight() + 0.3)
    for _, part, axes in panels:
        words = part[x].dtype.kind not in "iuf"
        places = names_in(part, x)
        for i, name in enumerate(colours):
            rows = part[part[series].astype(str) == name] if series else part
            if rows.empty:
                continue
            at = np.array([places.index(each) for each in rows[x]] if words else rows[x], float)
            look: dict[str, Any] = dict(color=colours[name] if series else PLAIN, linewidth=1.5)
            style = "--" if name in dashed else "-"
            few: dict[str, Any] = dict(marker=POLICY_MARKERS[i % len(POLICY_MARKERS)], markersize=4)
            look |= few if len(rows) <= 24 else {}
            values = scale * rows["value"].to_numpy(float)
            last = (rows[x].astype(str) == apart).to_numpy()
            axes.plot(at[~last], values[~last], style, label=name or None, **look)
            if last.any():
                axes.plot(at[last], values[last], **look | {"linestyle": "none"})
            if "low" in rows:
                ends = scale * rows["low"], scale * rows["high"]
                axes.fill_between(at, *ends, color=look["color"], alpha=0.15, linewidth=0)
            if "paper" in rows and rows["paper"].notna().any():
                axes.plot(
                    at,
                    scale * rows["paper"],
                    "D--",
                    color=PAPER,
                    fillstyle="none",
                    label="the paper's",
                )
        if words:
            axes.set_xticks(range(len(places)), places, fontsize=8, rotation=20)
        axes.set(xlabel=label_x)
        axes.grid(color=GRID)
        if top is not None:
            axes.set_ylim(-0.03 * top, top)
    for axes in figure.axes[:: min(4, len(panels))]:
        axes.set_ylabel(label)
    return _finish(figure, title)


def bars(
    table: "pd.DataFrame",
    x: str,
    *,
    panel: str = "",
    series: str = "",
    label: str = "% of episodes",
    label_x: str = "",
    title: str = "",
) -> "Figure":
    """A group of bars per name in the column `x`, a colour per name in `series`, with intervals.

    Groups and colours keep one order over all panels; `paper` is a diamond over the bar.
    """
    groups, names = names_in(table, x), names_in(table, series)
    size = (max(2.9, 0.24 * len(groups) * len(names) + 0.6), 2.6)
    figure, panels = _panels(table, panel, size, columns=4, sharey=True)
    figure.set_size_inches(figure.get_figwidth() + 0.9, figure.get_figheight() + 0.6)
    colours = colours_of(names)
    for _, part, axes in panels:
        own = [group for group in groups if (part[x].astype(str) == group).any()]
        for i, name in enumerate(names):
            rows = part[part[series].astype(str) == name] if series else part
            at = np.array([own.index(group) for group in rows[x].astype(str)], float)
            at += (i - (len(names) - 1) / 2) * 0.84 / len(names)
            axes.bar(
                at,
                100 * rows["value"],
                0.76 / len(names),
                color=colours[name] if series else PLAIN,
                label=name or None,
            )
            ends = _ends(rows.to_dict("records"))
            axes.errorbar(
                at,
                100 * rows["value"],
                yerr=ends,
                fmt="none",
                ecolor="black",
                capsize=2,
                linewidth=0.9,
            )
            if "paper" in rows:
                axes.plot(at, 100 * rows["paper"], "D", color=PAPER, fillstyle="none")
        axes.set_xticks(range(len(own)), own, fontsize=8)
        axes.set_ylim(0, 105)
    figure.axes[0].set_ylabel(label)
    panels[len(panels) // 2][2].set_xlabel(label_x, fontsize=9)
    return _finish(figure, title)


def stacked(
    table: "pd.DataFrame",
    line: str,
    parts: Sequence[str],
    *,
    group: str = "suite",
    label: str = "failures, % of episodes (in the bars: how many)",
) -> "Figure":
    """A bar per line and group, as long as its `parts` are of `n`: columns of counts."""
    from matplotlib.colors import to_rgb

    labels: list[str] = []
    places = []
    for row in table.to_dict("records"):
        if row[group] not in labels:
            labels.append(str(row[group]))
        places.append(len(labels))
        labels.append(f"{row[line]}, n {row['n']}")
    figure = empty_figure(9.0, 0.27 * len(labels) + 1.3)
    axes = figure.subplots()
    start = np.zeros(len(table))
    for part, colour in colours_of(parts).items():
        if not table[part].any():
            continue
        percent = (100 * table[part] / table["n"]).to_numpy(float)
        drawn = axes.barh(places, percent, left=start, color=colour, height=0.82, edgecolor="white",
                          label=MEANINGS.get(part, part))  # fmt: skip
        counts = [str(n) if wide > 2 else "" for n, wide in zip(table[part], percent, strict=True)]
        dark = np.dot(to_rgb(colour), (0.3, 0.59, 0.11)) < 0.5
        axes.bar_label(
            drawn, counts, label_type="center", color="white" if dark else "black", fontsize=7.5
        )
        start += percent
    axes.set_yticks(range(len(labels)), labels, fontsize=8)
    for i, tick in enumerate(axes.get_yticklabels()):
        tick.set_fontweight("normal" if i in places else "bold")
    axes.set(ylim=(len(labels) - 0.4, -0.6), xlim=(0, 104))
    axes.set_xlabel(label, fontsize=9)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    return _finish(figure)


def funnel(table: "pd.DataFrame") -> "Figure":
    """Per suite, the share of episodes that are left after each stage, a line per method.

    `table` is `failures.funnel`'s. Methods that read the simulator are dashed. The last stage is
    success with every stage right; "SR" beside it is every success.
    """
    bound = names_in(table[table["bound"]], "method")
    shown = table.assign(panel=table["suite"] + " (n " + table["n"].astype(str) + ")")
    if shown.groupby("suite")["n"].nunique().max() > 1:
        shown["panel"] = shown["suite"]
    label = "% of episodes left after the stage"
    return curves(
        shown, "stage", panel="panel", series="method", label=label, dashed=bound, apart="SR"
    )


def _ends(rows: Sequence[Mapping[Any, Any]], scale: float = 100.0) -> np.ndarray:
    """How far an interval reaches to both sides, by `scale`."""
    ends = [[scale * (row["value"] - row["low"]) for row in rows]]
    ends += [[scale * (row["high"] - row["value"]) for row in rows]]
    return np.maximum(np.array(ends), 0)


@value
class Tile:
    """One picture of a sheet, the text under it, and the colour of its frame ("" for none)."""

    picture: Rgb
    title: str = ""
    edge: str = ""


def sheet(
    rows: Mapping[str, Sequence[Tile]],
    side_in: float = 1.0,
    label_in: float = 0.85,
    columns: int = 1,
    title_pt: float = 7.0,
) -> "Figure":
    """A contact sheet: one labelled row of tiles per key, distributed over `columns` side by side.

    Sizes are in inches, that of the tiles' titles in points.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    tiles = [tile for row in rows.values() for tile in row]
    n_lines = max(len(tile.title.splitlines()) for tile in tiles)
    per_column = -(-len(rows) // columns)
    width = label_in + side_in * max(map(len, rows.values()))
    height = side_in + 0.11 + 0.12 * n_lines * title_pt / 7
    figure = Figure(figsize=(columns * width, per_column * height))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    for i, (label, row) in enumerate(rows.items()):
        left, top = i // per_column * width, i % per_column * height + 0.03
        axes.text(
            left + label_in - 0.08, top + side_in / 2, label, ha="right", va="center", fontsize=9
        )
        for j, tile in enumerate(row):
            x, y = left + label_in + (j + 0.5) * side_in, top + side_in / 2
            half = (side_in - 0.06) / 2
            down, across = half * np.array(tile.picture.shape[:2]) / max(tile.picture.shape[:2])
            extent = (x - across, x + across, y + down, y - down)
            axes.imshow(tile.picture, extent=extent, aspect="auto", interpolation="antialiased")
            if tile.edge:
                corner = (x - half, y - half)
                axes.add_patch(
                    Rectangle(
                        corner, 2 * half, 2 * half, fill=False, edgecolor=tile.edge, linewidth=1.8
                    )
                )
            axes.text(
                x, top + side_in, tile.title, ha="center", va="top", fontsize=title_pt, color=TEXT
            )
    axes.set(xlim=(0, columns * width), ylim=(per_column * height, 0))
    return figure


def film(images: Mapping[str, Sequence[Rgb]], titles: Sequence[str]) -> "Figure":
    """Rows of pictures, one row per label, one column per title."""
    rows = {
        label: [Tile(picture, title) for picture, title in zip(pictures, titles, strict=True)]
        for label, pictures in images.items()
    }
    return sheet(rows, side_in=2.0, label_in=1.3, title_pt=9.0)
