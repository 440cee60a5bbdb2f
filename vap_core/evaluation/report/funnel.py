"""The pictures of failures: their cases, and the funnel of stages at which episodes are lost."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from vap_core.base.figures import POLICY_MARKERS, empty_figure
from vap_core.base.palette import CASES as CASE_COLOURS
from vap_core.base.palette import METHODS, rgb8
from vap_core.evaluation.diagnosis import STAGES
from vap_core.evaluation.metrics import rate
from vap_core.evaluation.report.failures import APART, FunnelRow
from vap_core.rollout.failure import CASES

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.container import BarContainer
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

MEANINGS = {
    "case 1": "Case 1: every view wrong alike",
    "case 2": "Case 2: views disagree",
    "case 3": "Case 3: right prompt, the hand fails",
    "unprompted": "unprompted: no mask to be wrong",
}
"""The cases in a legend."""
PERCENT_A_LETTER = 0.95
"""Width of a letter in a bar, in percent of its axis."""
FUNNEL_COLOURS = {name: METHODS[name][0] for name in ("generic", "soft", "vap", "oracle-mask")}
"""The methods of a funnel."""
SUCCESS_MARK = "D"
LABEL_APART = 6.0
"""Percent between two numbers at the ends of lines, so that both can be read."""


def funnel_figure(
    rows: Sequence[FunnelRow], colours: Mapping[str, str] = FUNNEL_COLOURS
) -> "Figure":
    """Per suite, the share of episodes that are left after each stage of the funnel.

    A line per method of `colours` and policy, methods that read the simulator dashed, the policies
    of one method with a marker each. A method that highlights nothing begins with the stage
    "touched"; one that has errors alone has no line. The last tick has two marks: a dot for
    episodes that succeed with every stage right, a diamond for all that succeed (SR).
    """
    by_suite: dict[str, list[FunnelRow]] = {}
    for row in rows:
        by_suite.setdefault(row.suite, []).append(row)
    columns = min(2, len(by_suite))
    lines = -(-len(by_suite) // columns)
    figure = empty_figure(5.4 * columns, 2.9 * lines + 0.4)
    panels = figure.subplots(lines, columns, squeeze=False, sharey=True).ravel()
    markers = _policy_markers(rows)
    drawn: dict[str, Line2D] = {}
    for axes, (suite, of_suite) in zip(panels, by_suite.items(), strict=False):
        shown = [row for row in of_suite if _plain(row.method) in colours]
        drawn |= _draw_funnel(axes, shown, colours, markers)
        axes.set_xticks(range(len(STAGES)), STAGES, fontsize=8, rotation=20)
        axes.set_xlim(-0.25, len(STAGES) - 0.4)
        axes.set(title=f"{suite}{_count_text(shown)}", ylim=(0, 104))
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


def cases_figure(counts: "pd.DataFrame", first: str = "vap") -> "Figure":
    """One bar per suite and method, as long as its share of failures, split by case (`breakdown`).

    One colour a case; within it thin lines separate the sub-cases, whose names stand where there is
    room. Methods stand below `first` in the order of the table; suites keep theirs.
    """
    lines = _first_on_top(counts[counts["n"] > 0], first)
    places = _spaced(lines["suite"])
    figure = empty_figure(10.5, 0.3 * (places[-1] + 1) + 1.5)
    axes = figure.subplots()
    start = np.zeros(len(lines))
    drawn: dict[str, BarContainer] = {}
    for case, sub_cases in CASES.items():
        for sub_case in sub_cases:
            percent = (100 * lines[f"{case}: {sub_case}"] / lines["n"]).to_numpy()
            if percent.any():
                bars = _draw_bars(axes, places, percent, start, case, sub_case)
                drawn.setdefault(case, bars)
            start += percent
    for place, line in zip(places, lines.itertuples(), strict=True):
        axes.text(
            start[places.index(place)] + 1,
            place,
            f"{line.failed} of {line.n}",
            fontsize=8,
            va="center",
        )
    _name_bars(axes, lines, places, first)
    axes.set(xlim=(0, 112), xticks=range(0, 101, 20), xlabel="failures, % of episodes")
    axes.spines[["top", "right", "left"]].set_visible(False)
    figure.legend(
        handles=list(drawn.values()),
        labels=[MEANINGS.get(case, case) for case in drawn],
        loc="outside lower center",
        ncols=4,
        frameon=False,
        fontsize=9,
    )
    return figure


def _policy_markers(rows: Sequence[FunnelRow]) -> dict[str, str]:
    """The marker of every line: the policies of one method have one each."""
    markers: dict[str, str] = {}
    n_policies: Counter[str] = Counter()
    for row in rows:
        if row.method not in markers:
            method = _plain(row.method)
            markers[row.method] = POLICY_MARKERS[n_policies[method] % len(POLICY_MARKERS)]
            n_policies[method] += 1
    return markers


def _draw_funnel(
    axes: "Axes",
    rows: Sequence[FunnelRow],
    colours: Mapping[str, str],
    markers: Mapping[str, str],
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
                percent.append(100 * rate(left, row.n).value)
        if not percent:
            continue
        colour = colours[_plain(row.method)]
        (drawn[row.method],) = axes.plot(
            stages,
            percent,
            "--" if row.bound else "-",
            marker=markers[row.method],
            markersize=4,
            color=colour,
            linewidth=1.8,
        )
        success = 100 * rate(row.succeeded, row.n).value
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


def _count_text(rows: Sequence[FunnelRow]) -> str:
    """How many episodes the lines are of."""
    counts = {row.n for row in rows if any(left is not None for left in row.left)}
    if not counts:
        return ""
    if len(counts) == 1:
        return f" (n {counts.pop()})"
    return f" (n {min(counts)} to {max(counts)})"


def _plain(method: str) -> str:
    """The method without its policy."""
    return method.partition(APART)[0]


def _first_on_top(counts: "pd.DataFrame", first: str) -> "pd.DataFrame":
    """The lines suite by suite, that of the method `first` before the others."""
    suites = list(dict.fromkeys(counts["suite"]))
    others = counts["method"].map(_plain) != first
    rank = counts["suite"].map(suites.index) + 0.5 * others
    return counts.assign(rank=rank).sort_values("rank", kind="stable").reset_index(drop=True)


def _spaced(suites: "pd.Series") -> list[float]:
    """The height of each bar; a new suite leaves room for its heading."""
    places = []
    seen: list[str] = []
    for i, suite in enumerate(suites):
        if suite not in seen:
            seen.append(suite)
        places.append(i + 1.0 * (len(seen) - 1))
    return places


def _name_bars(axes: "Axes", lines: "pd.DataFrame", places: Sequence[float], first: str) -> None:
    """Methods beside their bars, the suite above its first."""
    axes.set_yticks(places, lines["method"], fontsize=9)
    axes.set_ylim(places[-1] + 0.6, -1.2)
    axes.tick_params(axis="y", length=0)
    headed: set[str] = set()
    for place, label, line in zip(places, axes.get_yticklabels(), lines.itertuples(), strict=True):
        label.set_fontweight("bold" if _plain(line.method) == first else "normal")
        if line.suite not in headed:
            headed.add(line.suite)
            axes.text(0, place - 0.85, line.suite, fontsize=9, fontweight="bold", va="center")


def _draw_bars(
    axes: "Axes",
    places: Sequence[float],
    percent: np.ndarray,
    start: np.ndarray,
    case: str,
    sub_case: str,
) -> "BarContainer":
    """One sub-case of every line, with its name in bars that have room for it."""
    colour = CASE_COLOURS[case]
    bars = axes.barh(
        places,
        percent,
        left=start,
        color=colour,
        edgecolor="white",
        linewidth=0.8,
        height=0.82,
    )
    labels = []
    for each in percent:
        labels.append(sub_case if each >= PERCENT_A_LETTER * len(sub_case) else "")
    is_dark = sum(rgb8(colour)) < 400
    axes.bar_label(
        bars,
        labels,
        label_type="center",
        fontsize=7.5,
        color="white" if is_dark else "black",
    )
    return bars
