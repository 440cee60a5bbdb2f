"""The main results as pictures: a panel per suite, and a matrix of tasks and methods."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from vap_core.base.figures import empty_figure
from vap_core.base.palette import FRAME, GRID, TEXT, method_marks
from vap_core.evaluation.report.cells import track_title

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

OURS = "vap"
"""The method that is set in bold."""
LARGEST_PT2 = 190.0
"""Area of the dot of 100 %, points squared."""


def suites_figure(results: "pd.DataFrame", title: str = "") -> "Figure":
    """Success rates of all tasks together: a panel per suite and track, a line per method.

    The methods' names stand at the left, each rate at its mark; methods that read the simulator
    come last, below a line. `results` is a table of `results.results` with one line per suite,
    track and method. Intervals are 95 %, over layouts where layouts return.
    """
    bounds = _bounds(results)
    methods = _bounds_last(results["method"], bounds)
    marks = method_marks(methods)
    tracks = list(dict.fromkeys(zip(results["suite"], results["split"], strict=True)))
    figure = empty_figure(2.35 * len(tracks) + 1.2, 0.3 * len(methods) + 1.15 + 0.3 * bool(title))
    panels = figure.subplots(1, len(tracks), sharey=True, squeeze=False)[0]
    for axes, (suite, split) in zip(panels, tracks, strict=True):
        shown = results[(results["suite"] == suite) & (results["split"] == split)]
        for i, method in enumerate(methods):
            for line in shown[shown["method"] == method].itertuples():
                _draw_rate(axes, i, line, colour=marks[method][0], marker=marks[method][1])
        track = f"{suite}\n{split}" if split else f"{suite}\n"
        axes.set_title(f"{track}\nn = {shown['n'].max()} a method", fontsize=9)
        if 0 < len(bounds) < len(methods):
            axes.axhline(len(methods) - len(bounds) - 0.5, color=FRAME, linewidth=0.8)
        axes.set(xlim=(-3, 118), xticks=(0, 50, 100))
        axes.grid(axis="x", color=GRID)
        axes.set_axisbelow(True)
        axes.tick_params(length=0)
        axes.spines[["top", "right", "left"]].set_visible(False)
    panels[0].set_yticks(range(len(methods)), _labels(methods, bounds, " (bound)"), fontsize=9)
    _set_ours_bold(panels[0].get_yticklabels(), methods)
    panels[0].set_ylim(len(methods) - 0.5, -0.6)
    figure.supxlabel("% of episodes that succeed, 95 % interval", fontsize=9)
    if title:
        figure.suptitle(title, fontsize=11, fontweight="bold")
    return figure


def tasks_figure(results: "pd.DataFrame", title: str = "") -> "Figure":
    """A matrix of success rates: a line per task, a column per method.

    The area of a dot is the rate in %, which stands beside it; the highest of the methods that do
    not read the simulator is bold. `results` is a table of `results.results`.
    """
    bounds = _bounds(results)
    methods = _bounds_last(results["method"], bounds)
    lines = list(
        dict.fromkeys(zip(results["suite"], results["split"], results["task"], strict=True))
    )
    places = _places(lines)
    bottom = max(places.values())
    figure = empty_figure(0.92 * len(methods) + 3.0, 0.28 * (bottom + 1) + 1.0)
    axes = figure.subplots()
    marks = method_marks(methods)
    for line, y in places.items():
        suite, split, task = line
        of_task = results[
            (results["suite"] == suite) & (results["split"] == split) & (results["task"] == task)
        ]
        rates = dict(zip(of_task["method"], of_task["sr"], strict=True))
        plain = [rate for name, rate in rates.items() if name not in bounds]
        for x, method in enumerate(methods):
            if method in rates:
                is_best = method not in bounds and rates[method] == max(plain)
                _draw_dot(axes, x, y, rates[method], colour=marks[method][0], bold=is_best)
    for line in lines:
        if line[2] == next(other[2] for other in lines if other[:2] == line[:2]):
            axes.text(
                -0.75,
                places[line] - 0.78,
                track_title(line[0], line[1]),
                fontsize=9,
                fontweight="bold",
                va="center",
                ha="right",
            )
    axes.set_yticks(list(places.values()), [line[2] for line in lines], fontsize=9)
    axes.set_xticks(range(len(methods)), _labels(methods, bounds, "\n(bound)"), fontsize=9)
    axes.xaxis.tick_top()
    axes.set_title("% of episodes that succeed; so is the area of a dot", fontsize=9)
    _set_ours_bold(axes.get_xticklabels(), methods)
    axes.set(xlim=(-0.7, len(methods) - 0.3), ylim=(bottom + 0.6, -1.1))
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    if title:
        figure.suptitle(title, fontsize=11, fontweight="bold")
    return figure


def _bounds(results: "pd.DataFrame") -> set[str]:
    """The methods that read the simulator."""
    return set(results.loc[results["bound"].astype(bool), "method"])


def _bounds_last(methods: "pd.Series", bounds: set[str]) -> list[str]:
    """Every method once, in the order of the table, those that read the simulator last."""
    names = list(dict.fromkeys(methods))
    return sorted(names, key=lambda name: name in bounds)


def _labels(methods: Sequence[str], bounds: set[str], mark: str) -> list[str]:
    """The methods' names; `mark` follows those that read the simulator."""
    labels = []
    for name in methods:
        labels.append(name + mark if name in bounds else name)
    return labels


def _set_ours_bold(labels: "Sequence[Text]", methods: Sequence[str]) -> None:
    for name, label in zip(methods, labels, strict=True):
        label.set_fontweight("bold" if name == OURS else "normal")


def _draw_rate(axes: "Axes", y: int, line: "pd.Series", *, colour: str, marker: str) -> None:
    """A rate with its interval and its number."""
    low, high = line.sr_layout_low, line.sr_layout_high
    if np.isnan(low):
        low, high = line.sr_low, line.sr_high
    middle = 100 * line.sr
    axes.errorbar(
        middle,
        y,
        xerr=np.maximum([[middle - 100 * low], [100 * high - middle]], 0),
        fmt=marker,
        color=colour,
        markersize=6,
        capsize=2.5,
        linewidth=1.2,
    )
    axes.text(
        100 * high + 3,
        y,
        f"{middle:.0f}",
        va="center",
        fontsize=8,
        color=colour if line.method == OURS else TEXT,
        fontweight="bold" if line.method == OURS else "normal",
    )


def _places(lines: Sequence[tuple[str, str, str]]) -> dict[tuple[str, str, str], float]:
    """The height of each line; a new suite or track has room for its heading."""
    places = {}
    groups: list[tuple[str, str]] = []
    for i, line in enumerate(lines):
        if line[:2] not in groups:
            groups.append(line[:2])
        places[line] = i + 1.0 * (len(groups) - 1)
    return places


def _draw_dot(axes: "Axes", x: int, y: float, rate: float, *, colour: str, bold: bool) -> None:
    """A dot of that area, and its number beside it."""
    axes.scatter(x - 0.2, y, s=LARGEST_PT2 * rate, color=colour, linewidths=0)
    axes.text(
        x + 0.05,
        y,
        f"{100 * rate:.0f}",
        va="center",
        fontsize=8.5,
        color=TEXT,
        fontweight="bold" if bold else "normal",
    )
