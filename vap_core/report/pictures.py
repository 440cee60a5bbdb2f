"""The pictures of a report: success rates as a forest, and differences on the same episodes."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.plots import METHOD_COLOURS, empty_figure
from vap_core.statistics import Comparison

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

OKABE_ITO = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#000000")
MARKERS = "osD^vPX*"


def method_marks(methods: Sequence[str]) -> dict[str, tuple[str, str]]:
    """A colour and a marker per method, so that either tells them apart."""
    others = iter(OKABE_ITO * len(methods))
    colours = [METHOD_COLOURS.get(method) or next(others) for method in methods]
    return {method: (colour, MARKERS[i % len(MARKERS)]) for i, (method, colour) in enumerate(zip(methods, colours, strict=True))}


Line = tuple[str, ...]
"""What a line of a picture is about: the heading's words, then the task."""


def forest_figure(results: "pd.DataFrame") -> "Figure":
    """Success rates of every suite, track and task, a mark per method and policy (columns of results.results)."""
    series = list(dict.fromkeys(zip(results["method"], results["policy"], strict=True)))
    marks = method_marks(list(dict.fromkeys(method for method, _ in series)))
    policies = list(dict.fromkeys(policy for _, policy in series))
    figure, axes, place = _lines(list(dict.fromkeys(zip(results["suite"], results["split"], results["task"], strict=True))), len(series), 0.0)
    for i, (method, policy) in enumerate(series):
        shown = results[(results["method"] == method) & (results["policy"] == policy) & (results["n"] > 0)]
        low, high = (shown[f"sr_layout_{side}"].fillna(shown[f"sr_{side}"]).to_numpy() for side in ("low", "high"))
        at = np.array([place[key] for key in zip(shown["suite"], shown["split"], shown["task"], strict=True)]) + _aside(i, len(series))
        (colour, marker), middle = marks[method], shown["sr"].to_numpy()
        label = f"{method}, {policy} policy" if len(policies) > 1 else method
        look: dict[str, Any] = {"color": colour, "markerfacecolor": "white" if policies.index(policy) else colour, "label": label}
        axes.errorbar(middle, at, xerr=np.maximum([middle - low, high - middle], 0), fmt=marker, markersize=5, capsize=2.5, linewidth=1.2, **look)
    axes.set(xlim=(-2, 102), xlabel="% of episodes that succeed, 95 % interval")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=min(3, len(series)), frameon=False)
    return figure


def differences_figure(comparisons: Sequence[Comparison]) -> "Figure":
    """Differences from one method on the same episodes with their 95 % cluster bootstrap; filled where Holm's p is below 0.05.

    Colours and markers are those of the methods in `forest_figure`.
    """
    contrasts = list(dict.fromkeys((c.other, c.one) for c in comparisons))
    marks = method_marks([comparisons[0].one, *(other for other, _ in contrasts)])
    figure, axes, place = _lines(list(dict.fromkeys(_about(c) for c in comparisons)), len(contrasts), -100.0)
    axes.axvline(0, color="#555555", linewidth=1)
    for c in comparisons:
        (colour, marker), i = marks[c.other], contrasts.index((c.other, c.one))
        spread, fill = np.maximum([[c.difference - c.low], [c.high - c.difference]], 0), colour if c.p_holm < 0.05 else "white"
        look: dict[str, Any] = {"color": colour, "markerfacecolor": fill, "fmt": marker, "markersize": 5, "capsize": 2.5, "linewidth": 1.2}
        axes.errorbar(100 * c.difference, place[_about(c)] + _aside(i, len(contrasts)), xerr=100 * spread, **look)
    for other, one in contrasts:
        axes.plot([], [], marks[other][1], color=marks[other][0], label=f"{other} minus {one}")
    axes.set_xlim(-102, 102)
    axes.set_xlabel("difference of success rates in points, same episodes, 95 % interval over layouts\nfilled: p < 0.05 after Holm's correction")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=min(3, len(contrasts)), frameon=False)
    return figure


def _about(c: Comparison) -> Line:
    return c.suite, c.split, f"{c.policy} policy", c.task


def _aside(i: int, of: int) -> float:
    """How far below the middle of its line the i-th of so many marks stands."""
    return min(0.24, 0.8 / of) * (i - (of - 1) / 2)


def _lines(lines: Sequence[Line], of: int, left: float) -> "tuple[Figure, Axes, dict[Line, float]]":
    """An empty figure with a labelled line per task, room for `of` marks on each, and a heading over each group, written from x = `left`."""
    groups = list(dict.fromkeys(line[:-1] for line in lines))
    place = {line: i + 0.8 * (groups.index(line[:-1]) + 1) for i, line in enumerate(lines)}
    figure = empty_figure(8.5, (0.2 + 0.13 * of) * (max(place.values()) + 1) + 1.2)
    axes = figure.subplots()
    for group in groups:
        first = min(at for line, at in place.items() if line[:-1] == group)
        axes.text(left, first - 0.65, ", ".join(word for word in group if word), fontsize=9, fontweight="bold", va="center", backgroundcolor="white")
    axes.set_yticks(list(place.values()), [line[-1] for line in lines], fontsize=9)
    axes.set_ylim(max(place.values()) + 0.6, -0.2)
    axes.grid(axis="x", color="#e6e6e6")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes, place
