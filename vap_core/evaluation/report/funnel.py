"""The pictures of failures: their cases, and the funnel of stages at which episodes are lost."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from vap_core.base.figures import empty_figure
from vap_core.evaluation.diagnosis import STAGES
from vap_core.evaluation.report.failures import FunnelRow
from vap_core.rollout.failure import CASES

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

CASE_SHADES = {
    "case 1": "Reds",
    "case 2": "Purples",
    "case 3": "Blues",
    "unprompted": "Greys",
    "unlabelled": "Greens",
}
SUCCESS_MARK = "D"
LABEL_APART = 6.0
"""Percent between two numbers at the ends of lines, so that both can be read."""


def funnel_figure(rows: Sequence[FunnelRow], colours: Mapping[str, str]) -> "Figure":
    """Per suite, the share of episodes that are left after each stage of the funnel.

    A line per method of `colours`, methods that read the simulator dashed. A method that highlights
    nothing begins with the stage "touched". The last tick has two marks: a dot for episodes that
    succeed with every stage right, a diamond for all that succeed (SR).
    """
    by_suite: dict[str, list[FunnelRow]] = {}
    for row in rows:
        by_suite.setdefault(row.suite, []).append(row)
    columns = min(2, len(by_suite))
    lines = -(-len(by_suite) // columns)
    figure = empty_figure(5.4 * columns, 2.9 * lines + 0.4)
    panels = figure.subplots(lines, columns, squeeze=False, sharey=True).ravel()
    drawn: dict[str, Line2D] = {}
    for axes, (suite, of_suite) in zip(panels, by_suite.items(), strict=False):
        shown = [row for row in of_suite if row.method in colours]
        drawn |= _draw_funnel(axes, shown, colours)
        axes.set_xticks(range(len(STAGES)), STAGES, fontsize=8, rotation=20)
        axes.set_xlim(-0.25, len(STAGES) - 0.4)
        axes.set(title=f"{suite} (n {of_suite[0].n})", ylim=(0, 104))
        axes.grid(color="#eeeeee")
        axes.spines[["top", "right"]].set_visible(False)
    for axes in panels[len(by_suite) :]:
        axes.set_axis_off()
    for axes in panels[::columns]:
        axes.set_ylabel("% of episodes left after the stage", fontsize=8)
    (success,) = panels[0].plot([], [], SUCCESS_MARK, color="#555555", fillstyle="none")
    drawn["SR (every success)"] = success
    figure.legend(drawn.values(), drawn.keys(), loc="outside lower center", ncols=6, frameon=False)
    return figure


def cases_figure(counts: "pd.DataFrame") -> "Figure":
    """One bar per suite and method: its failures by sub-case, in percent of them (`breakdown`).

    One hue a case; sub-cases from perception to manipulation.
    """
    import matplotlib

    lines = counts[counts["failed"] > 0]
    figure = empty_figure(10.5, 0.42 * len(lines) + 1.9)
    axes = figure.subplots()
    start = np.zeros(len(lines))
    for case, sub_cases in CASES.items():
        shades = matplotlib.colormaps[CASE_SHADES[case]](np.linspace(0.85, 0.35, len(sub_cases)))
        for sub_case, colour in zip(sub_cases, shades, strict=True):
            name = f"{case}: {sub_case}"
            percent = (100 * lines[name] / lines["failed"]).to_numpy()
            if percent.any():
                _draw_bars(axes, percent, start, colour, label=name)
            start += percent
    titles = []
    for line in lines.itertuples():
        titles.append(f"{line.suite} · {line.method} ({line.failed} of {line.n})")
    axes.set_yticks(range(len(lines)), titles, fontsize=8)
    axes.invert_yaxis()
    axes.set(xlim=(0, 100), xlabel="% of the failures")
    axes.spines[["top", "right", "left"]].set_visible(False)
    figure.legend(
        *axes.get_legend_handles_labels(),
        loc="outside lower center",
        ncols=4,
        frameon=False,
        fontsize=8,
    )
    return figure


def _draw_funnel(
    axes: "Axes", rows: Sequence[FunnelRow], colours: Mapping[str, str]
) -> "dict[str, Line2D]":
    """A line per method with the percentage at its end; the lines by method."""
    drawn: dict[str, Line2D] = {}
    ends = []
    for row in rows:
        stages = []
        percent = []
        for i, left in enumerate(row.left):
            if left is not None:
                stages.append(i)
                percent.append(100 * left / row.n)
        colour = colours[row.method]
        (drawn[row.method],) = axes.plot(
            stages,
            percent,
            "--" if row.method.startswith("oracle") else "-",
            marker="o",
            markersize=4,
            color=colour,
            linewidth=1.8,
        )
        success = 100 * row.succeeded / row.n
        axes.plot(
            len(STAGES) - 1, success, SUCCESS_MARK, color=colour, fillstyle="none", markersize=7
        )
        ends.append((percent[-1], success, colour))
    lowest = -LABEL_APART
    for percent_left, success, colour in sorted(ends):
        lowest = max(success, lowest + LABEL_APART)
        text = f"{success:.0f}"
        if round(percent_left) != round(success):
            text += f" (every stage {percent_left:.0f})"
        axes.annotate(
            text,
            (len(STAGES) - 1, lowest),
            (7, 0),
            textcoords="offset points",
            fontsize=8,
            color=colour,
            va="center",
        )
    return drawn


def _draw_bars(
    axes: "Axes", percent: np.ndarray, start: np.ndarray, colour: np.ndarray, label: str
) -> None:
    """One sub-case of every line, with the percentage in bars that have room for it."""
    bars = axes.barh(
        range(len(percent)),
        percent,
        left=start,
        color=colour,
        edgecolor="white",
        linewidth=0.6,
        label=label,
    )
    labels = []
    for each in percent:
        labels.append(f"{each:.0f}" if each >= 4 else "")
    axes.bar_label(
        bars,
        labels,
        label_type="center",
        fontsize=7.5,
        color="white" if sum(colour[:3]) < 1.7 else "black",
    )
