"""The pictures of a report: success rates with intervals, and differences on the same episodes."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.figures import FURTHER_POLICY_MARKERS, empty_figure
from vap_core.base.palette import GRID, TEXT, method_marks
from vap_core.evaluation.metrics import Score
from vap_core.evaluation.statistics import Comparison

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Line = tuple[str, ...]
"""What a line of a forest plot is about: the words of its heading, then the task."""


def forest_figure(results: "pd.DataFrame") -> "Figure":
    """Success rates of every suite, track and task, a mark per method and policy.

    `results` is a table of `results.results`.
    """
    series = list(dict.fromkeys(zip(results["method"], results["policy"], strict=True)))
    methods = _unique(results["method"])
    policies = _unique(results["policy"])
    marks = method_marks(methods)
    lines = list(zip(results["suite"], results["split"], results["task"], strict=True))
    figure, axes, places = _forest_axes(lines, per_line=len(series), heading_x=0.0)
    for i, (method, policy) in enumerate(series):
        of_series = (results["method"] == method) & (results["policy"] == policy)
        shown = results[of_series & (results["n"] > 0)]
        low = 100 * shown["sr_layout_low"].fillna(shown["sr_low"]).to_numpy()
        high = 100 * shown["sr_layout_high"].fillna(shown["sr_high"]).to_numpy()
        middle = 100 * shown["sr"].to_numpy()
        heights = []
        for line in zip(shown["suite"], shown["split"], shown["task"], strict=True):
            heights.append(places[line])
        at = np.array(heights)
        colour, marker = marks[method]
        axes.errorbar(
            middle,
            at + _offset(i, len(series)),
            xerr=np.maximum([middle - low, high - middle], 0),
            label=method if len(policies) == 1 else f"{method}, {policy} policy",
            **_policy_style(colour, marker, policies.index(policy)),
        )
    axes.set(xlim=(-2, 102), xlabel="% of episodes that succeed, 95 % interval")
    figure.legend(
        *axes.get_legend_handles_labels(),
        loc="outside upper center",
        ncols=min(3, len(series)),
        frameon=False,
    )
    return figure


def differences_figure(comparisons: Sequence[Comparison]) -> "Figure":
    """Differences on the same episodes with their 95 % cluster bootstrap.

    A mark per pair of methods, filled where Holm's p is below 0.05. Colours and markers are those
    of the methods in `forest_figure`.
    """
    lines: list[Line] = []
    contrasts: list[tuple[str, str]] = []
    for c in comparisons:
        lines.append((c.suite, c.split, f"{c.policy} policy", c.task))
        if (c.other, c.one) not in contrasts:
            contrasts.append((c.other, c.one))
    marks = method_marks([comparisons[0].one, *(other for other, _ in contrasts)])
    lowest = min(-25.0, *(100 * c.low for c in comparisons))
    figure, axes, places = _forest_axes(lines, per_line=len(contrasts), heading_x=lowest)
    axes.axvline(0, color=TEXT, linewidth=1)
    for line, c in zip(lines, comparisons, strict=True):
        colour, marker = marks[c.other]
        i = contrasts.index((c.other, c.one))
        spread = np.maximum([[c.difference - c.low], [c.high - c.difference]], 0)
        axes.errorbar(
            100 * c.difference,
            places[line] + _offset(i, len(contrasts)),
            xerr=100 * spread,
            **_mark_style(colour, marker, filled=c.p_holm < 0.05),
        )
    for other, one in contrasts:
        colour, marker = marks[other]
        axes.plot([], [], marker, color=colour, label=f"{other} minus {one}")
    axes.set_xlim(lowest - 2, 102)
    axes.set_xlabel(
        "difference of success rates in points, same episodes, 95 % interval over layouts\n"
        "filled: p < 0.05 after Holm's correction"
    )
    figure.legend(
        *axes.get_legend_handles_labels(),
        loc="outside upper center",
        ncols=min(3, len(contrasts)),
        frameon=False,
    )
    return figure


def scores_table(scores: Sequence[Score]) -> "pd.DataFrame":
    """The success rates of scores as `forest_figure` reads them, with Wilson's intervals."""
    import pandas as pd

    lines = []
    for score in scores:
        line: dict[str, Any] = {}
        for name in ("suite", "split", "task", "method", "policy", "n"):
            line[name] = getattr(score, name)
        line |= {"sr": score.sr.value, "sr_low": score.sr.low, "sr_high": score.sr.high}
        lines.append({**line, "sr_layout_low": np.nan, "sr_layout_high": np.nan})
    return pd.DataFrame(lines)


def _forest_axes(
    lines: Sequence[Line], per_line: int, heading_x: float
) -> "tuple[Figure, Axes, dict[Line, float]]":
    """An empty figure, its axes, and the height of each line.

    A labelled line per task has room for `per_line` marks. Over each group of lines stands its
    heading, written from x = `heading_x`.
    """
    groups: list[Line] = []
    places: dict[Line, float] = {}
    headings: dict[Line, float] = {}
    for i, line in enumerate(dict.fromkeys(lines)):
        group = line[:-1]
        if group not in groups:
            groups.append(group)
        places[line] = i + 0.8 * (groups.index(group) + 1)
        headings.setdefault(group, places[line])
    bottom = max(places.values())
    figure = empty_figure(8.5, (0.2 + 0.13 * per_line) * (bottom + 1) + 1.2)
    axes = figure.subplots()
    for group, first in headings.items():
        axes.text(
            heading_x,
            first - 0.65,
            ", ".join(filter(None, group)),
            fontsize=9,
            fontweight="bold",
            va="center",
            backgroundcolor="white",
        )
    axes.set_yticks(list(places.values()), [line[-1] for line in places], fontsize=9)
    axes.set_ylim(bottom + 0.6, -0.2)
    axes.grid(axis="x", color=GRID)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes, places


def _policy_style(colour: str, marker: str, i: int) -> dict[str, Any]:
    """The mark of the i-th policy: the method's own, filled and hollow, then further ones."""
    markers = (marker, *FURTHER_POLICY_MARKERS)
    return _mark_style(colour, markers[i // 2 % len(markers)], filled=i % 2 == 0)


def _mark_style(colour: str, marker: str, filled: bool) -> dict[str, Any]:
    return {
        "color": colour,
        "markerfacecolor": colour if filled else "white",
        "fmt": marker,
        "markersize": 5,
        "capsize": 2.5,
        "linewidth": 1.2,
    }


def _offset(i: int, n: int) -> float:
    """How far below the middle of its line the i-th of n marks stands."""
    return min(0.24, 0.8 / n) * (i - (n - 1) / 2)


def _unique(column: "pd.Series") -> list[str]:
    return list(dict.fromkeys(column))
